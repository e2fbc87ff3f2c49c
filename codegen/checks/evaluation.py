"""Evaluation in high precision: functions of expressions, random points at which they have a value, differences.

Differences are taken of undifferentiated expressions in 120-digit arithmetic, so that they owe nothing to sympy's
differentiation and are right to about 40 digits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import mpmath  # type: ignore[import-untyped]
import numpy as np
import sympy
from sympy import Expr, Symbol

from codegen.discretise import STEP
from codegen.errors import NumericsError

Point: TypeAlias = Mapping[Symbol, float]
Function: TypeAlias = Callable[..., list[Any]]

DIGITS = 120
NOTHING = mpmath.mpf(10) ** -30
"""Below this fraction of the largest entry a difference counts as zero."""
_INCREMENT = mpmath.mpf(10) ** -40
_SEED = 20240229
_ATTEMPTS = 200


def function_of(symbols: Sequence[Symbol], values: Sequence[Expr]) -> Function:
    """A function of numbers of any precision, in the order of the symbols, that returns the values as a list."""
    extra = {"Heaviside": lambda x: (1 + mpmath.sign(x)) / 2, "DiracDelta": lambda *_: mpmath.mpf(0)}
    function = sympy.lambdify(list(symbols), list(values), modules=[extra, "mpmath"], cse=True)
    return function  # type: ignore[no-any-return]


def symbols_of(values: Sequence[Expr], *more: Sequence[Symbol]) -> list[Symbol]:
    """The symbols of some expressions and further ones, each once, in an order that is the same in every run."""
    found = set().union(*(value.free_symbols for value in values), *map(set, more))
    return sorted(found, key=lambda symbol: symbol.name)


def random_points(
    values: Sequence[Expr], symbols: Sequence[Symbol], defaults: Point, count: int = 3, seed: int = _SEED
) -> list[dict[Symbol, float]]:
    """Seeded random points at which all values are real and finite; parameters are drawn about their defaults.

    Raises NumericsError when hardly any point is in the domain of the expressions.
    """
    generator = np.random.default_rng(seed)
    function = function_of(symbols, values)
    points: list[dict[Symbol, float]] = []
    for _ in range(_ATTEMPTS):
        drawn = {symbol: float(generator.uniform(0.4, 1.6)) for symbol in symbols}
        drawn |= {symbol: value * drawn[symbol] for symbol, value in defaults.items() if symbol in drawn and value}
        if STEP in drawn:
            drawn[STEP] *= 0.25
        if _has_value(function, [drawn[symbol] for symbol in symbols]):
            points.append(drawn)
        if len(points) == count:
            return points
    raise NumericsError("the expressions have no real value at random points", "check their domain")


def _has_value(function: Function, numbers: Sequence[float]) -> bool:
    try:
        results = function(*map(mpmath.mpf, numbers))
        return all(math.isfinite(float(result)) for result in results)
    except (TypeError, ValueError, ArithmeticError):
        return False


def gradient(function: Function, numbers: Sequence[float], places: Sequence[int]) -> list[Any]:
    """Forward differences of the first value of a function by the arguments at some places."""
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        return [(at(i) - at()) / _INCREMENT for i in places]


def hessian(function: Function, numbers: Sequence[float], places: Sequence[int]) -> list[list[Any]]:
    """Second forward differences of the first value of a function, the lower triangle row by row."""
    with mpmath.workdps(DIGITS):
        at = _shifted(function, numbers)
        single = {i: at(i) for i in places}
        middle = at()
        return [
            [(at(i, j) - single[i] - single[j] + middle) / _INCREMENT**2 for j in places[: row + 1]]
            for row, i in enumerate(places)
        ]


def _shifted(function: Function, numbers: Sequence[float]) -> Callable[..., Any]:
    """The first value of a function at numbers that are incremented at the given places."""

    def at(*places: int) -> Any:
        arguments = [mpmath.mpf(number) for number in numbers]
        for i in places:
            arguments[i] += _INCREMENT
        return function(*arguments)[0]

    return at


def vanishes_symbolically(expression: Expr, limit: int = 3000) -> bool:
    """Whether sympy's simplifications turn an expression into zero; False also when they do not get there."""
    if expression.count_ops() > limit:
        return False
    expanded = sympy.expand(expression)
    if expanded == 0:
        return True
    return bool(sympy.cancel(sympy.together(expanded)) == 0 or sympy.simplify(expanded) == 0)
