"""What is measured of an optimal-control problem: cost errors of every scheme, and drivers beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from codegen import drivers
from codegen.drivers.result import Result
from codegen.errors import CodegenError
from codegen.load import ControlModule, GeneratedModule, is_control
from codegen.report.building import SURVEYS, Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.store import Case, Values

DRIVERS = ("newton", "slsqp", "trust-constr", "fsolve")
MOST_STEPS = 20_000
"""No ladder starts with more."""
QUICKLY = 0.01
"""Seconds of a solve that is timed more often."""


def errors_of(problem: Path) -> str:
    """The section of the store that holds costs of all schemes."""
    return f"{problem.stem}: optima"


def references_of(problem: Path) -> str:
    """The section of the store that holds the reference cost."""
    return f"{problem.stem}: reference"


def drivers_of(problem: Path) -> str:
    """The section of the store that compares drivers."""
    return f"{problem.stem}: drivers"


def case_name(variant: Variant, steps: int) -> str:
    """The name of a case."""
    return f"{variant.label}; N {steps}"


def ladder(own_steps: int, doublings: int) -> list[int]:
    """A quarter of the problem's own number of steps, at least 5, doubled so often."""
    first = max(5, min(MOST_STEPS, own_steps) // 4)
    return [first * 2**k for k in range(doublings + 1)]


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Every scheme on ever finer grids, the reference, then the drivers on the coarsest grid."""
    store, built = workshop.store, workshop.built(variants)
    for variant in built:
        for steps in ladder(_module(workshop, variant).metadata["steps"], extent.control_doublings):
            name = case_name(variant, steps)
            yield Case(
                errors_of(problem),
                name,
                lambda v=variant, n=steps: solved(_module(workshop, v), n, extent.repeat),  # type: ignore[misc]
            )
            values = store.get(errors_of(problem), name)
            if values is not None and (values["seconds"] or 0.0) > extent.limit:
                break
    if not built:
        return
    trusted = sorted(built, key=lambda v: (-v.order, v != built[0]))
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    yield Case(references_of(problem), "cost", lambda: _reference(workshop, trusted, exact, extent))
    module = _module(workshop, built[0])
    steps = ladder(module.metadata["steps"], 0)[0]
    if module.initial_guess(module.make_grid(steps)).size > extent.driver_unknowns:
        return
    for driver in DRIVERS:
        yield Case(
            drivers_of(problem),
            driver,
            lambda d=driver: _by_driver(module, d, steps, extent.repeat),  # type: ignore[misc]
        )


def _module(workshop: Workshop, variant: Variant) -> ControlModule:
    module = workshop.module(variant)
    assert is_control(module)
    return module


_KEYS = ("cost", "seconds", "iterations", "residual", "stationarity", "order", "load seconds")


def solved(module: ControlModule, steps: int, repeat: int, driver: str = "newton", **options: Any) -> Values:
    """Status, cost, times and residuals of a solution from the problem's own guess."""
    try:
        result = well_timed(module, driver, repeat, steps=steps, **options)
    except CodegenError as error:  # such as too little memory
        return {**dict.fromkeys(_KEYS), "status": "refused", "message": str(error), "steps": steps}
    return {
        "status": result.status, "steps": steps, "cost": result.cost, "seconds": result.seconds_solve,
        "iterations": result.iterations, "residual": result.residual, "stationarity": result.stationarity,
        "order": module.metadata["order"], "load seconds": result.seconds_first,
    }  # fmt: skip


def well_timed(module: GeneratedModule, driver: str, repeat: int, **options: Any) -> Result:
    """A result whose time is the least of `repeat` solves, of ten times as many where these take milliseconds."""
    result = drivers.solve(module, driver, repeat=1, **options)
    if repeat > 1 and result.seconds_solve < 1.0:
        return drivers.solve(
            module, driver, repeat=10 * repeat if result.seconds_solve < QUICKLY else repeat, **options
        )
    return result


def _reference(workshop: Workshop, trusted: Sequence[Variant], exact: float | None, extent: Extent) -> Values:
    """The closed form, else extrapolation by the first scheme that solves grids finer than the ladder's.

    The last correction of the extrapolation is taken for its error.
    """
    if exact is not None:
        return {"cost": exact, "error": 1e-15 * abs(exact), "how": "closed form of the maximum principle"}
    finest = ladder(_module(workshop, trusted[0]).metadata["steps"], extent.control_doublings)[-1]
    for variant in trusted:
        result = drivers.solve(_module(workshop, variant), steps=finest, doublings=2)
        if result.solved and result.steps == 4 * finest:
            break
    else:
        return {"cost": None, "error": None, "how": f"every scheme fails on {finest} to {4 * finest} intervals"}
    how = f"{variant.label} on {2 * finest} and {4 * finest} intervals, extrapolated by its order {variant.order}"
    summary = result.summary
    return {"cost": summary["cost_extrapolated"], "error": summary["cost_error_estimate"], "how": how,
            "observed order": summary.get("observed_order")}  # fmt: skip


def _by_driver(module: ControlModule, driver: str, steps: int, repeat: int) -> Values:
    """A solution by one of scipy's methods; what does not apply is recorded with its reason."""
    return solved(module, steps, repeat if driver == "newton" else 1, driver)
