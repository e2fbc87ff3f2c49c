"""Variational midpoint control in CasADi: the program that our generated solver solves, given to IPOPT and MUMPS.

With v = (q_{k+1} - q_k)/h and the interval's midpoint q,

    Ld = h L(q, v),    f- = f+ = h/2 f(q, v, u_k),    left = D1 Ld + f-,    right = D2 Ld + f+

    minimise    sum_k h C(q, v, u_k)
    subject to  D2L(q_0, v_0) + left_0 = 0
                right_{k-1} + left_k = 0                (k = 1..N-1)
                right_{N-1} - D2L(q_N, v_N) = 0

in the unknowns u_0, q_1, u_1, ..., q_{N-1}, u_{N-1}; q_0 and q_N are given, so they are left out. The guess is the
straight line between them, with u = 0.

What was tried for speed (orbital transfer, N = 300), and the choice made:

- Function.map over an SX interval function, then `expand` for CasADi's virtual machine: 45% less time than without.
- For compiled C no `expand`: the code stays a loop, gcc takes 2 s and not 60 s, and the run times agree within noise.
  The callbacks are then 15% to 30% of the run; expanded they were 3% at N = 300. The rest is IPOPT and MUMPS.
- MUMPS without scaling and with the AMD ordering, and no least-squares estimate of the first multipliers: together
  14% less time in as many iterations. The estimate costs one more factorisation.
- The other options of IPOPT (`mu_init`, refinement steps, `nlp_scaling_method`) changed less than the noise.
"""

import subprocess
import tempfile
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi as ca
import numpy as np

from .problems import PROBLEMS, ControlProblem

COMPILER = ["gcc", "-O3", "-march=native", "-shared", "-fPIC"]
IPOPT_OPTIONS: dict[str, Any] = {
    "print_time": False,
    "calc_lam_p": False,
    "error_on_fail": True,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.linear_solver": "mumps",
    "ipopt.hessian_approximation": "exact",
    "ipopt.mumps_scaling": 0,
    "ipopt.mumps_permuting_scaling": 0,
    "ipopt.mumps_pivot_order": 0,
    "ipopt.constr_mult_init_max": 0.0,
}


def interval_function(problem: ControlProblem, step: float) -> ca.Function:
    """One interval: (q_k, q_{k+1}, u_k) to (cost, left, right), as one CasADi function of scalars."""
    n = problem.dimension
    q0, q1, u = ca.SX.sym("q0", n), ca.SX.sym("q1", n), ca.SX.sym("u")
    middle, velocity = (q0 + q1) / 2, (q1 - q0) / step
    action = step * problem.lagrangian(ca.vertsplit(middle), ca.vertsplit(velocity))
    impulse = step / 2 * ca.vertcat(*problem.force(ca.vertsplit(middle), ca.vertsplit(velocity), u))
    cost = step * problem.cost(ca.vertsplit(middle), ca.vertsplit(velocity), u)
    left, right = ca.gradient(action, q0) + impulse, ca.gradient(action, q1) + impulse
    return ca.Function("interval", [q0, q1, u], [cost, left, right], {"cse": True})


def momentum(problem: ControlProblem, position: tuple[float, ...], velocity: tuple[float, ...]) -> ca.DM:
    """D2L at the given position and velocity, shape (n, 1)."""
    q, v = ca.SX.sym("q", problem.dimension), ca.SX.sym("v", problem.dimension)
    lagrangian = problem.lagrangian(ca.vertsplit(q), ca.vertsplit(v))
    return ca.Function("momentum", [q, v], [ca.gradient(lagrangian, v)])(position, velocity)


def nonlinear_program(problem: ControlProblem, steps: int) -> dict[str, ca.MX]:
    """The program of the module's docstring: unknowns x of shape (N - 1)(n + 1) + 1, cost f, constraints g."""
    n = problem.dimension
    x = ca.MX.sym("x", (steps - 1) * (n + 1) + 1)
    inner = ca.reshape(x[1:], n + 1, steps - 1)
    q = ca.horzcat(ca.DM(problem.start), inner[:n, :], ca.DM(problem.end))
    u = ca.horzcat(x[0], inner[n, :])
    interval = interval_function(problem, problem.duration / steps)
    cost, left, right = interval.map(steps)(q[:, :-1], q[:, 1:], u)
    first = momentum(problem, problem.start, problem.start_velocity)
    last = momentum(problem, problem.end, problem.end_velocity)
    return {"x": x, "f": ca.sum2(cost), "g": ca.vec(ca.horzcat(first, right) + ca.horzcat(left, -last))}


def initial_guess(problem: ControlProblem, steps: int) -> ca.DM:
    """The straight line between the two ends, with no control, in the order of the unknowns."""
    line = np.linspace(problem.start, problem.end, steps + 1)[1:-1]
    inner = np.hstack([line, np.zeros((steps - 1, 1))])
    return ca.DM(np.concatenate([[0.0], inner.ravel()]))


class PreparedControl:
    """A solver built once and run many times from the same guess.

    `run()` is the timed call; `report()` re-evaluates the last solution with functions the solver never saw.
    """

    def __init__(self, problem_name: str, steps: int, compiled: bool, tolerance: float = 1e-10) -> None:
        """Build the solver; KeyError if the problem is unknown, CalledProcessError if gcc refuses the code."""
        problem = PROBLEMS[problem_name]
        self.build_seconds, self.compile_seconds = 0.0, 0.0
        started = perf_counter()
        self.program = nonlinear_program(problem, steps)
        options = IPOPT_OPTIONS | {"ipopt.tol": tolerance}
        if compiled:
            self.solver = self._compiled_solver(options)
        else:
            self.solver = ca.nlpsol("solver", "ipopt", self.program, options | {"expand": True})
        self.build_seconds = perf_counter() - started
        self.guess = initial_guess(problem, steps)
        self.solution: dict[str, ca.DM] = {}

    def _compiled_solver(self, options: dict[str, Any]) -> ca.Function:
        """Emit the program's functions as C, compile them and give the library back to IPOPT."""
        with tempfile.TemporaryDirectory() as folder:
            source, library = Path(folder, "program.c"), Path(folder, "program.so")
            emitted = ca.nlpsol("solver", "ipopt", self.program, options).generate_dependencies(source.name)
            Path(emitted).replace(source)
            started = perf_counter()
            subprocess.run([*COMPILER, str(source), "-o", str(library)], check=True)
            self.compile_seconds = perf_counter() - started
            return ca.nlpsol("solver", "ipopt", str(library), options)

    def run(self) -> None:
        """Solve from the guess; RuntimeError from CasADi if IPOPT does not succeed."""
        self.solution = self.solver(x0=self.guess, lbg=0.0, ubg=0.0)

    def report(self) -> dict[str, Any]:
        """The cost, the largest constraint violation and stationarity defect, and IPOPT's account of the last run.

        `residual` is the larger of the two. None of them is scaled. `callback_seconds` is the part of the last run
        spent in the functions CasADi generated; the rest is IPOPT and MUMPS.
        """
        x, cost, constraints = self.program["x"], self.program["f"], self.program["g"]
        multipliers = ca.MX.sym("multipliers", constraints.shape[0])
        stationarity = ca.gradient(cost + ca.dot(multipliers, constraints), x)
        equations = ca.Function("equations", [x, multipliers], [cost, constraints, stationarity])
        value, violation, defect = equations(self.solution["x"], self.solution["lam_g"])
        feasibility, optimality = float(ca.norm_inf(violation)), float(ca.norm_inf(defect))
        statistics = self.solver.stats()
        return {
            "cost": float(value),
            "residual": max(feasibility, optimality),
            "feasibility": feasibility,
            "stationarity": optimality,
            "iterations": int(statistics["iter_count"]),
            "status": "solved" if statistics["success"] else str(statistics["return_status"]),
            "callback_seconds": sum(t for k, t in statistics.items() if k.startswith("t_wall_nlp_")),
        }


def solve(problem_name: str, steps: int, compiled: bool, repeat: int) -> dict[str, Any]:
    """Build, run once unmeasured, then take the best of `repeat` runs.

    Returns cost, residual, iterations, seconds (best warm run), build_seconds (all that precedes the first run) and
    compile_seconds (gcc's part of it), with the further entries of `PreparedControl.report`.
    """
    prepared = PreparedControl(problem_name, steps, compiled)
    prepared.run()
    seconds = []
    for _ in range(repeat):
        started = perf_counter()
        prepared.run()
        seconds.append(perf_counter() - started)
    times = {"seconds": min(seconds), "build_seconds": prepared.build_seconds}
    return prepared.report() | times | {"compile_seconds": prepared.compile_seconds}
