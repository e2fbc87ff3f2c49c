"""What is measured of an optimal-control problem: cost errors of every scheme, and drivers beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from codegen import drivers
from codegen.errors import CodegenError
from codegen.load import ControlModule, is_control
from codegen.report.building import SURVEYS, Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.store import Case, Values

DRIVERS = ("newton", "slsqp", "trust-constr", "fsolve")
MOST_STEPS = 20_000
"""No ladder starts with more."""


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
    best = max(built, key=lambda v: (v.order, v == built[0]))
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    yield Case(references_of(problem), "cost", lambda: _reference(workshop, best, exact, extent))
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


def solved(module: ControlModule, steps: int, repeat: int, driver: str = "newton", **options: Any) -> Values:
    """Status, cost, times and residuals of a solution from the problem's own guess."""
    result = drivers.solve(module, driver, steps=steps, repeat=repeat, **options)
    return {
        "status": result.status, "steps": steps, "cost": result.cost, "seconds": result.seconds_solve,
        "iterations": result.iterations, "residual": result.residual, "stationarity": result.stationarity,
        "order": module.metadata["order"], "load seconds": result.seconds_first,
    }  # fmt: skip


def _reference(workshop: Workshop, variant: Variant, exact: float | None, extent: Extent) -> Values:
    """The closed form, else extrapolation from grids finer than the ladder's, with the last correction as its error."""
    if exact is not None:
        return {"cost": exact, "error": 1e-15 * abs(exact), "how": "closed form of the maximum principle"}
    module = _module(workshop, variant)
    finest = ladder(module.metadata["steps"], extent.control_doublings)[-1]
    result = drivers.solve(module, steps=finest, doublings=2)
    if not result.solved or result.cost is None or result.steps != 4 * finest:
        return {"cost": None, "error": None, "how": f"{variant.label} fails on {result.steps} intervals"}
    how = f"{variant.label} on {2 * finest} and {4 * finest} intervals, extrapolated by its order {variant.order}"
    summary = result.summary
    return {"cost": summary["cost_extrapolated"], "error": summary["cost_error_estimate"], "how": how,
            "observed order": summary.get("observed_order")}  # fmt: skip


def _by_driver(module: ControlModule, driver: str, steps: int, repeat: int) -> Values:
    """A solution by one of scipy's methods; what does not apply is recorded with its reason."""
    try:
        return solved(module, steps, repeat if driver == "newton" else 1, driver)
    except CodegenError as error:
        return {"status": "does not apply", "message": str(error), "steps": steps, "seconds": None}
