"""Checks on single sympy expressions: real, finite, printable, of full rank."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

import numpy as np
import sympy
from sympy.core.function import AppliedUndef

from codegen.errors import ExpressionError

PRINTABLE = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
    *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.acosh, sympy.atanh),
    *(sympy.exp, sympy.log, sympy.Abs, sympy.sign, sympy.Min, sympy.Max, sympy.Piecewise, sympy.Heaviside),
)
"""Functions that the printer knows how to write as numba code."""


def checked(value: Any, what: str) -> sympy.Expr:
    """Sympify a scalar; ExpressionError names `what` when it is no finite real scalar of known functions."""
    if isinstance(value, (str, bool)) or value is None:
        raise ExpressionError(f"{what} is {value!r}", "give a sympy expression or a number")
    try:
        expression = sympy.sympify(value, strict=True)
    except (sympy.SympifyError, TypeError, ValueError):
        raise ExpressionError(f"{what} is a {type(value).__name__}", "give one sympy expression or number") from None
    if not isinstance(expression, sympy.Expr) or getattr(expression, "is_Matrix", False):
        raise ExpressionError(f"{what} is a {type(expression).__name__}", "give one scalar expression")
    bad = expression.atoms(sympy.S.NaN.__class__) | {
        atom for atom in expression.atoms(sympy.Number, sympy.core.numbers.ComplexInfinity) if not atom.is_finite
    }
    if bad:
        raise ExpressionError(f"{what} contains {min(bad, key=str)}", "use finite numbers only")
    if expression.has(sympy.I):
        raise ExpressionError(f"{what} is complex", "use real expressions")
    for function in sorted(expression.atoms(sympy.Function), key=str):
        if isinstance(function, AppliedUndef) or not isinstance(function, PRINTABLE):
            raise ExpressionError(f"{what} uses {function.func}, which cannot be printed", "use elementary functions")
    return expression


def tidied(expression: sympy.Expr) -> sympy.Expr:
    """Write decimal numbers as the rationals that they stand for, so that cancellation is exact (0.5 -> 1/2)."""
    numbers = {number: sympy.Rational(str(number)) for number in expression.atoms(sympy.Float)}
    return expression.xreplace(numbers)


def number_at(expression: sympy.Expr, values: Mapping[sympy.Symbol, float]) -> float | None:
    """The value of an expression as a float, or None when it is not a finite real number there."""
    try:
        number = complex(expression.evalf(subs=dict(values)))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    if abs(number.imag) > 0.0 or not abs(number.real) < float("inf"):
        return None
    return number.real


def null_direction(matrix: sympy.Matrix, seed: int = 1) -> np.ndarray | None:
    """A unit vector in the null space of a square symbolic matrix that is singular everywhere, else None.

    Decided by the numerical rank at random points, where a matrix that is not identically singular is regular with
    probability one; this stays cheap where a symbolic determinant would not.
    """
    generator = random.Random(seed)
    symbols = sorted(matrix.free_symbols, key=str)
    direction = None
    for _ in range(8):
        point = {symbol: generator.uniform(0.4, 1.6) for symbol in symbols}
        try:
            values = np.array(matrix.evalf(subs=point).tolist(), dtype=float)
        except (TypeError, ValueError):
            continue
        if not np.all(np.isfinite(values)):
            continue
        scale = float(np.abs(values).max(initial=0.0))
        _, singular, right = np.linalg.svd(values)
        if scale > 0.0 and singular[-1] > 1e-11 * scale:
            return None
        direction = right[-1]
    return direction
