"""How far a value may be from another one by rounding of the numbers that an author gave."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping

from sympy import Add, Expr, Symbol

from codegen.expressions.checks import rounded_at

GIVEN = 1e-9
"""Relative error of the numbers that authors give, who copy nine or ten digits."""
_ROUNDINGS = 200
"""Of numbers about one, such as sin(pi) or 0.1 + 0.2 - 0.3, which authors leave to a computer."""


def rounding_of(sizes: Iterable[float]) -> float:
    """The rounding of a sum, or of a comparison, of numbers of some sizes that an author gave."""
    return max(GIVEN * max(map(abs, sizes), default=0.0), _ROUNDINGS * sys.float_info.epsilon)


def rounding_at(expression: Expr, values: Mapping[Symbol, float]) -> float:
    """The rounding of an expression: that of the largest of its terms, and what rounding of each value makes of it.

    The second is for terms that stand inside functions and products: x^2 + y^2 - R^2 and sqrt(x^2 + y^2) - R are
    as uncertain as their terms, whatever is left of them.
    """
    middle = rounded_at(expression, values)
    terms = (rounded_at(term, values) for term in Add.make_args(expression))
    rounding = rounding_of(term for term in terms if term is not None)
    for symbol in sorted(expression.free_symbols & set(values), key=str):
        sides = (rounded_at(expression, {**values, symbol: values[symbol] * (1 + s * GIVEN)}) for s in (-1, 1))
        rounding += max((abs(side - middle) for side in sides if side is not None and middle is not None), default=0.0)
    return rounding
