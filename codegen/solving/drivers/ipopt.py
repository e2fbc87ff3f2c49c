"""IPOPT through cyipopt, with exact sparse Hessians: an independent interior point method for comparison.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming. cyipopt is an extra: `pip install cyipopt`.
"""

from __future__ import annotations

import math
from time import perf_counter

import numpy as np
from scipy.sparse import sparray, tril

from codegen.errors import ArgumentError
from codegen.runtime.search.messages import not_finite
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.drivers.shared import claim, program_on_grid
from codegen.solving.loading import ControlModule, Indices, NonlinearProgram, Vector
from codegen.solving.results.result import ControlAttempt, Run

TOLERANCE = 1e-8
MAX_ITERATIONS = 3000
OTHER = "try driver newton"
NOT_FINITE = "change the guess or the parameters, or keep away from there by bounds"
REMEDIES = {"iteration limit": f"raise max_iterations, or {OTHER}", "time limit": f"raise time_limit, or {OTHER}"}

_STATUSES = {
    0: "solved", 1: "solved", 2: "infeasible", 4: "unbounded", 5: "time limit", -1: "iteration limit",
    -10: "rank-deficient", -13: "non-finite",
}  # fmt: skip
"""Termination statuses by the return codes of IPOPT; all other codes have the status "stalled"."""
_TOO_FEW_UNKNOWNS, _NOT_FINITE = -10, -13
_REASONS = {
    3: "its steps have become too small",
    6: "it looks for no optimum where there are as many equations as unknowns",
    -2: "its restoration of feasibility failed",
    -3: "it could compute no step",
    -11: "it takes the problem for no valid one",
    -12: "it does not take an option",
    -102: "there is not enough memory",
}
"""Meanings of other return codes from IPOPT's documentation; all codes without a meaning are internal errors."""


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Minimise the cost with the default options of IPOPT, and return its attempt.

    The defaults include the scaling and the iteration limit of IPOPT, and bounds that are relaxed by a relative 1e-8.
    The solution is projected onto the bounds. Raise ArgumentError if cyipopt is not installed.
    """
    try:
        import cyipopt  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        raise ArgumentError(
            "driver ipopt needs the package cyipopt", "pip install cyipopt, or use another driver"
        ) from None
    program = program_on_grid(module, run)
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    with quiet_single_thread():
        callbacks, limits = _Callbacks(program, run.time_limit), (*program.bounds, *program.constraint_bounds)
        solver = cyipopt.Problem(program.primal.size, program.dual.size, callbacks, *limits)
        options = {
            "print_level": 0,
            "sb": "yes",
            "tol": float(tolerance),
            "max_iter": run.max_iterations or MAX_ITERATIONS,
            "honor_original_bounds": "yes",
        }
        for name, value in options.items():
            solver.add_option(name, value)
        x, details = solver.solve(program.x0)
    code = int(details["status"])
    status = _STATUSES.get(code, "stalled")
    unknowns = program.unknowns(x, details["mult_g"])
    reason = _cause(program, code, x, callbacks.iterations)
    if reason:
        message = f"{status}: {reason}"
        return ControlAttempt(status, message, callbacks.iterations, unknowns, 10 * tolerance, is_explained=True)
    why = f": {_REASONS.get(code, f'an error inside it, {code}')}" if status == "stalled" else ""
    remedy = f"{why}; {REMEDIES.get(status, OTHER)}"
    return claim("IPOPT", status, callbacks.iterations, unknowns, 10 * tolerance, remedy)


def _cause(program: NonlinearProgram, code: int, x: Vector, iterations: int) -> str:
    """Return the text of the cause and the remedy for the return codes of an invalid problem; empty for other codes."""
    if code == _TOO_FEW_UNKNOWNS:
        lower, upper = program.bounds
        sizes = f"{np.count_nonzero(lower < upper)} unknowns for {program.dual.size} equations"
        return f"IPOPT takes no problem with fewer unknowns than equations, {sizes}; leave out conditions, or {OTHER}"
    if code == _NOT_FINITE:
        point = program.evaluate(x)
        where = "at the guess" if not iterations else f"after {iterations} iterations of IPOPT"
        return f"{not_finite(program.grid, point)} {where}; {NOT_FINITE}"
    return ""


def _pattern(matrix: sparray) -> tuple[Indices, Indices]:
    entries = matrix.tocoo()
    return entries.row, entries.col


class _Callbacks:
    """The problem as an object with the methods that cyipopt calls; sparse matrices have the same pattern everywhere.

    IPOPT stops after `time_limit` seconds. The time limit of IPOPT itself is not used, because it was a limit of
    processor time before IPOPT 3.14.
    """

    def __init__(self, program: NonlinearProgram, time_limit: float = math.inf) -> None:
        self.program, self.iterations, self.late = program, 0, perf_counter() + time_limit
        self.objective, self.gradient, self.constraints = program.cost, program.gradient, program.constraints

    def jacobianstructure(self) -> tuple[Indices, Indices]:
        return _pattern(self.program.jacobian(self.program.x0))

    def jacobian(self, x: Vector) -> Vector:
        return np.asarray(self.program.jacobian(x).data)

    def hessianstructure(self) -> tuple[Indices, Indices]:
        return _pattern(tril(self.program.hessian(self.program.x0)))

    def hessian(self, x: Vector, multipliers: Vector, weight: float) -> Vector:
        return np.asarray(tril(self.program.hessian(x, multipliers, weight)).data)

    def intermediate(self, _mode: int, iterations: int, *_measures: float) -> bool:
        self.iterations = iterations
        return perf_counter() < self.late
