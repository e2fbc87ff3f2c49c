"""What is measured of an optimal-control problem: cost errors of every scheme, and drivers beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from codegen import drivers, solving
from codegen.errors import CodegenError
from codegen.interfaces import ControlModule, GeneratedModule, is_control
from codegen.report.building import SURVEYS, Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.measure.limits import Limit, fitted_limit, limit_of
from codegen.report.measure.meshes import all_grids, sequence
from codegen.report.store import Case, Store, Values
from codegen.solutions.result import Result
from codegen.solving.refinement import order_of_optima

DRIVERS = ("newton", "slsqp", "trust-constr", "fsolve")
MOST_STEPS = 20_000
"""No ladder starts with more."""
QUICKLY = 0.01
"""Seconds of a solve that is timed more often."""


def errors_of(problem: Path) -> str:
    """The section of the store that holds costs of all schemes."""
    return f"{problem.stem}: optima"


def orders_of(problem: Path) -> str:
    """The section of the store that holds the mesh sequences of all schemes."""
    return f"{problem.stem}: mesh sequences"


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
    """Every scheme on ever finer grids, mesh sequences, the reference, then the drivers on the coarsest grid."""
    store, built = workshop.store, workshop.built(variants)
    for variant in built:
        own = _module(workshop, variant).metadata.steps
        for steps in ladder(own, extent.control_doublings):
            name = case_name(variant, steps)
            yield Case(
                errors_of(problem),
                name,
                lambda v=variant, n=steps: solved(_module(workshop, v), n, extent.repeat),  # type: ignore[misc]
            )
            values = store.get(errors_of(problem), name)
            if values is not None and (values["seconds"] or 0.0) > extent.limit:
                break
        yield Case(orders_of(problem), variant.label, lambda v=variant: _sequence(workshop, v, extent))  # type: ignore[misc]
    if not built:
        return
    # Optima of all schemes of order 2 and more converge alike, so that the problem's own scheme is asked first.
    trusted = sorted(built, key=lambda v: (-min(v.order, 2), v != built[0]))
    exact = (store.get(SURVEYS, problem.stem) or {}).get("exact cost")
    yield Case(references_of(problem), "cost", lambda: _reference(store, problem, trusted, exact))
    module = _module(workshop, built[0])
    steps = ladder(module.metadata.steps, 0)[0]
    if module.initial_guess(module.make_grid(steps)).size > extent.driver_unknowns:
        return
    for driver in DRIVERS:
        yield Case(
            drivers_of(problem),
            driver,
            lambda d=driver: _by_driver(module, d, steps, extent.repeat),  # type: ignore[misc]
        )


def _sequence(workshop: Workshop, variant: Variant, extent: Extent) -> Values:
    module = _module(workshop, variant)
    return sequence(module, ladder(module.metadata.steps, 0)[0], extent.sequence_seconds)


def _module(workshop: Workshop, variant: Variant) -> ControlModule:
    module = workshop.module(variant)
    assert is_control(module)
    return module


_KEYS = ("cost", "seconds", "iterations", "residual", "stationarity", "order", "expected order", "load seconds")


def solved(module: ControlModule, steps: int, repeat: int, driver: str = "newton", **options: Any) -> Values:
    """Status, cost, times and residuals of a solution from the problem's own guess."""
    try:
        result = well_timed(module, driver, repeat, steps=steps, **options)
    except CodegenError as error:  # such as too little memory
        return {**dict.fromkeys(_KEYS), "status": "refused", "message": str(error), "steps": steps}
    return {
        "status": result.status, "steps": steps, "cost": result.cost, "seconds": result.seconds_solve,
        "iterations": result.iterations, "residual": result.residual, "stationarity": result.stationarity,
        "order": module.metadata.order, "expected order": order_of_optima(module),
        "load seconds": result.seconds_code,
    }  # fmt: skip


def well_timed(module: GeneratedModule, driver: str, repeat: int, **options: Any) -> Result:
    """A result whose time is the least of `repeat` solves, of ten times as many where these take milliseconds."""
    result = solving.solve(module, driver, repeat=1, **options)
    if repeat > 1 and result.seconds_solve < 1.0:
        return solving.solve(
            module, driver, repeat=10 * repeat if result.seconds_solve < QUICKLY else repeat, **options
        )
    return result


def _reference(store: Store, problem: Path, trusted: Sequence[Variant], exact: float | None) -> Values:
    """The closed form, else the limit of the mesh sequence of the first scheme that has one."""
    if exact is not None:
        return {"cost": exact, "error": 1e-15 * abs(exact), "how": "closed form of the maximum principle"}
    for variant in trusted:
        values = store.get(orders_of(problem), variant.label)
        if values is not None and (found := limit(values)) is not None:
            how = f"{variant.label} on {values['steps'][0]} to {values['steps'][-1]} intervals, {found.how}"
            return {"cost": found.value, "error": found.error, "how": how, "scheme": variant.label}
    return {"cost": None, "error": None, "how": "no scheme has optima on three successive grids"}


def limit(values: Values) -> Limit | None:
    """Where the costs of a mesh sequence tend to; None for fewer than three grids."""
    if len(values["steps"]) < 3:
        return None
    if values["switching"]:
        return fitted_limit(*all_grids(values), values["expected order"])
    return limit_of(values["costs"], values["expected order"])


def _by_driver(module: ControlModule, driver: str, steps: int, repeat: int) -> Values:
    """A solution by one of scipy's methods; what does not apply is recorded with its reason."""
    return solved(module, steps, repeat if drivers.DRIVERS[driver].generated else 1, driver)
