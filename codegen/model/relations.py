"""Relations as an author writes them, turned into expressions that vanish or are not positive."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import sympy
from sympy.core import relational
from sympy.logic import boolalg

from codegen.errors import ExpressionError
from codegen.expressions import checks as expressions


@dataclass(frozen=True)
class Relation:
    """`expression` vanishes, or (`equality` false) is not positive; `name` is the relation as it was written."""

    name: str
    expression: sympy.Expr
    equality: bool


def text(expression: sympy.Expr) -> str:
    """An expression on one line, with decimal numbers no longer than their author wrote them."""
    return str(sympy.sstr(expression, full_prec=False))


def short(name: str, limit: int = 60) -> str:
    """The beginning of a long condition, as messages show it; a name that its author gave it says more."""
    return name if len(name) <= limit else f"{name[:limit].rstrip()} ..."


def relation(value: Any, what: str) -> Relation:
    """Read Eq(a, b), a <= b, a >= b, a < b, a > b, or an expression that is to vanish.

    A strict inequality means the same as one that is not strict. ExpressionError names `what` when the value is no
    single relation, or when it holds always or never.
    """
    if isinstance(value, (bool, boolalg.BooleanAtom)):
        if value is False:
            raise ExpressionError(f"{what} is False", "write Eq(a, b), because a == b compares how a and b are written")
        raise _decided(what, bool(value))
    if isinstance(value, boolalg.And):
        raise ExpressionError(f"{what} joins relations by And", "give each relation as an entry of its own")
    if isinstance(value, relational.Unequality):
        raise ExpressionError(f"{what} is {text(value)}", "write an inequality instead, such as a <= b")
    if isinstance(value, (boolalg.Or, boolalg.Not, boolalg.Xor)):
        raise ExpressionError(
            f"{what} joins relations by {type(value).__name__}", "give relations that all hold, one entry each"
        )
    left, right, sign = _sides(value)
    left, right = (expressions.checked(side, what) for side in (left, right))
    name = f"{text(left)} {sign} {text(right)}"
    difference = right - left if sign == ">=" else left - right
    # Cancellation shows whether anything is left to hold; the expression stays as its author wrote it.
    remainder = _expanded_to_number(expressions.tidied(difference))
    if remainder is not None:
        raise _decided(f"{what}, {name},", bool(remainder == 0 or (sign != "=" and remainder.is_negative)))
    return Relation(name, expressions.checked(difference, what), sign == "=")


def integral_sides(value: Any, what: str, moving: tuple[type, ...]) -> tuple[sympy.Expr, sympy.Expr]:
    """The integrand, and what its integral equals or does not exceed, with the signs that say so.

    The integrand is the side with symbols of the `moving` kinds. ExpressionError unless that is one side alone.
    """
    left, right, sign = _sides(value)
    left, right = (expressions.checked(side, what) for side in (left, right))
    moves = [any(isinstance(symbol, moving) for symbol in side.free_symbols) for side in (left, right)]
    if all(moves):
        raise ExpressionError(
            f"both sides of {what} move", "write the integrand on one side, its integral's value on the other"
        )
    if not any(moves):
        raise ExpressionError(
            f"{what} has no integrand, since nothing in it moves", "write Eq(integrand, value), or leave it out"
        )
    integrand, limit = (left, right) if moves[0] else (right, left)
    at_least = (sign == ">=") == moves[0] and sign != "="
    return (-integrand, -limit) if at_least else (integrand, limit)


def _expanded_to_number(expression: sympy.Expr) -> sympy.Expr | None:
    """The number to which an expression cancels, if it does."""
    terms = sympy.Add.make_args(expression)
    counts = Counter(symbol for term in terms for symbol in term.free_symbols)
    for term in terms:
        # What a single term depends on cannot cancel with the others; expanding them all takes longer.
        alone = {symbol for symbol in term.free_symbols if counts[symbol] == 1}
        if alone:
            if sympy.expand(term).free_symbols & alone:
                return None
            break
    remainder = sympy.expand(expression)
    return remainder if remainder.is_number else None


def _sides(value: Any) -> tuple[Any, Any, str]:
    if isinstance(value, relational.Equality):
        return value.lhs, value.rhs, "="
    if isinstance(value, (relational.LessThan, relational.StrictLessThan)):
        return value.lhs, value.rhs, "<="
    if isinstance(value, (relational.GreaterThan, relational.StrictGreaterThan)):
        return value.lhs, value.rhs, ">="
    return value, sympy.S.Zero, "="


def _decided(what: str, holds: bool) -> ExpressionError:
    if holds:
        return ExpressionError(f"{what} always holds", "leave it out")
    return ExpressionError(f"{what} never holds", "correct it, or leave it out")
