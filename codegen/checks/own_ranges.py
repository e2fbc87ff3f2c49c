"""Where the quantities of a problem are, as far as its author says: the ranges in which random points are drawn."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np
from sympy import Symbol

from codegen.model import Model
from codegen.model.sample_points import expected_values

Range = tuple[float, float]
_SHARES = (0.0, 0.5, 1.0)
_ORDINARY = 1e-2, 1e2
"""Sizes between these are drawn about one, where all terms of an expression can be seen."""
_BESIDE = 0.02, 0.1
"""How far a range is extended: parts of a single value, and of the distance of two."""
_AT = re.compile(r"_(stage\d+(_k)?|k1?)$")


def own_ranges(model: Model, likely: Iterable[Mapping[Symbol, float]] = ()) -> dict[str, Range]:
    """The ranges of quantities whose sizes are not ordinary ones, by names.

    They are those of the guess, the values at the ends, the bounds and the defaults, and of points that are `likely`.
    """
    points = [expected_values(own, share) for own in model.phases or (model,) for share in _SHARES]
    found: dict[str, list[float]] = {}
    for point in (*points, *likely):
        for symbol, number in point.items():
            found.setdefault(symbol.name, []).append(number)
    ranges = {name: _extended(min(numbers), max(numbers)) for name, numbers in found.items()}
    least, greatest = _ORDINARY
    return {name: (a, b) for name, (a, b) in ranges.items() if max(-a, b) > greatest or 0 < max(-a, b) < least}


def range_of(symbol: Symbol, ranges: Mapping[str, Range]) -> Range | None:
    """The range of a symbol, or of the quantity whose value at a node or stage it holds; None where it is ordinary."""
    return ranges.get(symbol.name) or ranges.get(_AT.sub("", symbol.name))


def drawn_from(generator: np.random.Generator, own: Range) -> float:
    """A number within a range."""
    return float(generator.uniform(*own))


def _extended(least: float, greatest: float) -> Range:
    alone, both = _BESIDE
    more = both * (greatest - least) or alone * abs(least)
    return least - more, greatest + more
