"""scipy's trust-constr: trust-region SQP, sparse, with the exact Hessian of the Lagrangian.

Source: Byrd, Hribar and Nocedal (1999); Conn, Gould and Toint (2000), section 15.4.2.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import NonlinearConstraint, OptimizeResult, minimize

from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.drivers.shared import ScaledProblem, claim, minimised
from codegen.solving.loading import Case, ConnectModule, ControlModule, Vector
from codegen.solving.results.result import ConnectAttempt, ControlAttempt, Run

TOLERANCE = 1e-6
MAX_ITERATIONS = 1000

_GRADIENT_SMALL, _STEP_SMALL = 1, 2


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Minimise the cost, and return the attempt of trust-constr.

    The multipliers are the multipliers of trust-constr, or least-squares estimates if the estimates are more accurate.
    """
    problem = ScaledProblem.on_grid(module, run)
    with quiet_single_thread():
        equations = NonlinearConstraint(
            problem.constraints,
            0.0,
            0.0,
            jac=problem.jacobian,
            # scipy expects the Hessian of the equations without the Hessian of the cost.
            hess=lambda x, nu: problem.hessian(x, nu, 0.0),
        )
        solution = minimize(
            problem.cost,
            problem.inner_start,
            jac=problem.cost_gradient,
            hess=problem.hessian,
            constraints=[equations],
            bounds=problem.scipy_bounds,
            method="trust-constr",
            options={
                "maxiter": run.max_iterations or MAX_ITERATIONS,
                "gtol": 1e-9 if problem.scipy_bounds is None else 1e-11,
                "xtol": 1e-14,
                "barrier_tol": 1e-12,
            },
        )
        # Because of its barrier, unknowns have a distance from their bounds, and the multipliers of the method may be
        # more accurate than the least-squares estimates.
        nu = min(solution.v[0], problem.multipliers(solution.x), key=lambda nu: problem.unbalanced(solution.x, nu))
        unknowns = problem.unknowns(solution.x, nu)
    # At the level of rounding errors the method usually ends with a very small trust region, which is accepted here.
    # The residuals are checked later.
    status = "solved" if solution.status in (_GRADIENT_SMALL, _STEP_SMALL) else "iteration limit"
    status = status if np.isfinite(solution.fun) else "non-finite"
    return claim("trust-constr", status, int(solution.nit), unknowns, TOLERANCE)


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Minimise the discrete action of particles with exact second derivatives, and return the attempt."""
    return minimised(module, run, "trust-constr", _action)


def _action(module: ConnectModule, case: Case, start: Vector) -> OptimizeResult:
    none = np.zeros(case.steps * case.start.size)
    equations = NonlinearConstraint(
        lambda x: module.action_constraints(case, x),
        0.0,
        0.0,
        jac=lambda x: module.action_jacobian(case, x),
        hess=lambda x, v: module.action_hessian(case, x, v) - module.action_hessian(case, x, none),
    )
    return minimize(
        lambda x: module.action_cost(case, x),
        start,
        jac=lambda x: module.action_cost_gradient(case, x),
        hess=lambda x: module.action_hessian(case, x, none),
        constraints=[equations],
        method="trust-constr",
        options={"maxiter": 1000, "gtol": 1e-9, "xtol": 1e-13},
    )
