"""Connect problems by every driver: the generated solver, scipy's root finders, minimisers and adaptive integrators."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.optimize
from scipy.optimize import NonlinearConstraint

from codegen.drivers.adaptive import adaptive
from codegen.drivers.scaled import quiet_single_thread
from codegen.errors import ArgumentError
from codegen.loading import ConnectModule, Vector
from codegen.solutions.connect import case_of
from codegen.solutions.result import ConnectAttempt, Run, max_norm

_DENSE_LIMIT = 3000
_ROUNDED = 1e-9  # neighbours that move apart have momenta so large that rounding errors of positions come near to this
_SIMPLEX_LIMIT = 24


def newton(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Call the module's solver, or integrate adaptively where the scheme says so."""
    if module.metadata["adaptive"]:
        return adaptive(module, case_of(module, run), run)
    case = case_of(module, run)
    with quiet_single_thread():
        solution = module.solve_case(case)
    path = np.stack([solution.q, solution.p], axis=1)
    tolerance = max(case.tolerance, _ROUNDED)
    return ConnectAttempt(
        solution.status, solution.message, solution.iterations, path, tolerance, solution.attempts, solution.tangents
    )


def fsolve(module: ConnectModule, run: Run) -> ConnectAttempt:
    """MINPACK's hybrid method on the module's equations, with their generated Jacobian."""
    _require_method(module, "fsolve", ("stepping", "full"))
    case = case_of(module, run)
    shooting = module.metadata["method"] == "stepping"
    size = case.start.size if shooting else 2 * case.start.size * case.steps
    _require_at_most(size, _DENSE_LIMIT, "fsolve")
    equations = module.residual if shooting else module.all_equations
    derivative = module.jacobian if shooting else module.all_equations_jacobian
    start = module.first_momenta(case).ravel() if shooting else module.first_unknowns(case)
    with quiet_single_thread():
        found, details, _, reason = scipy.optimize.fsolve(
            lambda y: _finite(equations(case, y)), start, fprime=lambda y: _finite(derivative(case, y)),
            full_output=True, xtol=1e-13,
        )  # fmt: skip
    path = module.trajectory(case, found)[1] if shooting else module.path_of(case, found)
    return _verdict(module, "fsolve", case, path, int(details["nfev"]), 1e-8, reason)


def fmin(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Nelder and Mead's simplex method on the squared distance of the arrival from the targets."""
    _require_method(module, "fmin", ("stepping",))
    case = case_of(module, run)
    _require_at_most(case.start.size, _SIMPLEX_LIMIT, "fmin")
    start = module.first_momenta(case).ravel()

    def distance(momenta: Vector) -> float:
        value = float(np.sum(module.residual(case, momenta) ** 2))
        return value if np.isfinite(value) else 1e10

    with quiet_single_thread():
        found = scipy.optimize.minimize(
            distance, start, method="Nelder-Mead",
            options={"maxiter": 400 * start.size, "maxfev": 800 * start.size, "xatol": 1e-10, "fatol": 1e-18,
                     "adaptive": start.size > 6},
        )  # fmt: skip
    return _verdict(module, "fmin", case, module.trajectory(case, found.x)[1], int(found.nit), 1e-6, found.message)


def slsqp(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Kraft's sequential least-squares programming on the discrete action."""
    return _minimised(module, run, "slsqp", _by_slsqp)


def trust_constr(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Trust-region SQP on the discrete action, with exact second derivatives."""
    return _minimised(module, run, "trust-constr", _by_trust_constr)


def _minimised(module: ConnectModule, run: Run, driver: str, minimise: Callable[..., Any]) -> ConnectAttempt:
    _require_method(module, driver, ("action",))
    case = case_of(module, run)
    if case.sigma.any():
        raise ArgumentError(f"driver {driver} meets targets exactly, and there is a sigma", "use newton")
    start = module.action_start(case)
    _require_at_most(start.size + case.steps * case.start.size, _DENSE_LIMIT, driver)
    with quiet_single_thread():
        found = minimise(module, case, start)
    return _verdict(module, driver, case, module.action_path(case, found.x), int(found.nit), 1e-6, str(found.message))


def _by_slsqp(module: ConnectModule, case: Any, start: Vector) -> Any:
    equations = {
        "type": "eq",
        "fun": lambda x: module.action_constraints(case, x),
        "jac": lambda x: module.action_jacobian(case, x),
    }
    return scipy.optimize.minimize(
        lambda x: module.action_cost(case, x),
        start,
        jac=lambda x: module.action_cost_gradient(case, x),
        constraints=[equations],
        method="SLSQP",
        options={"maxiter": 1000, "ftol": 1e-14 * max(1.0, abs(module.action_cost(case, start)))},
    )


def _by_trust_constr(module: ConnectModule, case: Any, start: Vector) -> Any:
    none = np.zeros(case.steps * case.start.size)
    equations = NonlinearConstraint(
        lambda x: module.action_constraints(case, x),
        0.0,
        0.0,
        jac=lambda x: module.action_jacobian(case, x),
        hess=lambda x, v: module.action_hessian(case, x, v) - module.action_hessian(case, x, none),
    )
    return scipy.optimize.minimize(
        lambda x: module.action_cost(case, x),
        start,
        jac=lambda x: module.action_cost_gradient(case, x),
        hess=lambda x: module.action_hessian(case, x, none),
        constraints=[equations],
        method="trust-constr",
        options={"maxiter": 1000, "gtol": 1e-9, "xtol": 1e-13},
    )


def _verdict(
    module: ConnectModule, driver: str, case: Any, path: Any, iterations: int, tolerance: float, reason: str
) -> ConnectAttempt:
    """Solved is what satisfies the equations, whatever the driver says about itself."""
    errors, end = module.path_errors(case, path)
    error = max(max_norm(errors.ravel()), max_norm(end))
    if error <= tolerance:
        text = f"{driver} connects the points with residual {error:.1e} after {iterations} iterations"
        return ConnectAttempt("solved", text, iterations, path, tolerance)
    said = " ".join(str(reason).split())
    text = f"stalled: {driver} stopped with residual {error:.1e} ({said}); try driver newton, or more steps"
    return ConnectAttempt("stalled", text, iterations, path, tolerance)


def _finite(values: Any) -> Any:
    """What is no number becomes large, so that a root finder turns back."""
    return np.nan_to_num(values, nan=1e3, posinf=1e3, neginf=-1e3)


def _require_method(module: ConnectModule, driver: str, methods: tuple[str, ...]) -> None:
    method = module.metadata["method"]
    if method not in methods:
        raise ArgumentError(f"driver {driver} does not solve method {method}", f"use --method {' or '.join(methods)}")
    if module.metadata["adaptive"]:
        raise ArgumentError(
            f"driver {driver} needs steps, and {module.metadata['scheme']} chooses its own", "use newton"
        )


def _require_at_most(size: int, limit: int, driver: str) -> None:
    if size > limit:
        raise ArgumentError(
            f"driver {driver} would have {size} unknowns and equations", f"take at most {limit}, or use newton"
        )
