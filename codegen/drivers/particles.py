"""What scipy's drivers of particles share: what each can take, the discrete action, and what its answer is worth."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from codegen.drivers.quiet import quiet_single_thread
from codegen.errors import ArgumentError
from codegen.interfaces import ConnectModule, Vector
from codegen.solutions.connect import case_of
from codegen.solutions.result import ConnectAttempt, Run, max_norm

DENSE_LIMIT = 3000
"""Unknowns and equations of a dense method at most."""


def minimised(
    module: ConnectModule, run: Run, driver: str, minimise: Callable[[ConnectModule, Any, Vector], Any]
) -> ConnectAttempt:
    """The motion of least discrete action, by an optimiser of scipy; ArgumentError for what it cannot take."""
    require_method(module, driver, ("action",))
    case = case_of(module, run)
    if case.sigma.any():
        raise ArgumentError(f"driver {driver} meets targets exactly, and there is a sigma", "use newton")
    start = module.action_start(case)
    require_at_most(start.size + case.steps * case.start.size, DENSE_LIMIT, driver)
    with quiet_single_thread():
        found = minimise(module, case, start)
    return verdict(module, driver, case, module.action_path(case, found.x), int(found.nit), 1e-6, str(found.message))


def verdict(
    module: ConnectModule, driver: str, case: Any, path: Any, iterations: int, tolerance: float, reason: str
) -> ConnectAttempt:
    """Solved is what satisfies the equations, whatever the driver says about itself."""
    error = largest_error(module, case, path)
    if error <= tolerance:
        text = f"{driver} connects the points with residual {error:.1e} after {iterations} iterations"
        return ConnectAttempt("solved", text, iterations, path, tolerance)
    said = " ".join(str(reason).split())
    text = f"stalled: {driver} stopped with residual {error:.1e} ({said}); try driver newton, or more steps"
    return ConnectAttempt("stalled", text, iterations, path, tolerance)


def largest_error(module: ConnectModule, case: Any, path: Any) -> float:
    """The largest error of the equations on a path, and of its end."""
    errors, end = module.path_errors(case, path)
    return max(max_norm(errors.ravel()), max_norm(end))


def finite(values: Any) -> Any:
    """What is no number becomes large, so that a root finder turns back."""
    return np.nan_to_num(values, nan=1e3, posinf=1e3, neginf=-1e3)


def require_method(module: ConnectModule, driver: str, methods: tuple[str, ...]) -> None:
    """Refuse modules of another method, and of an integrator that chooses its own steps."""
    method = module.metadata.method
    if method not in methods:
        raise ArgumentError(f"driver {driver} does not solve method {method}", f"use --method {' or '.join(methods)}")
    if module.metadata.adaptive:
        raise ArgumentError(f"driver {driver} needs steps, and {module.metadata.scheme} chooses its own", "use newton")


def require_at_most(size: int, limit: int, driver: str) -> None:
    """Refuse problems that are too large for a driver."""
    if size > limit:
        raise ArgumentError(
            f"driver {driver} would have {size} unknowns and equations", f"take at most {limit}, or use newton"
        )
