"""The program of a moving horizon in CasADi, with the state and the present time as its parameters.

It is that of `casadi_gallery.py`, but the first node is no unknown. Unknowns are in the order of time, u_0, q_1, u_1,
..., q_N, and at last the velocity at the end where there is one. A solve begins from the last solution, primal and
dual, shifted by one interval. IPOPT starts with the options that it has for that; the active-set method needs none.
"""

import subprocess
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from .casadi_control import COMPILER, IPOPT_OPTIONS
from .casadi_gallery import Array, interval_function, momentum_function, node_sums
from .gallery_problem import GalleryProblem

QUIET: dict[str, Any] = {"print_time": False, "error_on_fail": False}
WARM_IPOPT = {
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-5,
    "ipopt.warm_start_bound_push": 1e-6,
    "ipopt.warm_start_bound_frac": 1e-6,
    "ipopt.warm_start_slack_bound_push": 1e-6,
    "ipopt.warm_start_slack_bound_frac": 1e-6,
    "ipopt.warm_start_mult_bound_push": 1e-6,
}
"""The weight with which our own warm starts begin; larger and smaller ones took IPOPT longer."""
QRQP = {"print_iter": False, "print_header": False, "print_info": False, "error_on_fail": False}


def program(problem: GalleryProblem, steps: int) -> dict[str, ca.MX]:
    """Unknowns x, cost f, equations g; parameters p are the state, with velocities if it has any, and the time."""
    n, m = problem.dimension, problem.controls
    rates = 0 if problem.dynamics else n
    x, p = ca.MX.sym("x", steps * (n + m) + rates), ca.MX.sym("p", n + rates + 1)
    table = ca.reshape(x[: steps * (n + m)], n + m, steps)
    u, q = table[:m, :], ca.horzcat(p[:n], table[m:, :])
    length = problem.duration([])
    numbers = ca.DM(np.arange(steps)).T + p[-1] * steps / length
    mapped = interval_function(problem, steps).map("intervals", "serial", steps, [4], [])
    cost, *rest = mapped(q[:, :-1], q[:, 1:], u, numbers, ca.MX(0, 1))
    last_rate = x[steps * (n + m) :]
    if problem.dynamics:
        g = ca.vec(rest[0])
    else:
        momentum = momentum_function(problem)
        first, last = momentum(q[:, 0], p[n : 2 * n], p[-1]), momentum(q[:, -1], last_rate, p[-1] + length)
        g = ca.vec(node_sums(first, rest[0], rest[1], last, steps, 1))
    final = problem.terminal_cost(ca.vertsplit(q[:, -1]), ca.vertsplit(last_rate) if rates else [], [p[-1] + length])
    return {"x": x, "p": p, "f": ca.sum2(cost) + final, "g": g}


class MovingHorizon:
    """A program made ready once, and solved at one sampling time after the other; `step` is the timed call."""

    def __init__(self, problem: GalleryProblem, steps: int, method: str, tolerance: float, compiled: bool) -> None:
        """Build the solver, `ipopt` or `sqpmethod` with qrqp; CalledProcessError if gcc refuses the code."""
        started = perf_counter()
        self.problem, self.steps = problem, steps
        if method == "ipopt":
            options = IPOPT_OPTIONS | QUIET | WARM_IPOPT | {"ipopt.tol": tolerance}
        else:
            options = QUIET | {
                "qpsol": "qrqp", "qpsol_options": QRQP, "tol_pr": tolerance, "tol_du": tolerance, "print_header": False,
                "print_iteration": False, "print_status": False, "max_iter": 50,
            }  # fmt: skip
        functions = program(problem, steps)
        self.solver = _compiled(method, functions, options) if compiled else ca.nlpsol(
            "solver", method, functions, options | {"expand": True}
        )  # fmt: skip
        self.lower, self.upper, self.x = self._bounds_and_guess()
        self.multipliers: tuple[Any, Any] = np.zeros(self.x.size), np.zeros(functions["g"].shape[0])
        self.build_seconds = perf_counter() - started
        self.status, self.iterations, self.seconds, self.is_first = "", 0, 0.0, True

    def step(self, state: Array, t: float) -> Array:
        """The inputs of the first interval; shifts the last solution before."""
        started = perf_counter()
        if not self.is_first:
            self._shift()
        found = self.solver(
            x0=self.x, lbx=self.lower, ubx=self.upper, lbg=0.0, ubg=0.0, p=np.append(state, t),
            lam_x0=self.multipliers[0], lam_g0=self.multipliers[1],
        )  # fmt: skip
        self.x = found["x"].full().ravel()
        self.multipliers = found["lam_x"].full().ravel(), found["lam_g"].full().ravel()
        inputs = self.x[: self.problem.controls].copy()
        self.seconds, self.is_first = perf_counter() - started, False
        statistics = self.solver.stats()
        self.status = "solved" if statistics["success"] else str(statistics["return_status"])
        self.iterations = int(statistics["iter_count"])
        return inputs

    def _shift(self) -> None:
        stride = self.problem.dimension + self.problem.controls
        for values, width in ((self.x, stride), (self.multipliers[0], stride), (self.multipliers[1], self._equations)):
            last = self.steps * width
            values[: last - width] = values[width:last]

    @property
    def _equations(self) -> int:
        return self.problem.dimension

    def _bounds_and_guess(self) -> tuple[Array, Array, Array]:
        problem, steps = self.problem, self.steps
        n, m = problem.dimension, problem.controls
        rates = 0 if problem.dynamics else n
        tables = [np.full((steps, n + m), value) for value in (-np.inf, np.inf, 0.0)]
        for first, bounds in ((0, problem.control_bounds), (m, problem.bounds)):
            for i, (least, greatest) in bounds.items():
                tables[0][:, first + i], tables[1][:, first + i] = least, greatest
        for k in range(steps):
            tables[2][k] = [*problem.guess(np, (k + 0.5) / steps)[1], *problem.guess(np, (k + 1) / steps)[0]]
        ends = (np.full(rates, value) for value in (-np.inf, np.inf, 0.0))
        lower, upper, guess = (np.append(table.ravel(), end) for table, end in zip(tables, ends, strict=True))
        return lower, upper, guess


def _compiled(method: str, functions: dict[str, ca.MX], options: dict[str, Any]) -> ca.Function:
    """Emit the program's functions as C, compile them and give the library back to the solver."""
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder, "program.c"), Path(folder, "program.so")
        emitted = ca.nlpsol("solver", method, functions, options).generate_dependencies(source.name)
        Path(emitted).replace(source)
        subprocess.run([*COMPILER, "-w", str(source), "-o", str(library)], check=True)
        return ca.nlpsol("solver", method, str(library), options)
