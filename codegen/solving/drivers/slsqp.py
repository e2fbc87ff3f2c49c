"""scipy's SLSQP: sequential quadratic programming with BFGS updates, dense. Source: Kraft (1988)."""

from __future__ import annotations

import numpy as np
from scipy.optimize import OptimizeResult, minimize

from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.drivers.shared import ScaledProblem, claim, largest_error, minimised, require_small
from codegen.solving.loading import Case, ConnectModule, ControlModule, Vector
from codegen.solving.results.result import ConnectAttempt, ControlAttempt, Run

TOLERANCE = 1e-6
LIMIT = 3000
MAX_ITERATIONS = 1000
ARRIVED = 1e-8
"""Residual of the equations of particles below which the search ends."""

_FAILURES = {2: "rank-deficient", 4: "infeasible", 5: "rank-deficient", 6: "rank-deficient", 9: "iteration limit"}


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Minimise the cost, and return the attempt of SLSQP with least-squares estimates of the multipliers."""
    problem = ScaledProblem.on_grid(module, run)
    require_small(problem.program, LIMIT, "slsqp")
    start = problem.program.x0
    equations = {"type": "eq", "fun": problem.constraints, "jac": lambda x: problem.jacobian(x).toarray()}
    # SLSQP compares absolute changes of the cost with ftol.
    ftol = 1e-12 * max(1.0, abs(problem.cost(start)))
    with quiet_single_thread():
        solution = minimize(
            problem.cost,
            start,
            jac=problem.cost_gradient,
            constraints=[equations],
            bounds=problem.scipy_bounds,
            method="SLSQP",
            options={"maxiter": run.max_iterations or MAX_ITERATIONS, "ftol": ftol},
        )
        unknowns = problem.unknowns(solution.x, problem.multipliers(solution.x))
    status = "solved" if solution.success else _FAILURES.get(int(solution.status), "stalled")
    status = status if np.isfinite(solution.fun) else "non-finite"
    return claim("SLSQP", status, int(solution.nit), unknowns, TOLERANCE, f" ({solution.message}); try driver newton")


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Minimise the discrete action of particles, and return the attempt of SLSQP."""
    return minimised(module, run, "slsqp", _action)


class _Arrived(Exception):
    """The exception that ends a search because the equations hold."""


def _action(module: ConnectModule, case: Case, start: Vector) -> OptimizeResult:
    """Minimise the discrete action until the equations hold, and return the result of scipy.

    The test of SLSQP itself would not end the search, because near the minimum changes of the cost are rounding errors.
    """
    equations = {
        "type": "eq",
        "fun": lambda x: module.action_constraints(case, x),
        "jac": lambda x: module.action_jacobian(case, x),
    }
    iterates: list[Vector] = []

    def stop(x: Vector) -> None:
        iterates.append(x.copy())
        if largest_error(module, case, module.action_path(case, x)) <= ARRIVED:
            raise _Arrived

    try:
        return minimize(
            lambda x: module.action_cost(case, x),
            start,
            jac=lambda x: module.action_cost_gradient(case, x),
            constraints=[equations],
            method="SLSQP",
            callback=stop,
            options={"maxiter": MAX_ITERATIONS, "ftol": 1e-16 * max(1.0, abs(module.action_cost(case, start)))},
        )
    except _Arrived:
        return OptimizeResult(x=iterates[-1], nit=len(iterates), message="the equations hold")
