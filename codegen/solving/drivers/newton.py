"""The generated solver: Newton's method on the structured KKT system, time steps of a simulation, or shooting.

Shooting connects particles. For adaptive schemes scipy integrates the trajectories. The matrix of Newton's method is
computed from the fixed steps of the module, and differs from the exact matrix by their discretisation error. The
iteration contracts by about this error. Each iteration takes at least one adaptive trajectory.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np

from codegen.errors import ArgumentError
from codegen.solving.drivers.quiet import quiet_single_thread
from codegen.solving.loading import Case, ConnectModule, ControlModule, Matrix, SimulateModule, Vector, is_of_particles
from codegen.solving.results.motions import case_of
from codegen.solving.results.result import ConnectAttempt, ControlAttempt, Run, SimulateAttempt, max_norm

ADAPTIVE_TOLERANCE = 1e-8
"""Default relative and absolute error tolerance of each adaptive step."""
_MAX_ITERATIONS, _HALVINGS = 60, 10
"""Largest number of Newton steps, and of halvings of each step."""


def integrated(module: ConnectModule, case: Case, momenta: Vector, code: str, tolerance: float) -> tuple[Matrix, int]:
    """Return the states at the nodes (N + 1, 2, n, d), and the number of evaluations of the Hamiltonian field.

    `momenta` are the initial momenta, and `code` is the name of an integrator of scipy. The states are NaN if scipy
    fails.
    """
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


def adaptive(module: ConnectModule, case: Case, run: Run) -> ConnectAttempt:
    """Return the motion of particles whose initial momenta lead to the targets with an adaptive integrator."""
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


def _error(module: ConnectModule, case: Case, path: Matrix) -> float:
    return max_norm(module.end_residual(path[-1], case.target, case.sigma))


TOLERANCE = 1e-10
"""Default tolerance of the generated solver."""
_ROUNDED = 1e-9
"""Least tolerance of the arrival of particles.

Neighbours that move apart have large momenta, so that rounding errors of positions come close to this value.
"""
_OWN = ("tolerance", "trajectories", "scaled", "is_explained", "generated", "events")
"""Fields of an attempt that are not copied from the return value of `solve` of a module."""
_CLAIMED: dict[type, tuple[str, ...]] = {
    attempt: tuple(f.name for f in fields(attempt) if f.name not in _OWN)
    for attempt in (ControlAttempt, SimulateAttempt)
}
"""Fields of an attempt that are copied from the return value of `solve` of a module."""


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Call `solve` of the module; return the attempt."""
    warm = run.guess is not None and run.near
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    options: dict[str, object] = {"max_iterations": run.max_iterations, "time_limit": run.time_limit}
    options |= {"watch": run.watch, "scaling": run.scaling}
    options = {name: value for name, value in options.items() if value not in (None, math.inf, "auto")}
    if run.grid is not None:
        options["grid"] = run.grid
    solution = module.solve(steps=run.steps, guess=run.guess, warm=warm, tolerance=tolerance, **options)
    trajectories = (solution.t, solution.q, solution.p, solution.u, solution.multipliers)
    return ControlAttempt(
        **_claimed(ControlAttempt, solution), tolerance=tolerance, trajectories=trajectories, scaled=solution.scaled,
        generated=True,
    )  # fmt: skip


def simulate(module: SimulateModule, run: Run) -> SimulateAttempt:
    """Call `solve` of the module; return the attempt.

    Raise ArgumentError for an iteration limit for particles, because their modules use a limit of their own.
    """
    limit = {} if run.max_iterations is None else {"max_iterations": run.max_iterations}
    if limit and is_of_particles(module):
        raise ArgumentError("--max-iterations of particles, whose module limits Newton's method itself", "leave it out")
    solution = module.solve(steps=run.steps, every=run.every, **limit)
    events = getattr(solution, "events", None)  # particles have none
    return SimulateAttempt(**_claimed(SimulateAttempt, solution), tolerance=TOLERANCE, events=events, generated=True)


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Call `solve_case` of the module, or integrate with scipy if the scheme is adaptive; return the attempt."""
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


def _claimed(attempt: type[ControlAttempt | SimulateAttempt], solution: object) -> dict[str, Any]:
    """Return the fields of an attempt that are copied from the return value of `solve` of a module."""
    return {name: getattr(solution, name) for name in _CLAIMED[attempt]}
