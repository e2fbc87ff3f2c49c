"""The generated solver: structured Newton on the KKT system, or step after step of a simulation."""

from __future__ import annotations

import math
from typing import Any

from codegen.drivers.connect import newton as connect
from codegen.loading import ControlModule, SimulateModule
from codegen.solutions.result import ControlAttempt, Run, SimulateAttempt

__all__ = ["connect", "control", "simulate"]

TOLERANCE = 1e-10


def control(module: ControlModule, run: Run) -> ControlAttempt:
    """Call the module's `solve`."""
    warm = run.guess is not None and run.near
    tolerance = TOLERANCE if run.tolerance is None else run.tolerance
    solution = module.solve(steps=run.steps, guess=run.guess, warm=warm, tolerance=tolerance, **_stops(run))
    return ControlAttempt(
        status=solution.status,
        message=solution.message,
        iterations=solution.iterations,
        unknowns=solution.unknowns,
        tolerance=tolerance,
        log=solution.log,
    )


def simulate(module: SimulateModule, run: Run) -> SimulateAttempt:
    """Call the module's `solve`."""
    solution = module.solve(steps=run.steps, every=run.every, **_stops(run))
    return SimulateAttempt(
        status=solution.status,
        message=solution.message,
        iterations=solution.iterations,
        t=solution.t,
        q=solution.q,
        p=solution.p,
        energy=solution.energy,
        steps=solution.steps,
        residual=solution.residual,
        tolerance=TOLERANCE,
    )


def _stops(run: Run) -> dict[str, Any]:
    """The arguments of a module's `solve` whose own defaults are not to hold."""
    given: dict[str, Any] = {"max_iterations": run.max_iterations, "time_limit": run.time_limit}
    given |= {"watch": run.watch, "scaling": run.scaling}
    return {name: value for name, value in given.items() if value not in (None, math.inf, "auto")}
