"""The snakeboard of `problems/snakeboard.py` by CasADi and IPOPT, from two other descriptions of its motion.

    python tests/benchmarks/rolling.py [--steps N ...]

`discrete` is the program that our solver solves, written with positions, forces of the constraints and torques alone.
`explicit` solves the equations of motion for accelerations, without multipliers as unknowns, by the classical method of
Runge and Kutta with constant torques on intervals. Its limit for N -> infinity is the reference of both.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse

import casadi as ca
import numpy as np

MASS, HALF, BODY, WHEEL, DISTANCE, DURATION = 1.0, 0.5, 0.1, 0.01, 0.3, 4.0
INERTIA = np.diag([MASS, MASS, MASS * HALF**2, BODY, 2 * WHEEL])
INERTIA[2, 3] = INERTIA[3, 2] = BODY
END = np.array([DISTANCE, 0, 0, 0, 0])
PRECISE = {
    "ipopt.tol": 1e-12, "ipopt.constr_viol_tol": 1e-11, "ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": 0,
}  # fmt: skip


def rows(q):
    """The coefficients of the velocities in both rolling constraints."""
    theta, phi = q[2], q[4]
    front = [-ca.sin(theta + phi), ca.cos(theta + phi), HALF * ca.cos(phi), 0, 0]
    back = [-ca.sin(theta - phi), ca.cos(theta - phi), -HALF * ca.cos(phi), 0, 0]
    return ca.vertcat(ca.horzcat(*front), ca.horzcat(*back))


def guesses(n):
    """Positions at the nodes, as in the problem file."""
    s = np.linspace(0, 1, n + 1)
    return np.array([DISTANCE * s, 0 * s, 0 * s, -np.sin(2 * np.pi * s) / 5, -4 * np.sin(3 * np.pi * s) / 5])


def least(program, guess):
    """Cost, status and iterations of IPOPT."""
    solver = ca.nlpsol("solver", "ipopt", program, PRECISE)
    found = solver(x0=guess, lbg=0, ubg=0)
    return float(found["f"]), solver.stats()["return_status"], solver.stats()["iter_count"]


def discrete(n):
    """The discrete equations of Lagrange and d'Alembert by the midpoint rule, from rest to rest."""
    h = DURATION / n
    q, kappa, u = ca.SX.sym("q", 5, n + 1), ca.SX.sym("kappa", 2, n + 1), ca.SX.sym("u", 2, n)
    force = [ca.vertcat(0, 0, 0, u[:, k]) for k in range(n)]
    momentum = [ca.mtimes(INERTIA, (q[:, k + 1] - q[:, k]) / h) for k in range(n)]
    normal = [ca.mtimes(rows(q[:, k]).T, kappa[:, k]) for k in range(n + 1)]
    equations = [q[:, 0], q[:, n] - END]
    equations += [ca.mtimes(rows((q[:, k] + q[:, k + 1]) / 2), q[:, k + 1] - q[:, k]) / h for k in range(n)]
    equations += [momentum[0] - h / 2 * (force[0] + normal[0]), -momentum[-1] - h / 2 * (force[-1] + normal[n])]
    for k in range(1, n):
        impulse = h / 2 * (force[k - 1] + force[k]) + h * normal[k]
        equations.append(momentum[k - 1] - momentum[k] + impulse)
    unknowns = ca.vertcat(ca.vec(q), ca.vec(kappa), ca.vec(u))
    program = {"x": unknowns, "f": h * ca.sumsqr(u), "g": ca.vertcat(*equations)}
    return least(program, np.concatenate([guesses(n).ravel(order="F"), np.zeros(4 * n + 2)]))


def explicit(n):
    """Multiple shooting by the classical method of Runge and Kutta for (q, v), with accelerations by elimination."""
    h, q, v, u = DURATION / n, ca.SX.sym("q", 5), ca.SX.sym("v", 5), ca.SX.sym("u", 2)
    row = rows(q)
    change = ca.reshape(ca.jtimes(ca.vec(row), q, v), 2, 5)
    matrix = ca.vertcat(ca.horzcat(INERTIA, -row.T), ca.horzcat(row, ca.SX(2, 2)))
    accelerations = ca.solve(matrix, ca.vertcat(0, 0, 0, u, -ca.mtimes(change, v)))[:5]
    field = ca.Function("field", [ca.vertcat(q, v), u], [ca.vertcat(v, accelerations)])
    z, w = ca.MX.sym("z", 10), ca.MX.sym("w", 2)
    first = field(z, w)
    second = field(z + h / 2 * first, w)
    third = field(z + h / 2 * second, w)
    fourth = field(z + h * third, w)
    step = ca.Function("step", [z, w], [z + h / 6 * (first + 2 * second + 2 * third + fourth)])
    states, torques = ca.MX.sym("states", 10, n + 1), ca.MX.sym("torques", 2, n)
    # Three velocities at the end suffice: the constraints determine the two others.
    ends = [states[:, 0], states[:5, n] - END, states[5, n], states[8, n], states[9, n]]
    program = {
        "x": ca.vertcat(ca.vec(states), ca.vec(torques)),
        "f": h * ca.sumsqr(torques),
        "g": ca.vertcat(ca.vec(states[:, 1:] - step.map(n)(states[:, :-1], torques)), *ends),
    }
    positions = guesses(n)
    guess = np.vstack([positions, np.gradient(positions, h, axis=1)])
    return least(program, np.concatenate([guess.ravel(order="F"), np.zeros(2 * n)]))


def main() -> None:
    """Print costs and their limits by Richardson's extrapolation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, nargs="+", default=[40, 80, 160])
    steps = parser.parse_args().steps
    for solve in (discrete, explicit):
        costs = []
        for n in steps:
            cost, status, iterations = solve(n)
            costs.append(cost)
            print(f"{solve.__name__:8} {n:4} {cost:.12g} {status} {iterations}")
        if len(costs) > 1:
            ratio = (steps[-1] / steps[-2]) ** 2
            print(f"{solve.__name__:8} limit {(ratio * costs[-1] - costs[-2]) / (ratio - 1):.9g}")


if __name__ == "__main__":
    main()
