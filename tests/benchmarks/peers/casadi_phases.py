"""The gallery's problems of several phases, written once more as nonlinear programs and solved by CasADi and IPOPT.

    python tests/benchmarks/peers/casadi_phases.py [N ...]

prints the least discrete costs with N intervals in each phase, which `tests/gallery_references.py` quotes. States at
the beginning of a phase are unknowns of their own, tied to those at the end of the phase before.
"""

import sys

import casadi

PRECISE = {
    "ipopt.tol": 1e-12,
    "ipopt.constr_viol_tol": 1e-11,
    "ipopt.compl_inf_tol": 1e-12,
    "ipopt.bound_relax_factor": 0.0,
    "ipopt.max_iter": 2000,
    "ipopt.print_level": 0,
    "print_time": False,
}


def two_stage_rocket(steps: int) -> float:
    """The midpoint rule on three phases of a state (r, v, m)."""
    problem, g = casadi.Opti(), 0.00981
    thrusts, exhaust, masses = (0.06, 0.012), (2.3, 2.6), (0.7, 0.25)
    before, guess = casadi.DM([0, 0, 1.5]), ((40, 1.0), (80, 0.4), (200, 0.25))
    for phase in range(3):
        x, duration = problem.variable(3, steps + 1), problem.variable()
        burns = phase < 2
        thrust = problem.variable(steps) if burns else casadi.DM.zeros(steps)
        problem.subject_to(x[:, 0] == before)
        problem.subject_to(duration >= 1)
        for k in range(steps):
            middle = (x[:, k] + x[:, k + 1]) / 2
            flow = -thrust[k] / exhaust[phase] if burns else 0
            rate = casadi.vertcat(middle[1], thrust[k] / middle[2] - g, flow)
            problem.subject_to(x[:, k + 1] == x[:, k] + duration / steps * rate)
        if burns:
            problem.subject_to(problem.bounded(thrusts[phase] / 2, thrust, thrusts[phase]))
            problem.subject_to(x[2, -1] == masses[phase])
            problem.set_initial(thrust, 0.75 * thrusts[phase])
        problem.set_initial(duration, guess[phase][0])
        problem.set_initial(x[2, :], guess[phase][1])
        before = x[:, -1] - casadi.DM([0, 0, 0.15]) if phase == 0 else x[:, -1]
    problem.subject_to(before[1] == 0)
    problem.minimize(-before[0])
    return _least(problem, -before[0])


def bouncing_ball(steps: int) -> float:
    """Discrete Euler-Lagrange equations of the midpoint rule, with the momenta of Newton's impact at the switch."""
    problem, gravity = casadi.Opti(), casadi.DM([0, 9.81])
    durations, velocity = problem.variable(2), problem.variable(2)
    kept, cost = casadi.DM([0.7, -0.8]), 0
    arriving, begin = casadi.DM([0, 0]), casadi.DM([0, 1])
    for phase, leaving in enumerate((velocity, casadi.DM([0, 0]))):
        q, f, h = problem.variable(2, steps + 1), problem.variable(2, steps), durations[phase] / steps
        problem.subject_to(q[:, 0] == begin)
        momentum = arriving
        for k in range(steps):
            mean, half = (q[:, k + 1] - q[:, k]) / h, h / 2 * (f[:, k] - gravity)
            problem.subject_to(mean - half == momentum)
            momentum = mean + half
            cost += h * casadi.sumsqr(f[:, k])
        problem.subject_to(momentum == leaving)
        begin, arriving = q[:, -1], kept * velocity
        problem.subject_to(q[1, -1] == 0 if phase == 0 else q[:, -1] == casadi.DM([1, 0.9]))
        problem.set_initial(q[0, :], [(phase + k / steps) / 2 for k in range(steps + 1)])
        problem.set_initial(q[1, :], [abs(1 - phase - k / steps) for k in range(steps + 1)])
    problem.set_initial(durations, 0.45)
    problem.set_initial(velocity, [1, -4.5])
    problem.minimize(cost)
    return _least(problem, cost)


def _least(problem: casadi.Opti, cost: casadi.MX) -> float:
    problem.solver("ipopt", PRECISE)
    return float(problem.solve().value(cost))


if __name__ == "__main__":
    for make in (two_stage_rocket, bouncing_ball):
        for number in map(int, sys.argv[1:] or ("5", "10", "20")):
            print(f"{make.__name__} {number:4d} {make(number):.12g}")
