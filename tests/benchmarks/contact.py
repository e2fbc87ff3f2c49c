"""Contact-implicit optimal control by codegen, and the same programs by CasADi and IPOPT.

    python tests/benchmarks/contact.py [NOISY GUESSES]

The discrete equations, contact laws and relaxations are the same; CasADi differentiates the discrete Lagrangian. Both
begin at the same guesses: the straight line between the ends, with noise of a tenth in all coordinates of inner nodes.
IPOPT solves the program with the final relaxation alone, and with a sequence of relaxations that begins with the first
relaxation of codegen and falls by a factor of ten.
"""

import sys
import time
from pathlib import Path

import casadi
import numpy as np

import codegen
from codegen.runtime.search import contact

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
QUIET = {"print_time": False, "ipopt.print_level": 0, "ipopt.sb": "yes", "ipopt.max_iter": 3000, "ipopt.tol": 1e-9}
NOISE = 0.1


def block(q, v, u):
    return {
        "lagrangian": casadi.sumsqr(v) / 2 - 9.81 * q[1], "force": casadi.vertcat(u[0], 0), "cost": u[0] ** 2,
        "gap": q[1], "slip": v[0], "mu": 0.3,
    }  # fmt: skip


def shove(q, v, u):
    return {
        "lagrangian": v[0] ** 2 / 2 + v[1] ** 2 / 4, "force": casadi.vertcat(u[0], -0.5 * v[1]), "cost": u[0] ** 2,
        "gap": q[1] - q[0], "slip": None, "mu": 0,
    }  # fmt: skip


def hopper(q, v, u):
    sine, cosine = casadi.sin(q[3]), casadi.cos(q[3])
    height = q[1] - q[2] * cosine
    sliding = v[0] + v[2] * sine + q[2] * cosine * v[3]
    rising = v[1] - v[2] * cosine + q[2] * sine * v[3]
    kinetic = (v[0] ** 2 + v[1] ** 2) / 2 + 0.05 * (sliding**2 + rising**2) + 0.025 * v[3] ** 2
    return {
        "lagrangian": kinetic - 9.81 * (q[1] + 0.1 * height), "force": casadi.vertcat(0, 0, u[0], u[1]),
        "cost": u[0] ** 2 + 10 * u[1] ** 2, "gap": height, "slip": sliding, "mu": 0.7,
    }  # fmt: skip


class Program:
    """The program of a problem in CasADi; ends are pairs (index, value), and `speeds` are final velocities."""

    def __init__(self, written, sizes, n, duration, start, end, speeds, bounds=()):
        d, m = sizes
        q, v, u = casadi.MX.sym("q", d), casadi.MX.sym("v", d), casadi.MX.sym("u", m)
        a, b = casadi.MX.sym("a", d), casadi.MX.sym("b", d)
        own, h = written(q, v, u), duration / n
        ld = h * casadi.substitute(own["lagrangian"], casadi.vertcat(q, v), casadi.vertcat((a + b) / 2, (b - a) / h))
        push = h / 2 * casadi.substitute(own["force"], casadi.vertcat(q, v), casadi.vertcat((a + b) / 2, (b - a) / h))
        left = casadi.Function("left", [a, b, u], [-casadi.gradient(ld, a) - push])
        right = casadi.Function("right", [a, b, u], [casadi.gradient(ld, b) + push])
        gap = casadi.Function("gap", [q], [own["gap"]])
        normal = casadi.Function("normal", [q], [casadi.gradient(own["gap"], q)])
        momentum = casadi.Function("momentum", [q, v], [casadi.gradient(own["lagrangian"], v)])
        cost = casadi.Function("cost", [u], [own["cost"]])
        has_friction = own["slip"] is not None
        if has_friction:
            slip = casadi.Function("slip", [q, v], [own["slip"]])
            along = casadi.Function("along", [q], [casadi.gradient(own["slip"], v)])
        opti = self.opti = casadi.Opti()
        self.q, self.u, self.normal = opti.variable(d, n + 1), opti.variable(m, n), opti.variable(n)
        self.friction, self.end = opti.variable(n), opti.variable(2)
        self.relaxation = opti.parameter()
        epsilon, mu = self.relaxation, own["mu"]
        opti.minimize(h * sum(cost(self.u[:, k]) for k in range(n)))
        before = momentum(self.q[:, 0], np.zeros(d))
        for k in range(n):
            here, there, force, f = self.q[:, k], self.q[:, k + 1], self.normal[k], self.friction[k]
            after = left(here, there, self.u[:, k]) - h * force * normal(here)
            opti.subject_to([force >= 0, gap(there) >= 0, force * gap(there) <= epsilon])
            if has_friction:
                after -= h * f * along(here)
                speed = slip(here, (there - here) / h)
                opti.subject_to([f <= mu * force, -f <= mu * force])
                opti.subject_to([duration * (f + s * mu * force) * speed <= epsilon for s in (1, -1)])
            else:
                opti.subject_to(f == 0)
            opti.subject_to(before == after)
            before = right(here, there, self.u[:, k])
        last = self.q[:, n]
        if (closed := all(i in dict(end) for i in range(d))) and abs(float(gap(np.array([x for _, x in end])))) < 1e-9:
            before = before + self.end[0] * normal(last)
            opti.subject_to([self.end[0] >= 0, self.end[0] * gap(last) / duration <= epsilon])
            if has_friction:
                before = before + self.end[1] * along(last)
                opti.subject_to([self.end[1] <= mu * self.end[0], -self.end[1] <= mu * self.end[0]])
        if not closed or not has_friction:
            opti.subject_to(self.end[1] == 0)
        if not closed:
            opti.subject_to(self.end[0] == 0)
        for i in speeds:
            opti.subject_to(before[i] == 0)
        for ends, node in ((start, 0), (end, n)):
            for i, value in ends:
                opti.subject_to(self.q[i, node] == value)
        for i, lower, upper in bounds:
            opti.subject_to(opti.bounded(lower, self.q[i, 1:], upper))

    def solved(self, guess, relaxations):
        """Return (True if all searches succeed, cost, iterations, seconds) from guessed coordinates (N + 1, d)."""
        opti, total, begin = self.opti, 0, time.perf_counter()
        opti.set_initial(self.q, guess.T)
        for variable in (self.u, self.normal, self.friction, self.end):
            opti.set_initial(variable, 0)
        for number, relaxation in enumerate(relaxations):
            warm = {"ipopt.mu_init": 1e-4} if number else {}
            opti.solver("ipopt", QUIET | warm)
            opti.set_value(self.relaxation, relaxation)
            try:
                solution = opti.solve()
            except RuntimeError:
                return False, np.nan, total + opti.stats()["iter_count"], time.perf_counter() - begin
            total += solution.stats()["iter_count"]
            opti.set_initial(solution.value_variables())
        return True, solution.value(opti.f), total, time.perf_counter() - begin


def sequence(final):
    """Return the relaxations of the continuation."""
    return [final * ratio for ratio in np.geomspace(contact.FIRST, 1, 9)]


CASES = {
    "pushed_block": Program(block, (2, 1), 30, 1, [(0, 0), (1, 0)], [(0, 1), (1, 0)], (0, 1)),
    "shove": Program(shove, (2, 1), 40, 2, [(0, 0), (1, 0.3)], [(0, 0), (1, 1)], (0,)),
    "hopper": Program(
        hopper, (4, 2), 40, 1.5, [(0, 0), (1, 1), (2, 1), (3, 0)], [(0, 1), (1, 1), (2, 1), (3, 0)], (0, 1, 2, 3),
        [(2, 0.5, 1.2), (3, -1, 1)],
    ),
}  # fmt: skip


def row(outcomes):
    """Return a row of a table: successes, best and median cost, median iterations and seconds of the successes."""
    good = np.array([values for is_solved, *values in outcomes if is_solved]).reshape(-1, 3)
    if not len(good):
        return f"0/{len(outcomes)}"
    cost, iterations, seconds = np.median(good, axis=0)
    return f"{len(good)}/{len(outcomes)}  {good[:, 0].min():.6f}  {cost:.6f}  {iterations:.0f}  {seconds:.2f} s"


def main(count: int) -> None:
    """Print a table for all problems, first without noise."""
    for name, program in CASES.items():
        solver = codegen.compile(PROBLEMS / f"{name}.py")
        module, metadata = solver.module, solver.module.metadata
        grid = module.make_grid(metadata.steps)
        final = metadata.parameters[metadata.relaxation]
        outcomes = {"codegen": [], "IPOPT, continuation": [], "IPOPT, final relaxation": []}
        generator = np.random.default_rng(1)
        for number in range(count + 1):
            guess = module.initial_guess(grid)
            nodes, _ = module.views(grid, guess)
            width = len(metadata.coordinates)
            noise = generator.normal(0, NOISE, nodes[0, 1:-1, :width].shape) if number else 0.0
            nodes[0, 1:-1, :width] += noise
            begin = time.perf_counter()
            found = module.solve(steps=metadata.steps, guess=guess)
            seconds = time.perf_counter() - begin
            outcomes["codegen"].append((found.status == "solved", found.cost, found.iterations, seconds))
            motion = nodes[0, :, :width].copy()
            outcomes["IPOPT, continuation"].append(program.solved(motion, sequence(final)))
            outcomes["IPOPT, final relaxation"].append(program.solved(motion, [final]))
            if number in (0, count):
                for method, of_method in outcomes.items():
                    print(f"{name}, {number} noisy guesses, {method}: {row(of_method)}", flush=True)
                outcomes = {method: [] for method in outcomes}


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
