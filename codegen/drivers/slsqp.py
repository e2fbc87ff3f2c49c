"""scipy's SLSQP: sequential quadratic programming with BFGS updates, dense. Source: Kraft (1988)."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.optimize import minimize

from codegen.drivers.particles import minimised
from codegen.drivers.scaled import ScaledProblem, claim, quiet_single_thread, require_small
from codegen.interfaces import ConnectModule, ControlModule, Vector
from codegen.solutions.result import ConnectAttempt, ControlAttempt, Run

TOLERANCE = 1e-6
LIMIT = 3000
MAX_ITERATIONS = 1000

_FAILURES = {2: "rank-deficient", 4: "infeasible", 5: "rank-deficient", 6: "rank-deficient", 9: "iteration limit"}


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Minimise the cost; multipliers are the least-squares estimate at the solution."""
    problem = ScaledProblem.on_grid(module, run)
    require_small(problem.program, LIMIT, "slsqp")
    start = problem.program.x0
    equations = {"type": "eq", "fun": problem.constraints, "jac": lambda x: problem.jacobian(x).toarray()}
    # SLSQP compares changes of the cost with ftol itself.
    ftol = 1e-12 * max(1.0, abs(problem.cost(start)))
    with quiet_single_thread():
        found = minimize(
            problem.cost,
            start,
            jac=problem.cost_gradient,
            constraints=[equations],
            bounds=problem.scipy_bounds,
            method="SLSQP",
            options={"maxiter": run.max_iterations or MAX_ITERATIONS, "ftol": ftol},
        )
        unknowns = problem.unknowns(found.x, problem.multipliers(found.x))
    status = "solved" if found.success else _FAILURES.get(int(found.status), "stalled")
    status = status if np.isfinite(found.fun) else "non-finite"
    return claim("SLSQP", status, int(found.nit), unknowns, TOLERANCE, f" ({found.message}); try driver newton")


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Minimise the discrete action of particles."""
    return minimised(module, run, "slsqp", _action)


def _action(module: ConnectModule, case: Any, start: Vector) -> Any:
    equations = {
        "type": "eq",
        "fun": lambda x: module.action_constraints(case, x),
        "jac": lambda x: module.action_jacobian(case, x),
    }
    return minimize(
        lambda x: module.action_cost(case, x),
        start,
        jac=lambda x: module.action_cost_gradient(case, x),
        constraints=[equations],
        method="SLSQP",
        options={"maxiter": 1000, "ftol": 1e-14 * max(1.0, abs(module.action_cost(case, start)))},
    )
