"""The second opinion: where values in machine numbers differ, both are computed with many digits.

Kernels are executed with numbers that carry the size of the terms that they are made of, so that rounding of the
coefficients in the text, which is all that may differ, is told from an error. References are differences with 400
digits of the expressions themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mpmath
from sympy import Symbol

from codegen.expressions.special_functions import by_name
from codegen.verify.tape import Arithmetic

DIGITS = 400
_INCREMENTS = ("1e-35", "1e-40")
Exact = Callable[[Mapping[Symbol, Any]], Any]
"""A value of numbers with many digits."""
TOLERANCE = 1e-11
"""Of the size of the terms that a value is made of; coefficients in a text have 17 digits."""


class Sized:
    """A number and the size of the terms that it is made of: the first-order bound of its rounding, without epsilon."""

    __slots__ = ("size", "value")

    def __init__(self, value: Any, size: Any = None) -> None:
        self.value = mpmath.mpf(value)
        self.size = abs(self.value) if size is None else max(size, abs(self.value))

    def __add__(self, other: Any) -> Sized:
        other = sized(other)
        return Sized(self.value + other.value, self.size + other.size)

    def __neg__(self) -> Sized:
        return Sized(-self.value, self.size)

    def __sub__(self, other: Any) -> Sized:
        return self + -sized(other)

    def __rsub__(self, other: Any) -> Sized:
        return sized(other) + -self

    def __mul__(self, other: Any) -> Sized:
        other = sized(other)
        return Sized(self.value * other.value, abs(self.value) * other.size + abs(other.value) * self.size)

    def __truediv__(self, other: Any) -> Sized:
        other = sized(other)
        quotient = self.value / other.value
        return Sized(quotient, (self.size + abs(quotient) * other.size) / abs(other.value))

    def __rtruediv__(self, other: Any) -> Sized:
        return sized(other) / self

    __radd__, __rmul__ = __add__, __mul__


def sized(value: Any) -> Sized:
    """A number as one with a size."""
    return value if isinstance(value, Sized) else Sized(value)


def _applied(function: Any, *arguments: Any) -> Sized:
    """A function of sized numbers; the size of the result includes its change when arguments change by their sizes."""
    given = [sized(argument) for argument in arguments]
    values = [argument.value for argument in given]
    value, size, little = function(*values), mpmath.mpf(0), mpmath.mpf(10) ** -30
    if not isinstance(value, mpmath.mpf) or not mpmath.isfinite(value):
        raise ValueError("no real value")
    for index, argument in enumerate(given):
        moved = [*values[:index], argument.value + little * argument.size, *values[index + 1 :]]
        size += abs(mpmath.re(function(*moved)) - value) / little
    return Sized(value, abs(value) + size)


def _real(value: Any) -> Any:
    return value.value if isinstance(value, Sized) else value


def _only(value: Any) -> Any:
    if not isinstance(value, mpmath.mpf):
        raise ValueError("no real value")
    return value


SIZED = Arithmetic(
    number=Sized,
    function=lambda name: lambda *x: _applied(by_name(name), *x),
    power=lambda b, e: _applied(lambda base: base ** _real(e), b),
    maximum=lambda *x: max(map(sized, x), key=_real),
    minimum=lambda *x: min(map(sized, x), key=_real),
    absolute=lambda x: -sized(x) if _real(x) < 0 else sized(x),
    sign=lambda x: Sized(mpmath.sign(_real(x))),
    where=lambda condition, one, other: one if condition else other,
    real=_real,
)
EXACT = Arithmetic(
    number=mpmath.mpf,
    function=lambda name: lambda *x: _only(by_name(name)(*x)),
    power=lambda b, e: _only(b**e),
    maximum=max,
    minimum=min,
    absolute=abs,
    sign=mpmath.sign,
    where=lambda condition, one, other: one if condition else other,
    real=lambda x: x,
)


def difference(value: Exact, point: Mapping[Symbol, float], by: Sequence[Symbol]) -> tuple[Any, Any]:
    """A value, or its first or second derivative by one or two symbols, at a point, and the error of it."""
    exact = {symbol: mpmath.mpf(float(number)) for symbol, number in point.items()}
    far, near = (_difference(value, exact, by, mpmath.mpf(increment)) for increment in _INCREMENTS)
    # A derivative may be lost beside terms that are far larger.
    smallest = mpmath.mpf(_INCREMENTS[1]) ** len(by)
    return near, abs(far - near) + abs(value(exact)) * mpmath.mpf(10) ** (5 - DIGITS) / smallest


def _difference(value: Exact, point: Mapping[Symbol, Any], by: Sequence[Symbol], increment: Any) -> Any:
    steps = {symbol: increment * (abs(point[symbol]) or 1) for symbol in by}

    def at(*moved: Symbol) -> Any:
        values = dict(point)
        for symbol in moved:
            values[symbol] += steps[symbol]
        return value(values)

    if not by:
        return at()
    if len(by) == 1:
        return (at(by[0]) - at()) / steps[by[0]]
    a, b = by
    return (at(a, b) - at(a) - at(b) + at()) / (steps[a] * steps[b])
