"""Evaluation in high precision: functions of expressions, random points at which they have a value, differences.

Differences are taken of undifferentiated expressions in 120-digit arithmetic, so that they owe nothing to sympy's
differentiation and are right to about 40 digits.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import mpmath
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.discretise.interval import LENGTHS, STEP
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.smoothness import expected_values
from codegen.errors import NumericsError
from codegen.evidence.checks.base import Finding
from codegen.symbolic.zeros import identically_zero

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


def _extended(least: float, greatest: float) -> Range:
    alone, both = _BESIDE
    more = both * (greatest - least) or alone * abs(least)
    return least - more, greatest + more


Point: TypeAlias = Mapping[Symbol, float]
Function: TypeAlias = Callable[..., list[Any]]

DIGITS = 120
NOTHING = mpmath.mpf(10) ** -30
"""Below this fraction of the largest entry a difference counts as zero."""
_INCREMENT = mpmath.mpf(10) ** -40
_SEED = 20240229
_ATTEMPTS = 200


class NoPointError(NumericsError):
    """No point was found at which expressions have values, so that they cannot be compared with anything."""


def function_of(
    symbols: Sequence[Symbol], values: Sequence[Expr], assignments: Sequence[tuple[Symbol, Expr]] = ()
) -> Function:
    """A function of numbers of any precision, in the order of the symbols, that returns the values as a list.

    Values may read the symbols of assignments, which are made in order; written out, they could be far too long.
    """
    extra = {"Heaviside": lambda x: (1 + mpmath.sign(x)) / 2, "DiracDelta": lambda *_: mpmath.mpf(0)}
    parts = (lambda expressions: (list(assignments), expressions)) if assignments else True
    function = sympy.lambdify(list(symbols), list(values), modules=[extra, "mpmath"], cse=parts)
    return function  # type: ignore[no-any-return]


def symbols_of(values: Sequence[Expr], *more: Sequence[Symbol]) -> list[Symbol]:
    """The symbols of some expressions and further ones, each once, in an order that is the same in every run."""
    found = set().union(*(value.free_symbols for value in values), *map(set, more))
    return sorted(found, key=lambda symbol: symbol.name)


def random_points(
    values: Sequence[Expr],
    symbols: Sequence[Symbol],
    model: Model,
    count: int = 3,
    seed: int = _SEED,
    likely: Iterable[Point] = (),
    assignments: Sequence[tuple[Symbol, Expr]] = (),
) -> list[dict[Symbol, float]]:
    """Seeded random points at which all values are real and finite; parameters are drawn about their defaults.

    What the model, or a likely point, has of another size than one is drawn where it is there. Values may read
    `assignments`. Of the points that are `likely` those come first that have values, but one point at
    least is random. Raises NoPointError when hardly any point is in the domain of the expressions.
    """
    likely = list(likely)
    defaults, ranges = model.default_values, own_ranges(model, likely)
    elsewhere = [symbol for symbol in symbols if symbol not in defaults and symbol not in (STEP, *LENGTHS)]
    generator = np.random.default_rng(seed)
    function = function_of(symbols, values, assignments)
    points: list[dict[Symbol, float]] = []
    for point in likely:
        if len(points) < count - 1 and _has_value(function, [point[symbol] for symbol in symbols]):
            points.append({symbol: point[symbol] for symbol in symbols})
    for _ in range(_ATTEMPTS):
        drawn = {symbol: float(generator.uniform(0.4, 1.6)) for symbol in symbols}
        drawn |= {s: float(generator.uniform(*own)) for s in elsewhere if (own := range_of(s, ranges)) is not None}
        drawn |= {symbol: value * drawn[symbol] for symbol, value in defaults.items() if symbol in drawn and value}
        drawn |= {length: 0.25 * drawn[length] for length in (STEP, *LENGTHS) if length in drawn}
        if _has_value(function, [drawn[symbol] for symbol in symbols]):
            points.append(drawn)
        if len(points) == count:
            return points
    raise NoPointError("the expressions have no real value at random points", "give bounds or a guess of their sizes")


def _has_value(function: Function, numbers: Sequence[float]) -> bool:
    try:
        results = function(*map(mpmath.mpf, numbers))
        return all(math.isfinite(float(result)) for result in results)
    except (TypeError, ValueError, ArithmeticError):
        return False


def gradient(function: Function, numbers: Sequence[float], indices: Sequence[int]) -> list[Any]:
    """Forward differences of the first value of a function by the arguments at some indices."""
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        middle = at()
        return [(at(i) - middle) / _INCREMENT for i in indices]


def second_differences(
    function: Function, numbers: Sequence[float], pairs: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], Any]:
    """Second forward differences of the first value of a function by pairs of arguments.

    Of values as large as 1e200 it takes more digits to see the difference.
    """
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        more = max(0, int(mpmath.ceil(mpmath.log10(1 + abs(at())))))
    with mpmath.workdps(DIGITS + more):
        single = {i: at(i) for i in dict.fromkeys(index for pair in pairs for index in pair)}
        middle = at()
        return {(i, j): (at(i, j) - single[i] - single[j] + middle) / _INCREMENT**2 for i, j in pairs}


def directional(function: Function, numbers: Sequence[float], direction: Sequence[float]) -> list[Any]:
    """Second forward differences of the first value of a function by each of its first arguments and a direction.

    The direction has an entry for each of these arguments.
    """
    along = {i: mpmath.mpf(float(weight)) for i, weight in enumerate(direction) if weight}
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        ahead, middle = at(along=along), at()
        return [(at(i, along=along) - at(i) - ahead + middle) / _INCREMENT**2 for i in range(len(direction))]


def curved_beyond(
    function: Function, numbers: Sequence[float], indices: Sequence[int], pattern: Iterable[tuple[int, int]]
) -> set[tuple[int, int]]:
    """Pairs (row, column), row >= column, outside a pattern whose second difference does not vanish.

    A row is searched only if its second difference by a random combination of all columns outside the pattern does
    not vanish, so that the cost grows with the number of rows.
    """
    known, found = set(pattern), set[tuple[int, int]]()
    generator = np.random.default_rng(_SEED)
    inside = second_differences(function, numbers, sorted(known)).values()
    least = NOTHING * (max(map(abs, inside), default=0) or 1)
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        middle = at()
        for row in indices:
            columns = [c for c in indices if c <= row and (row, c) not in known]
            weights = {c: mpmath.mpf(float(generator.uniform(0.5, 1.5))) for c in columns}
            alone, beside = at(row), at(along=weights)
            if abs(at(row, along=weights) - alone - beside + middle) <= least * _INCREMENT**2:
                continue
            values = second_differences(function, numbers, [(row, c) for c in columns])
            found |= {pair for pair, value in values.items() if abs(value) > least}
    return found


def _shifted(function: Function, numbers: Sequence[float]) -> Callable[..., Any]:
    """The first value of a function at numbers that are incremented at the given indices, and along a direction."""

    def at(*indices: int, along: Mapping[int, Any] | None = None) -> Any:
        arguments = [mpmath.mpf(number) for number in numbers]
        for i in indices:
            arguments[i] += _INCREMENT
        for i, weight in (along or {}).items():
            arguments[i] += weight * _INCREMENT
        return function(*arguments)[0]

    return at


def vanishing(expression: Expr) -> str:
    """How it is known that an expression is zero everywhere, in words; empty when it is not."""
    return "proved symbolically" if identically_zero(expression) else ""


TOLERANCE = 1e-10
_ROUNDING = 1e-13


@dataclass
class Agreement:
    """The largest relative error seen so far, the name of its entry, and how many entries were compared."""

    check: str = "derivatives"
    error: float = 0.0
    name: str = ""
    entries: int = 0

    def compare(self, names: Sequence[str], emitted: Any, exact: Sequence[Any]) -> None:
        """Errors count relative to the entry, above the rounding of the largest entry beside it.

        An entry that vanishes beside the others has no digits to agree with: its error counts relative to the largest.
        Terms that cancel in it leave their rounding: up to 1.4e-11 of the largest in the interior angles of 4 to 7
        hovercraft.
        """
        assert len(names) == len(emitted) == len(exact)
        largest = max((abs(value) for value in exact), default=0)
        self.entries += len(names)
        for name, value, wanted in zip(names, emitted, exact, strict=True):
            excess = abs(mpmath.mpf(float(value)) - wanted) - _ROUNDING * largest
            size = abs(wanted) if abs(wanted) > NOTHING * largest else largest
            error = float(excess / size) if size else 0.0 if excess <= 0 else float("inf")
            if not error <= self.error:
                self.error, self.name = error if error == error else float("inf"), name

    def finding(self, subject: str, against: str) -> Finding:
        """Whether all values agree with what they were compared with, and which does not."""
        passed = self.error <= TOLERANCE
        detail = f"{self.entries} values agree with {against} to {TOLERANCE:g}"
        if not passed:
            detail = f"{self.name} differs from {against} by {self.error:.2g} of its value"
        return Finding(self.check, subject, passed, detail)
