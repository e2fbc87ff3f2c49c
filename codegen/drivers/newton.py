"""The generated solver: structured Newton on the KKT system, or step after step of a simulation."""

from __future__ import annotations

from codegen.drivers.connect import newton as connect
from codegen.drivers.result import ControlAttempt, Request, SimulateAttempt
from codegen.loading import ControlModule, SimulateModule

__all__ = ["connect", "control", "simulate"]

TOLERANCE = 1e-10


def control(module: ControlModule, request: Request) -> ControlAttempt:
    """Call the module's `solve`."""
    warm = request.guess is not None and request.near
    tolerance = TOLERANCE if request.tolerance is None else request.tolerance
    solution = module.solve(
        steps=request.steps,
        guess=request.guess,
        warm=warm,
        tolerance=tolerance,
        scaling=request.scaling,
        **_most_iterations(request),
    )
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
    solution = module.solve(steps=request.steps, every=request.every, **_most_iterations(request))
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


def _most_iterations(request: Request) -> dict[str, int]:
    """The argument of a module's `solve`, unless its own default is to hold."""
    return {} if request.max_iterations is None else {"max_iterations": request.max_iterations}
