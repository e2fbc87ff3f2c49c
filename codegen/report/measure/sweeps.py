"""The thesis's comparison of routes, sections 5.1 and 5.2: cost and time against the number of steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from codegen import solving
from codegen.drivers import DRIVERS
from codegen.report.settings import Settings, few_landmarks
from codegen.report.store import Case, Store, Values

SECTION = "sweeps"
DRAWN = 20
"""The number of steps whose paths are drawn."""


@dataclass(frozen=True)
class Route:
    """A way to the solution: what the thesis calls it (or what ours is called), the method and the driver."""

    label: str
    method: str
    driver: str
    schemes: tuple[str, ...]


_EULERS = ("explicit-euler", "symplectic-euler", "implicit-euler", "midpoint")
ROUTES = (
    Route("stepping, newton", "stepping", "newton", _EULERS),
    Route("stepping, fsolve", "stepping", "fsolve", _EULERS),
    Route("full, newton", "full", "newton", _EULERS),
    Route("action, newton", "action", "newton", ("explicit-euler", "symplectic-euler", "midpoint")),
    Route("stepping, fmin", "stepping", "fmin", ("explicit-euler", "midpoint")),
    Route("full, fsolve", "full", "fsolve", ("explicit-euler", "midpoint")),
    Route("action, trust-constr", "action", "trust-constr", ("explicit-euler", "midpoint")),
    Route("action, slsqp", "action", "slsqp", ("explicit-euler", "midpoint")),
)


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """Every route on every set of landmarks, with ever more steps until a solve takes longer than the limit."""
    for scheme in ("explicit-euler", "midpoint") if settings.quick else _EULERS:
        for route in ROUTES:
            if scheme not in route.schemes or (settings.quick and route.driver not in ("newton", "fsolve")):
                continue
            if settings.quick and (route.method != "stepping"):
                continue
            for count in settings.counts:
                yield from _growing(settings, store, scheme, route, count)


def _growing(settings: Settings, store: Store, scheme: str, route: Route, count: int) -> Iterator[Case]:
    for steps in settings.steps:
        name = case_name(scheme, route.label, count, steps)

        def measure(steps: int = steps) -> Values:
            return _solved(settings, scheme, route, count, steps)

        yield Case(SECTION, name, measure)
        values = store.get(SECTION, name)
        if values is not None and (values["seconds"] or 0.0) > settings.limit:
            return


def case_name(scheme: str, route: str, count: int, steps: int) -> str:
    """The name of a case."""
    return f"{scheme}; {route}; nc {count}; N {steps}"


def _solved(settings: Settings, scheme: str, route: Route, count: int, steps: int) -> Values:
    module = settings.module(scheme, None if route.method == "stepping" else route.method)
    repeat = 5 if DRIVERS[route.driver].generated or (route.method, route.driver) == ("stepping", "fsolve") else 1
    result = solving.solve(module, route.driver, points=few_landmarks(count), steps=steps, repeat=repeat)
    found: dict[str, object] = {
        "status": result.status,
        "cost": result.cost,
        "residual": result.residual,
        "seconds": result.seconds_solve,
        "iterations": result.iterations,
    }
    if steps == DRAWN:
        found["path"] = result.q.reshape(steps + 1, count, 2)
    return found
