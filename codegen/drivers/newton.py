"""The generated solver: structured Newton on the KKT system, or step after step of a simulation."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import numpy as np

from codegen.drivers.adaptive import adaptive
from codegen.drivers.quiet import quiet_single_thread
from codegen.errors import ArgumentError
from codegen.interfaces import ConnectModule, ControlModule, SimulateModule, is_of_particles
from codegen.solutions.connect import case_of
from codegen.solutions.result import ConnectAttempt, ControlAttempt, Run, SimulateAttempt

TOLERANCE = 1e-10
_ROUNDED = 1e-9  # neighbours that move apart have momenta so large that rounding errors of positions come near to this
_OWN = ("tolerance", "trajectories", "scaled", "is_explained", "generated")
"""What an attempt has beside what a module's solution calls the same, or modules of earlier versions do not have."""
_CLAIMED: dict[type, tuple[str, ...]] = {
    attempt: tuple(f.name for f in fields(attempt) if f.name not in _OWN)
    for attempt in (ControlAttempt, SimulateAttempt)
}


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Call the module's `solve`."""
    warm = run.guess is not None and run.near
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    solution = module.solve(steps=run.steps, guess=run.guess, warm=warm, tolerance=tolerance, **_options(run))
    trajectories = (solution.t, solution.q, solution.p, solution.u, solution.multipliers)
    scaled = getattr(solution, "scaled", None)
    return ControlAttempt(
        **_claimed(ControlAttempt, solution), tolerance=tolerance, trajectories=trajectories, scaled=scaled,
        generated=True,
    )  # fmt: skip


def simulate(module: SimulateModule, run: Run) -> SimulateAttempt:
    """Call the module's `solve`. Raises ArgumentError for a limit of iterations where the module has its own."""
    limit = {} if run.max_iterations is None else {"max_iterations": run.max_iterations}
    if limit and is_of_particles(module):
        raise ArgumentError("--max-iterations of particles, whose module limits Newton's method itself", "leave it out")
    solution = module.solve(steps=run.steps, every=run.every, **limit)
    return SimulateAttempt(**_claimed(SimulateAttempt, solution), tolerance=TOLERANCE, generated=True)


def connect(module: ConnectModule, run: Run) -> ConnectAttempt:
    """Call the module's `solve_case`, or integrate adaptively where the scheme says so."""
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
    """What an attempt takes from a module's solution, which calls it the same."""
    return {name: getattr(solution, name) for name in _CLAIMED[attempt]}


def _options(run: Run) -> dict[str, Any]:
    """The arguments of an optimisation's `solve` whose own defaults are not to hold."""
    given: dict[str, Any] = {"max_iterations": run.max_iterations, "time_limit": run.time_limit}
    given |= {"watch": run.watch, "scaling": run.scaling}
    given = {name: value for name, value in given.items() if value not in (None, math.inf, "auto")}
    return given if run.grid is None else given | {"grid": run.grid}
