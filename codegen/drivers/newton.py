"""The generated solver: structured Newton on the KKT system, or step after step of a simulation."""

from __future__ import annotations

from codegen.drivers.connect import newton as connect
from codegen.drivers.result import ControlAttempt, Request, SimulateAttempt
from codegen.load import ControlModule, SimulateModule

__all__ = ["connect", "control", "simulate"]

TOLERANCE = 1e-10


def control(module: ControlModule, request: Request) -> ControlAttempt:
    """Call the module's `solve`."""
    warm = request.guess is not None and request.near
    solution = module.solve(steps=request.steps, guess=request.guess, warm=warm, tolerance=TOLERANCE)
    return ControlAttempt(
        status=solution.status,
        message=solution.message,
        iterations=solution.iterations,
        unknowns=solution.unknowns,
        tolerance=TOLERANCE,
        log=solution.log,
    )


def simulate(module: SimulateModule, request: Request) -> SimulateAttempt:
    """Call the module's `solve`."""
    solution = module.solve(steps=request.steps, every=request.every)
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
