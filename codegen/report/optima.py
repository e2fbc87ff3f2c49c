"""What is measured of an optimal-control problem: cost errors of every scheme, and drivers beside each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from codegen import drivers
from codegen.drivers.refinement import order_of_optima
from codegen.drivers.result import Result
from codegen.errors import CodegenError
from codegen.load import ControlModule, GeneratedModule, is_control
from codegen.report.building import SURVEYS, Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.orders import measured_order
from codegen.report.store import Case, Values

DRIVERS = ("newton", "slsqp", "trust-constr", "fsolve")
MOST_STEPS = 20_000
"""No ladder starts with more."""
NO_MORE = 1e-11
"""Relative differences of costs below which rounding is near."""
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
        own, rows = _module(workshop, variant).metadata["steps"], list[Values]()
        for steps in ladder(own, extent.control_doublings + extent.more_doublings):
            if len(rows) > extent.control_doublings and not _wants_more(rows, extent):
                break
            name = case_name(variant, steps)
            yield Case(
                errors_of(problem),
                name,
                lambda v=variant, n=steps: solved(_module(workshop, v), n, extent.repeat),  # type: ignore[misc]
            )
            values = store.get(errors_of(problem), name)
            if values is not None:
                rows.append(values)
                if (values["seconds"] or 0.0) > extent.limit:
                    break
    if not built:
        return
    # Optima of all schemes of order 2 and more converge alike, so that the problem's own scheme is asked first.
    trusted = sorted(built, key=lambda v: (-min(v.order, 2), v != built[0]))
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


def _wants_more(rows: Sequence[Values], extent: Extent) -> bool:
    """Whether the order has not settled yet, as far as differences of costs tell, and finer grids take no time."""
    costs = [v["cost"] if v["status"] == "solved" else None for v in rows]
    if costs[-1] is None or costs[-2] is None or (rows[-1]["seconds"] or 0.0) > extent.limit / 8.0:
        return False
    scale = abs(costs[-1]) or 1.0
    differences = [None if a is None or b is None else abs(b - a) / scale for a, b in pairwise(costs)]
    if differences[-1] is not None and differences[-1] < NO_MORE:
        return False
    order = measured_order([v["steps"] for v in rows[:-1]], differences)
    return order is None or order.finest < rows[-2]["steps"]


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
        "order": module.metadata["order"], "expected order": order_of_optima(module),
        "load seconds": result.seconds_first,
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

    Costs on three grids allow two extrapolations, whose difference is taken for the error of the second.
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
    order = order_of_optima(_module(workshop, variant))
    how = f"{variant.label} on {2 * finest} and {4 * finest} intervals, extrapolated by order {order}"
    return {"cost": result.summary["cost_extrapolated"], "error": _extrapolation_error(result.summary, order),
            "how": how, "observed order": result.summary.get("observed_order")}  # fmt: skip


def _extrapolation_error(summary: Mapping[str, Any], order: int) -> float:
    """How far the extrapolations from N and 2N, and from 2N and 4N intervals are apart.

    With corrections c' and c these differ by 2^p c - c', and c'/c is two to the power of the observed order; without
    one, where differences are at the level of rounding, the last correction has to do.
    """
    correction = float(summary["cost_error_estimate"])
    observed = summary.get("observed_order")
    return correction if observed is None else abs(2.0**order - 2.0**observed) * correction


def _by_driver(module: ControlModule, driver: str, steps: int, repeat: int) -> Values:
    """A solution by one of scipy's methods; what does not apply is recorded with its reason."""
    return solved(module, steps, repeat if driver == "newton" else 1, driver)
