"""The generated solver: structured Newton on the KKT system, or step after step of a simulation."""

from __future__ import annotations

import math
from typing import Any

from codegen.drivers.connect import newton as connect
from codegen.loading import ControlModule, SimulateModule
from codegen.solutions.result import ControlAttempt, Request, SimulateAttempt

__all__ = ["connect", "control", "simulate"]

TOLERANCE = 1e-10


def control(module: ControlModule, request: Request) -> ControlAttempt:
    """Call the module's `solve`."""
    warm = request.guess is not None and request.near
    tolerance = TOLERANCE if request.tolerance is None else request.tolerance
    solution = module.solve(steps=request.steps, guess=request.guess, warm=warm, tolerance=tolerance, **_stops(request))
    return ControlAttempt(
        status=solution.status,
        message=solution.message,
        iterations=solution.iterations,
        unknowns=solution.unknowns,
        tolerance=tolerance,
        log=solution.log,
    )


def simulate(module: SimulateModule, request: Request) -> SimulateAttempt:
    """Call the module's `solve`."""
    solution = module.solve(steps=request.steps, every=request.every, **_stops(request))
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


def _stops(request: Request) -> dict[str, Any]:
    """The arguments of a module's `solve` whose own defaults are not to hold."""
    given: dict[str, Any] = {"max_iterations": request.max_iterations, "time_limit": request.time_limit}
    given |= {"watch": request.watch, "scaling": request.scaling}
    return {name: value for name, value in given.items() if value not in (None, math.inf, "auto")}
