"""Checks of sympy expressions: real, finite, printable, of full rank; rounding errors of authors' numbers."""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from itertools import islice

import numpy as np
import sympy
from sympy import Add, Expr, Symbol
from sympy.core.function import AppliedUndef

from codegen.errors import ExpressionError
from codegen.symbolic import functions
from codegen.symbolic.functions import TableBase
from codegen.symbolic.parts import parts
from codegen.symbolic.terms import EachBodyBase
from codegen.symbolic.zeros import identically_zero

PRINTABLE = (
    *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
    *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.acosh, sympy.atanh),
    *(sympy.exp, sympy.log, sympy.Abs, sympy.Min, sympy.Max, sympy.Piecewise),
    *(sympy.erf, sympy.erfc, functions.gamma, functions.lgamma, functions.OrderedBase),
    *(TableBase, EachBodyBase),
)
"""Functions that the printer can write as numba code."""

_TINY = 1e-50
"""Values below this size may be rounding errors after cancellation and are checked again."""
_ARITHMETIC = (
    *(sympy.Symbol, sympy.Number, sympy.NumberSymbol, sympy.Add, sympy.Mul, sympy.Pow),
    *(sympy.functions.elementary.piecewise.ExprCondPair, sympy.core.relational.Relational),
    *(sympy.logic.boolalg.BooleanAtom, sympy.And, sympy.Or, sympy.Not),
)

_WIDE = 100
"""Decimal exponent, positive or negative, beyond which factors are moved into an exponential."""


def checked(value: object, what: str) -> sympy.Expr:
    """Return a sympy scalar; ExpressionError names `what` unless it is finite, real and made of printable functions."""
    if hasattr(value, "data") and callable(value) and hasattr(value.data, "shape"):
        call = f"{value.data.shape.name}({', '.join(value.data.shape.inputs)})"
        raise ExpressionError(f"{what} is a {type(value).__name__}", f"call it, as in {call}")
    if isinstance(value, (str, bool)) or value is None:
        raise ExpressionError(f"{what} is {value!r}", "give a sympy expression or a number")
    try:
        expression = sympy.sympify(value, strict=True)
    except (sympy.SympifyError, TypeError, ValueError):
        raise ExpressionError(f"{what} is a {type(value).__name__}", "give one sympy expression or number") from None
    if getattr(expression, "is_Matrix", False):
        raise ExpressionError(f"{what} is a matrix", "give one scalar expression, such as a.dot(b) for a.T @ b")
    if not isinstance(expression, sympy.Expr):
        raise ExpressionError(f"{what} is a {type(expression).__name__}", "give one scalar expression")
    expression = functions.rewritten(with_exponents_together(expression), what)
    for atom in sorted(expression.atoms(sympy.Number, sympy.core.numbers.ComplexInfinity), key=str):
        if not atom.is_finite or not (atom.is_zero or sys.float_info.min <= abs(atom) <= sys.float_info.max):
            number = sympy.N(atom, 15) if atom.is_finite else atom
            remedy = "scale it, or write it as the exponential of its logarithm" if atom.is_finite else "leave it out"
            raise ExpressionError(f"{what} contains {number}, which no double-precision number is", remedy)
    if expression.has(sympy.I):
        raise ExpressionError(f"{what} is complex", "use real expressions")
    for part in parts(expression):
        if isinstance(part, AppliedUndef) or not isinstance(part, (*_ARITHMETIC, *PRINTABLE)):
            raise functions.refusal(part, what)
    return expression


def with_exponents_together(expression: sympy.Expr) -> sympy.Expr:
    """Return an expression with huge and tiny factors inside exponentials, such as exp(885.85 - 885.85 x).

    sympy splits such an exponential into 6.4e384 exp(-885.85 x), which overflows. It does not split exponents whose
    constant part is a fraction.
    """
    if not any(abs(sympy.log(abs(c), 10).evalf()) > _WIDE for c in expression.atoms(sympy.Float) if not c.is_zero):
        return expression

    def joined(product: sympy.Expr) -> sympy.Expr:
        """Return a product with its decimal factor inside the exponent, if an exponential is a direct factor."""
        factor, rest = product.as_coeff_Mul()
        powers = [f for f in sympy.Mul.make_args(rest) if isinstance(f, sympy.exp)]
        if not powers or not factor.is_Float or abs(sympy.log(abs(factor), 10).evalf()) <= _WIDE:
            return product
        exponent = sympy.log(abs(factor)).evalf(30)
        short = sympy.Rational(str(exponent.n(14)))
        same = abs(sympy.exp(short).evalf(30) / abs(factor) - 1) < sympy.Float(abs(exponent)) * sys.float_info.epsilon
        power = sympy.exp((short if same else sympy.Rational(str(exponent))) + tidied(powers[0].args[0]))
        return sympy.sign(factor) * power * (rest / powers[0])

    return expression.replace(lambda part: part.is_Mul and bool(part.atoms(sympy.exp)), joined)


def tidied(expression: sympy.Expr) -> sympy.Expr:
    """Return an expression with rationals in place of decimals, so that cancellation is exact (0.5 -> 1/2)."""
    numbers = {number: sympy.Rational(str(number)) for number in expression.atoms(sympy.Float)}
    return expression.xreplace(numbers)


def multiplied_out(expression: sympy.Expr) -> int:
    """Return the largest number of terms of an expression after expansion of all products and powers of sums.

    The time of sympy.expand grows with this number: the cube of a sum of 20 squares has 1540 terms.
    """
    if expression.is_Add:
        return sum(map(multiplied_out, expression.args))
    if expression.is_Mul:
        return math.prod(map(multiplied_out, expression.args))
    if expression.is_Pow and expression.exp.is_Rational:
        terms, power = multiplied_out(expression.base), int(abs(expression.exp))
        return max(terms, math.comb(terms + power - 1, power))
    return max([1, *map(multiplied_out, expression.args)])


def longer_than(limit: int, terms: Sequence[sympy.Expr]) -> bool:
    """Return True if the terms together have more operations than the limit; counting stops early."""
    most = 5 * (limit + len(terms))  # five parts for an operation: itself, two symbols, a sign, a number
    parts = (part for term in terms for part in sympy.preorder_traversal(term))
    if sum(1 for _ in islice(parts, most + 1)) > most:
        return True
    return sum(int(term.count_ops()) for term in terms) > limit


def number_at(expression: sympy.Expr, values: Mapping[sympy.Symbol, float]) -> float | None:
    """Return the value of an expression at `values` to 15 digits, or None if it is not a finite real number.

    If all terms cancel, the result is a number like 1e-125 instead of zero.
    """
    return _real(lambda: expression.evalf(subs=dict(values)))


def rounded_at(expression: sympy.Expr, values: Mapping[sympy.Symbol, float]) -> float | None:
    """Return the value of an expression in floating-point arithmetic, or None if it is not a finite real number."""
    present = expression.free_symbols
    floats = {symbol: sympy.Float(value) for symbol, value in values.items() if symbol in present}
    return _real(lambda: expression.xreplace(floats).evalf())


def _real(evaluate: Callable[[], sympy.Expr]) -> float | None:
    try:
        number = complex(evaluate())
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    if abs(number.imag) > 0.0 or not abs(number.real) < float("inf"):
        return None
    return number.real


def sample_points(
    symbols: Collection[sympy.Symbol], fixed: Mapping[sympy.Symbol, float], likely: Mapping[sympy.Symbol, float]
) -> Iterator[dict[sympy.Symbol, float]]:
    """Yield 32 points for trial evaluations, the same in every run: eight of ordinary size, then of all magnitudes.

    All points have the `fixed` values. Only the first point has the `likely` values.
    """
    generator = random.Random(1)
    ordered = sorted(symbols, key=str)
    for trial in range(32):
        if trial < 8:
            drawn = {symbol: generator.uniform(0.4, 1.6) for symbol in ordered}
        else:
            drawn = {symbol: generator.choice((-1, 1)) * 10 ** generator.uniform(-4, 4) for symbol in ordered}
        yield {**drawn, **(likely if trial == 0 else {}), **fixed}


def null_direction(samples: Iterable[np.ndarray | None]) -> np.ndarray | None:
    """Return a null vector of a square matrix if all samples of the matrix are singular, else None.

    The numerical rank decides: a matrix that is not identically singular is regular at a random point with probability
    one. A symbolic determinant would take longer. Rows and columns are scaled first, so that large and small masses may
    occur together. The result is also None if every sample is None (no real values).
    """
    direction = None
    for values in samples:
        if values is None:
            continue
        size = np.sqrt(np.abs(values).max(axis=1, initial=0.0))
        size[size == 0.0] = 1.0
        _, singular, right = np.linalg.svd(values / np.outer(size, size))
        if singular[-1] > 1e-11:
            return None
        direction = right[-1]
    return direction


def dependent_rows(matrix: sympy.Matrix, points: Iterable[Mapping[sympy.Symbol, float]]) -> np.ndarray | None:
    """Return weights of the rows of a symbolic matrix with which their sum vanishes, if the rows are dependent.

    Rows are scaled to unit length first; a row of zeros is dependent by itself. Return None if the rows are independent
    at some point, or if the matrix has no real value at any point.
    """
    combination = None
    for point in points:
        values = values_at(matrix, point)
        if values is None:
            continue
        size = np.linalg.norm(values, axis=1)
        size[size == 0.0] = 1.0
        left, singular, _ = np.linalg.svd(values / size[:, None])
        if len(singular) == matrix.rows and singular[-1] > 1e-11:
            return None
        combination = left[:, -1]
    return combination


def values_at(matrix: sympy.Matrix, point: Mapping[sympy.Symbol, float]) -> np.ndarray | None:
    """Return a matrix at a point as floats, or None if an entry is not a finite real number."""
    try:
        values = np.array(matrix.evalf(subs=point).tolist(), dtype=float).reshape(matrix.shape)
    except (TypeError, ValueError):
        return None
    for index in np.argwhere((values != 0.0) & (np.abs(values) < _TINY)):
        row, column = map(int, index)
        entry, value = matrix[row, column], float(values[row, column])
        # A tiny value may be a rounding error of evalf, which works with 100 digits.
        terms = [rounded_at(term, point) for term in entry.args] if entry.is_Add else []
        if identically_zero(entry) or abs(value) < 1e-90 * sum(abs(term) for term in terms if term is not None):
            values[row, column] = 0.0
    return values if np.all(np.isfinite(values)) else None


GIVEN = 1e-9
"""Relative error of an author's numbers, which have nine or ten digits."""
_ROUNDINGS = 200
"""Rounding error of computed numbers such as sin(pi) or 0.1 + 0.2 - 0.3, in units of epsilon."""


def rounding_of(sizes: Iterable[float]) -> float:
    """Return the rounding error of a sum or comparison of an author's numbers; `sizes` are the numbers."""
    return max(GIVEN * max(map(abs, sizes), default=0.0), _ROUNDINGS * sys.float_info.epsilon)


def rounding_at(expression: Expr, values: Mapping[Symbol, float]) -> float:
    """Return the rounding error of an expression at `values`: of its largest term, plus the effect of each value.

    The second part covers terms inside functions and products. For example, x^2 + y^2 - R^2 and sqrt(x^2 + y^2) - R are
    as uncertain as their terms, however small the difference is.
    """
    middle = rounded_at(expression, values)
    terms = (rounded_at(term, values) for term in Add.make_args(expression))
    rounding = rounding_of(term for term in terms if term is not None)
    for symbol in sorted(expression.free_symbols & set(values), key=str):
        sides = (rounded_at(expression, {**values, symbol: values[symbol] * (1 + s * GIVEN)}) for s in (-1, 1))
        rounding += max((abs(side - middle) for side in sides if side is not None and middle is not None), default=0.0)
    return rounding
