"""The generated solver: structured Newton on the KKT system, steps of a simulation, or shooting of particles.

For adaptive schemes, shooting integrates with scipy. Newton's matrix comes from the fixed steps of the module. It
differs from the exact matrix by the error of the fixed steps. The iteration contracts by about that factor, and costs
one adaptive trajectory for each iteration.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np

from codegen.errors import ArgumentError
from codegen.solving.drivers.shared import quiet_single_thread
from codegen.solving.loading import ConnectModule, ControlModule, SimulateModule, Vector, is_of_particles
from codegen.solving.results.motions import case_of
from codegen.solving.results.result import ConnectAttempt, ControlAttempt, Run, SimulateAttempt, max_norm

ADAPTIVE_TOLERANCE = 1e-8
"""Default relative and absolute error of each adaptive step."""
_MAX_ITERATIONS, _HALVINGS = 60, 10


def integrated(module: ConnectModule, case: Any, momenta: Vector, code: str, tolerance: float) -> tuple[Any, int]:
    """Return the states at the nodes, (N + 1, 2, n, d), and the evaluations of the field; NaN if scipy fails."""
    shape = (2, *case.start.shape)
    gradient = np.empty(shape)

    def field(_: float, z: Vector) -> Vector:
        module.hamiltonian_gradient(np.ascontiguousarray(z).reshape(shape), case.own, case.parameters, gradient)
        return np.concatenate([gradient[1].ravel(), -gradient[0].ravel()])

    start = np.concatenate([case.start.ravel(), np.ravel(momenta)])
    times = np.linspace(0.0, case.duration, case.steps + 1)
    from scipy.integrate import solve_ivp  # no other driver needs it

    solution = solve_ivp(
        field, (0.0, case.duration), start, method=code, t_eval=times, rtol=max(tolerance, 2.3e-14), atol=tolerance
    )
    path = np.full((case.steps + 1, *shape), np.nan)
    if solution.success:
        path[:] = solution.y.T.reshape(path.shape)
    return path, int(solution.nfev)


def adaptive(module: ConnectModule, case: Any, run: Run) -> ConnectAttempt:
    """Find the initial momenta from which the adaptive integrator arrives; iterations are those of Newton's method."""
    tolerance = ADAPTIVE_TOLERANCE if run.tolerance is None else run.tolerance
    code = module.metadata.adaptive
    with quiet_single_thread():
        begin = module.solve_case(case)
        momenta, factor = begin.p[0], module.preconditioner(case)
        path, evaluations = integrated(module, case, momenta, code, tolerance)
        error = _error(module, case, path)
        for iterations in range(1, _MAX_ITERATIONS + 1):  # noqa: B007  reported below
            if error <= 1e-13:
                break
            _, _, points = module.trajectory(case, momenta)
            linear = module.Linearised(case, points, factor)
            change = linear.solved(-module.end_residual(path[-1], case.target, case.sigma), 1e-3)
            length, is_smaller = 1.0, False
            for _ in range(_HALVINGS):
                trial = momenta + length * change.reshape(momenta.shape)
                trial_path, count = integrated(module, case, trial, code, tolerance)
                evaluations += count
                trial_error = _error(module, case, trial_path)
                if trial_error < error:
                    is_smaller = True
                    break
                if error <= max(1e-11, tolerance):
                    break
                length *= 0.5
            if not is_smaller:
                break
            momenta, path, error = trial, trial_path, trial_error
    status = "solved" if error <= max(1e-10, tolerance) else "stalled"
    text = f"{code} at tolerance {tolerance:g} arrives within {error:.1e} after {evaluations} evaluations of the field"
    message = text if status == "solved" else f"stalled: {text}; try a smaller tolerance"
    return ConnectAttempt(status, message, iterations, path, max(1e-10, tolerance), begin.attempts, generated=True)


def _error(module: ConnectModule, case: Any, path: Any) -> float:
    return max_norm(module.end_residual(path[-1], case.target, case.sigma))


TOLERANCE = 1e-10
_ROUNDED = 1e-9  # neighbours that move apart have momenta so large that rounding errors of positions come near to this
_OWN = ("tolerance", "trajectories", "scaled", "is_explained", "generated")
"""Fields of an attempt that a solution of a module does not have, or does not have in earlier versions."""
_CLAIMED: dict[type, tuple[str, ...]] = {
    attempt: tuple(f.name for f in fields(attempt) if f.name not in _OWN)
    for attempt in (ControlAttempt, SimulateAttempt)
}


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Call `solve` of the module."""
    warm = run.guess is not None and run.near
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    options: dict[str, Any] = {"max_iterations": run.max_iterations, "time_limit": run.time_limit}
    options |= {"watch": run.watch, "scaling": run.scaling}
    options = {name: value for name, value in options.items() if value not in (None, math.inf, "auto")}
    if run.grid is not None:
        options["grid"] = run.grid
    solution = module.solve(steps=run.steps, guess=run.guess, warm=warm, tolerance=tolerance, **options)
    trajectories = (solution.t, solution.q, solution.p, solution.u, solution.multipliers)
    scaled = getattr(solution, "scaled", None)
    return ControlAttempt(
        **_claimed(ControlAttempt, solution), tolerance=tolerance, trajectories=trajectories, scaled=scaled,
        generated=True,
    )  # fmt: skip


def simulate(module: SimulateModule, run: Run) -> SimulateAttempt:
    """Call `solve` of the module; raise ArgumentError for an iteration limit of particles, whose module has its own."""
    limit = {} if run.max_iterations is None else {"max_iterations": run.max_iterations}
    if limit and is_of_particles(module):
        raise ArgumentError("--max-iterations of particles, whose module limits Newton's method itself", "leave it out")
    solution = module.solve(steps=run.steps, every=run.every, **limit)
    return SimulateAttempt(**_claimed(SimulateAttempt, solution), tolerance=TOLERANCE, generated=True)


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Call `solve_case` of the module, or integrate adaptively if the scheme is adaptive."""
    case = case_of(module, run)
    if module.metadata.adaptive:
        return adaptive(module, case, run)
    with quiet_single_thread():
        solution = module.solve_case(case)
    path = np.stack([solution.q, solution.p], axis=1)
    tolerance = max(case.tolerance, _ROUNDED)
    return ConnectAttempt(
        solution.status, solution.message, solution.iterations, path, tolerance, solution.attempts, solution.tangents,
        generated=True,
    )  # fmt: skip


def _claimed(attempt: type[ControlAttempt | SimulateAttempt], solution: Any) -> dict[str, Any]:
    """Return the fields of an attempt that a solution of a module has under the same names."""
    return {name: getattr(solution, name) for name in _CLAIMED[attempt]}
