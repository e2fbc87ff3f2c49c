"""The fastest way to a given error in cost on forty landmarks: every scheme with as few steps as it needs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from codegen import solving
from codegen.report.measure.accuracy import EXACT
from codegen.report.settings import Settings
from codegen.report.store import Case, Store, Values

SECTION = "fastest"
TARGETS = (1e-3, 1e-6, 1e-9)
STEPPED = ("explicit-euler", "symplectic-euler", "midpoint", "stormer-verlet", "rk4", "yoshida-4-of-midpoint",
           "butcher-6")  # fmt: skip
ADAPTIVE = ("lsoda", "dop853")
_MOST_STEPS, _ASYMPTOTIC = 3000, 40
"""Steps beyond which no scheme is tried, and from which on its order is taken to predict how many it needs."""
_REPEAT = 5


def cases(settings: Settings, store: Store) -> Iterator[Case]:
    """For every scheme and target, the fewest steps or the loosest tolerance that meets it."""
    del store
    if settings.quick:
        return

    @cache
    def reference() -> float:
        found = solving.solve(settings.module("dop853"), points=settings.landmarks, tolerance=EXACT)
        assert found.cost is not None
        return found.cost

    searches: dict[str, Callable[[Settings, str, float, float], Values]] = {
        **dict.fromkeys(STEPPED, _fewest_steps),
        **dict.fromkeys(ADAPTIVE, _loosest_tolerance),
    }
    for scheme, search in searches.items():
        for target in TARGETS:
            name = f"{scheme}; {target:g}"
            yield Case(SECTION, name, lambda f=search, s=scheme, t=target: f(settings, s, t, reference()))  # type: ignore[misc]


def _fewest_steps(settings: Settings, scheme: str, target: float, exact: float) -> Values:
    """Steps by the power of N with which the scheme's order lets the error fall; not reached where N would be huge."""
    module = settings.module(scheme)
    order, steps, error = module.metadata.order, 1, math.inf
    while steps <= _MOST_STEPS:
        result = _solved(settings, scheme, {"steps": steps})
        error = abs(result.cost - exact) if result.solved else math.inf
        if error <= target:
            result = _solved(settings, scheme, {"steps": steps, "repeat": _REPEAT})
            return {"reached": True, "steps": steps, "error": error, "seconds": result.seconds_solve}
        growth = (error / target) ** (1.0 / order) if math.isfinite(error) else 2.0
        if steps >= _ASYMPTOTIC and growth * steps > _MOST_STEPS:
            break
        caution = 0.995 if steps >= _ASYMPTOTIC else 0.97  # the order holds better the more steps there are
        steps = max(steps + 1, math.floor(steps * min(caution * growth, 4.0)))
    return {"reached": False, "steps": _MOST_STEPS, "error": error, "seconds": math.inf}


def _loosest_tolerance(settings: Settings, scheme: str, target: float, exact: float) -> Values:
    """Four tolerances a decade."""
    for quarter in range(4, 53):
        given = {"tolerance": 10.0 ** (-quarter / 4)}
        result = _solved(settings, scheme, given)
        error = abs(result.cost - exact) if result.solved else math.inf
        if error <= target:
            result = _solved(settings, scheme, {**given, "repeat": _REPEAT})
            return {"reached": True, "steps": result.steps, "error": error, "seconds": result.seconds_solve, **given}
    return {"reached": False, "steps": 0, "error": math.inf, "seconds": math.inf}


def _solved(settings: Settings, scheme: str, given: dict[str, Any]) -> Any:
    return solving.solve(settings.module(scheme), points=settings.landmarks, **given)
