"""Functions of complex arrays that continue real ones, so that complex steps differentiate them exactly.

With a tiny imaginary part, f(x + i d) = f(x) + i d f'(x) to all digits (Squire and Trapp, 1998, Using complex variables
to estimate derivatives of real functions, SIAM Review 40). What has branches chooses them by real parts; outside the
real domain of a function the result is NaN, as it is in machine code.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mpmath
import numpy as np

from codegen.expressions.special_functions import STEMS, by_name

Array = Any
Function = Callable[..., Array]


def power(base: Array, exponent: Array) -> Array:
    """The power; NaN where a negative number has an exponent that is not whole."""
    if isinstance(exponent, int):
        return np.asarray(base) ** exponent
    exponent = np.asarray(exponent)
    whole = (exponent.real == np.round(exponent.real)) & (exponent.imag == 0)
    if whole.all() and exponent.ndim == 0:
        return np.asarray(base) ** int(exponent.real)
    base = np.asarray(base)
    return np.where((base.real >= 0) | whole, _complex(base) ** exponent, np.nan)


def maximum(*values: Array) -> Array:
    """The value with the largest real part."""
    return _chosen(values, lambda a, b: a.real >= b.real)


def minimum(*values: Array) -> Array:
    """The value with the smallest real part."""
    return _chosen(values, lambda a, b: a.real <= b.real)


def absolute(value: Array) -> Array:
    """The value or its negative, whose real part is positive."""
    return value * sign(value)


def sign(value: Array) -> Array:
    """The sign of the real part."""
    return np.sign(np.asarray(value).real)


def where(condition: Array, one: Array, other: Array) -> Array:
    """One value where a condition holds, else the other."""
    return np.where(condition, one, other)


def named(name: str) -> Function:
    """The function of one variable (atan2: two) that `math` or `mpmath` knows by a name."""
    if name in _INSIDE:
        function, inside = _INSIDE[name]
        return lambda x: np.where(inside(np.asarray(x).real), function(_complex(x)), np.nan)
    if name in _ENTIRE:
        return lambda x: _ENTIRE[name](_complex(x))
    return _arctangent if name == "atan2" else _by_digits(by_name(name))


def _extended(number: Any) -> Any:
    """A number of mpmath with the digits of an extended one; beyond its range it is zero or infinite."""
    size = abs(number)
    if size < _SMALLEST or not size < 1 / _SMALLEST:
        return np.longdouble(0) if size < 1 else np.longdouble(mpmath.sign(number)) * np.inf
    return np.longdouble(mpmath.nstr(number, 25))


_SMALLEST = mpmath.mpf(10) ** -4900
CONTINUED: dict[str, Function] = {
    **{name: (lambda x, name=name: named(name)(x)) for name in ("erf", "erfc", "gamma")},
    "gammaln": lambda x: named("lgamma")(x),
    **{stem: (lambda order, x, stem=stem: named(f"{stem}_{order}")(x)) for stem in STEMS},
}
"""Functions for lambdify that numpy does not continue, by the names that it prints."""


def _chosen(values: Sequence[Array], better: Callable[[Array, Array], Array]) -> Array:
    found = np.asarray(values[0])
    for value in map(np.asarray, values[1:]):
        found = np.where(better(found, value), found, value)
    return found


def _complex(value: Array) -> Array:
    array = np.asarray(value)
    return array if np.iscomplexobj(array) else array.astype(np.clongdouble)


def _arctangent(y: Array, x: Array) -> Array:
    y, x = _complex(y), _complex(x)
    square = x.real**2 + y.real**2
    return np.arctan2(y.real, x.real) + 1j * ((x.real * y.imag - y.real * x.imag) / square)


def _by_digits(function: Callable[[Any], Any]) -> Function:
    """A function that numpy does not continue: its value and derivative with 30 digits, one number after the other."""

    def continued(x: Array) -> Array:
        values = _complex(x)
        found = np.empty(values.shape, values.dtype)
        known: dict[Any, tuple[Any, Any]] = {}
        for index, value in np.ndenumerate(values):
            if value.real not in known:
                known[value.real] = _value_and_slope(function, value.real)
            height, slope = known[value.real]
            found[index] = height + 1j * (slope * value.imag)
        return found

    return continued


def _value_and_slope(function: Callable[[Any], Any], at: Any) -> tuple[Any, Any]:
    with mpmath.workdps(30):
        try:
            point = mpmath.mpf(str(at))
            return _extended(function(point)), _extended(mpmath.diff(function, point))
        except (TypeError, ValueError, ArithmeticError):
            return np.nan, np.nan


_INSIDE: dict[str, tuple[Function, Function]] = {
    "sqrt": (np.sqrt, lambda x: x >= 0),
    "log": (np.log, lambda x: x > 0),
    "log1p": (np.log1p, lambda x: x > -1),
    "asin": (np.arcsin, lambda x: abs(x) < 1),
    "acos": (np.arccos, lambda x: abs(x) < 1),
    "acosh": (np.arccosh, lambda x: x > 1),
    "atanh": (np.arctanh, lambda x: abs(x) < 1),
}
_ENTIRE: dict[str, Function] = {
    **{name: getattr(np, name) for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh", "exp", "expm1")},
    "atan": np.arctan,
    "asinh": np.arcsinh,
}
