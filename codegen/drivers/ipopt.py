"""IPOPT through cyipopt, with exact sparse Hessians: an interior point method from outside, to compare with.

Source: Waechter and Biegler (2006), On the implementation of an interior-point filter line-search algorithm for
large-scale nonlinear programming. cyipopt is an extra: `pip install variational-codegen[ipopt]`.
"""

from __future__ import annotations

import math
from time import perf_counter
from typing import Any

import numpy as np

from codegen.drivers.quiet import quiet_single_thread
from codegen.drivers.scaled import ScaledProblem, claim
from codegen.errors import ArgumentError
from codegen.interfaces import ControlModule, Vector
from codegen.runtime.search.messages import not_finite
from codegen.solutions.result import ControlAttempt, Run

TOLERANCE = 1e-8
MAX_ITERATIONS = 3000
OTHER = "try driver newton"
NOT_FINITE = "change the guess or the parameters, or keep away from there by bounds"
REMEDIES = {"iteration limit": f"raise max_iterations, or {OTHER}", "time limit": f"raise time_limit, or {OTHER}"}

_STATUSES = {
    0: "solved", 1: "solved", 2: "infeasible", 4: "unbounded", 5: "time limit", -1: "iteration limit",
    -10: "rank-deficient", -13: "non-finite",
}  # fmt: skip
"""IPOPT's return codes; what is missing here counts as stalled."""
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
"""What other codes mean, by IPOPT's documentation of its return statuses; the rest are errors inside it."""


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Minimise the cost with IPOPT's own defaults. Raises ArgumentError when cyipopt is not installed.

    The defaults include its scaling, its limit of iterations and bounds that it relaxes by 1e-8 of their size; the
    solution is moved back onto the bounds.
    """
    try:
        import cyipopt  # type: ignore[import-not-found, import-untyped, unused-ignore]
    except ImportError:
        raise ArgumentError(
            "driver ipopt needs the package cyipopt", "install variational-codegen[ipopt], or use another driver"
        ) from None
    problem = ScaledProblem.on_grid(module, run, is_scaled=False)
    lower, upper = problem.bounds
    zero = np.zeros(problem.dual.size)
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    with quiet_single_thread():
        callbacks = _Callbacks(problem, run.time_limit)
        program = cyipopt.Problem(problem.primal.size, problem.dual.size, callbacks, lower, upper, zero, zero)
        options = {
            "print_level": 0,
            "sb": "yes",
            "tol": float(tolerance),
            "max_iter": run.max_iterations or MAX_ITERATIONS,
            "honor_original_bounds": "yes",
        }
        for name, value in options.items():
            program.add_option(name, value)
        x, details = program.solve(problem.start)
    code = int(details["status"])
    status = _STATUSES.get(code, "stalled")
    unknowns = problem.unknowns(x, details["mult_g"])
    reason = _cause(problem, code, x, callbacks.iterations)
    if reason:
        message = f"{status}: {reason}"
        return ControlAttempt(status, message, callbacks.iterations, unknowns, 10 * tolerance, is_explained=True)
    why = f": {_REASONS.get(code, f'an error inside it, {code}')}" if status == "stalled" else ""
    remedy = f"{why}; {REMEDIES.get(status, OTHER)}"
    return claim("IPOPT", status, callbacks.iterations, unknowns, 10 * tolerance, remedy)


def _cause(problem: ScaledProblem, code: int, x: Vector, iterations: int) -> str:
    """What was wrong and the remedy, where that is not an equation which does not hold; else nothing."""
    if code == _TOO_FEW_UNKNOWNS:
        lower, upper = problem.bounds
        sizes = f"{np.count_nonzero(lower < upper)} unknowns for {problem.dual.size} equations"
        return f"IPOPT takes no problem with fewer unknowns than equations, {sizes}; leave out conditions, or {OTHER}"
    if code == _NOT_FINITE:
        point = problem.module.evaluate(problem.grid, problem.unknowns(x))
        where = "at the guess" if not iterations else f"after {iterations} iterations of IPOPT"
        return f"{not_finite(problem.grid, point)} {where}; {NOT_FINITE}"
    return ""


class _Callbacks:
    """The problem under the names that cyipopt asks for; sparse matrices have one pattern for all points.

    After `time_limit` seconds IPOPT is told to stop: its own limit is one of the processor's time, before IPOPT 3.14.
    """

    def __init__(self, problem: ScaledProblem, time_limit: float = math.inf) -> None:
        self.problem, self.iterations, self.late = problem, 0, perf_counter() + time_limit
        module, grid, base = problem.module, problem.grid, problem.base
        self.jacobian_pattern = module.jacobian(grid, base)[:2]
        rows, columns, _ = module.hessian(grid, base)
        self.is_lower = rows >= columns
        self.hessian_pattern = rows[self.is_lower], columns[self.is_lower]

    def objective(self, x: Vector) -> float:
        return self.problem.cost(x)

    def gradient(self, x: Vector) -> Vector:
        return self.problem.cost_gradient(x)

    def constraints(self, x: Vector) -> Vector:
        return self.problem.constraints(x)

    def jacobianstructure(self) -> Any:
        return self.jacobian_pattern

    def jacobian(self, x: Vector) -> Vector:
        problem = self.problem
        rows, _, values = problem.module.jacobian(problem.grid, problem.unknowns(x))
        return values * problem.row_scale[rows]

    def hessianstructure(self) -> Any:
        return self.hessian_pattern

    def hessian(self, x: Vector, nu: Vector, weight: float) -> Vector:
        problem = self.problem
        module, grid = problem.module, problem.grid
        values = module.hessian(grid, problem.unknowns(x, nu))[2]
        if weight != 1.0:
            values = values + (weight - 1.0) * module.hessian(grid, problem.unknowns(x))[2]
        return problem.cost_scale * values[self.is_lower]

    def intermediate(self, _mode: int, iterations: int, *_measures: float) -> bool:
        self.iterations = iterations
        return perf_counter() < self.late
