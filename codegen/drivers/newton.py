"""The generated solver: structured Newton on the KKT system, or step after step of a simulation."""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

from codegen.drivers.connect import newton as connect
from codegen.loading import ControlModule, SimulateModule
from codegen.solutions.result import ControlAttempt, Run, SimulateAttempt

__all__ = ["connect", "control", "simulate"]

TOLERANCE = 1e-10
_OWN = ("tolerance", "trajectories", "scaled", "is_explained")
"""What an attempt has beside what a module's solution calls the same, or modules of earlier versions do not have."""
_CLAIMED: dict[type, tuple[str, ...]] = {
    attempt: tuple(f.name for f in fields(attempt) if f.name not in _OWN)
    for attempt in (ControlAttempt, SimulateAttempt)
}


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Call the module's `solve`."""
    warm = run.guess is not None and run.near
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    solution = module.solve(steps=run.steps, guess=run.guess, warm=warm, tolerance=tolerance, **_stops(run))
    trajectories = (solution.t, solution.q, solution.p, solution.u, solution.multipliers)
    scaled = getattr(solution, "scaled", None)
    return ControlAttempt(
        **_claimed(ControlAttempt, solution), tolerance=tolerance, trajectories=trajectories, scaled=scaled
    )


def simulate(module: SimulateModule, run: Run) -> SimulateAttempt:
    """Call the module's `solve`."""
    solution = module.solve(steps=run.steps, every=run.every, **_stops(run))
    return SimulateAttempt(**_claimed(SimulateAttempt, solution), tolerance=TOLERANCE)


def _claimed(attempt: type[ControlAttempt | SimulateAttempt], solution: Any) -> dict[str, Any]:
    """What an attempt takes from a module's solution, which calls it the same."""
    return {name: getattr(solution, name) for name in _CLAIMED[attempt]}


def _stops(run: Run) -> dict[str, Any]:
    """The arguments of a module's `solve` whose own defaults are not to hold."""
    given: dict[str, Any] = {"max_iterations": run.max_iterations, "time_limit": run.time_limit}
    given |= {"watch": run.watch, "scaling": run.scaling}
    given = {name: value for name, value in given.items() if value not in (None, math.inf, "auto")}
    return given if run.grid is None else given | {"grid": run.grid}
