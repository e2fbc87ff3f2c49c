"""Shooting through scipy's adaptive integrators, with Newton's matrix from the module's own fixed steps.

The matrix differs from the exact one by the error of the fixed steps only, so that the iteration converges by about
that factor each time and costs one adaptive trajectory for each iteration.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from codegen.drivers.quiet import quiet_single_thread
from codegen.interfaces import ConnectModule, Vector
from codegen.solutions.result import ConnectAttempt, Run, max_norm

TOLERANCE = 1e-8
"""Relative and absolute error of each adaptive step, unless asked otherwise."""
_MAX_ITERATIONS, _HALVINGS = 60, 10


def integrated(module: ConnectModule, case: Any, momenta: Vector, code: str, tolerance: float) -> tuple[Any, int]:
    """States at the nodes, shape (N + 1, 2, n, d), and how often the field was evaluated; NaN where scipy gives up."""
    shape = (2, *case.start.shape)
    gradient = np.empty(shape)

    def field(_: float, z: Vector) -> Vector:
        module.hamiltonian_gradient(np.ascontiguousarray(z).reshape(shape), case.own, case.parameters, gradient)
        return np.concatenate([gradient[1].ravel(), -gradient[0].ravel()])

    start = np.concatenate([case.start.ravel(), np.ravel(momenta)])
    times = np.linspace(0.0, case.duration, case.steps + 1)
    from scipy.integrate import solve_ivp  # only now: no other driver needs it

    found = solve_ivp(
        field, (0.0, case.duration), start, method=code, t_eval=times, rtol=max(tolerance, 2.3e-14), atol=tolerance
    )
    path = np.full((case.steps + 1, *shape), np.nan)
    if found.success:
        path[:] = found.y.T.reshape(path.shape)
    return path, int(found.nfev)


def adaptive(module: ConnectModule, case: Any, run: Run) -> ConnectAttempt:
    """Find the initial momenta from which the adaptive integrator arrives; iterations are those of Newton's method."""
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    code = module.metadata.adaptive
    with quiet_single_thread():
        begin = module.solve_case(case)
        momenta, factor = begin.p[0], module.preconditioner(case)
        path, evaluations = integrated(module, case, momenta, code, tolerance)
        error = _error(module, case, path)
        for iterations in range(1, _MAX_ITERATIONS + 1):  # noqa: B007  it is reported below
            if error <= 1e-13:
                break
            _, _, points = module.trajectory(case, momenta)
            linear = module.Linearised(case, points, factor)
            change = linear.solved(-module.end_residual(path[-1], case.target, case.sigma), 1e-3)
            length, found = 1.0, False
            for _ in range(_HALVINGS):
                trial = momenta + length * change.reshape(momenta.shape)
                trial_path, count = integrated(module, case, trial, code, tolerance)
                evaluations += count
                trial_error = _error(module, case, trial_path)
                if trial_error < error:
                    found = True
                    break
                if error <= max(1e-11, tolerance):
                    break
                length *= 0.5
            if not found:
                break
            momenta, path, error = trial, trial_path, trial_error
    status = "solved" if error <= max(1e-10, tolerance) else "stalled"
    text = f"{code} at tolerance {tolerance:g} arrives within {error:.1e} after {evaluations} evaluations of the field"
    message = text if status == "solved" else f"stalled: {text}; try a smaller tolerance"
    return ConnectAttempt(status, message, iterations, path, max(1e-10, tolerance), begin.attempts, generated=True)


def _error(module: ConnectModule, case: Any, path: Any) -> float:
    return max_norm(module.end_residual(path[-1], case.target, case.sigma))
