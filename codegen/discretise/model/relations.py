"""What an author writes, checked: values of symbols, and relations as expressions that vanish or are not positive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sympy
from sympy.core import relational
from sympy.logic import boolalg

from codegen.errors import ExpressionError, SymbolError
from codegen.problem.symbols import Coordinate, FreeParameter, Momentum, Parameter, Quantity, State, Velocity
from codegen.symbolic import checks as expressions

MOVING = (Coordinate, Velocity, Momentum, State)
STATIC = (Parameter, FreeParameter)
"""Kinds of symbols: what moves with the system, and what has one value for the whole motion."""


@dataclass(frozen=True)
class Entry:
    """An expression: its `role` in the problem, `what` messages call it, the symbol that it is the value of, if any.

    Relations have a `name` and are either equalities (the expression vanishes) or not (it is not positive).
    """

    role: str
    what: str
    expression: sympy.Expr
    key: Quantity | None = None
    name: str = ""
    equality: bool = True


def entry_of(role: str, what: str, value: Any, key: Quantity | None = None) -> Entry:
    """The entry of an expression; ExpressionError where it is none, or none that can be generated."""
    return Entry(role, what, expressions.checked(value, what), key)


def checked_mapping(what: str, mapping: Any, entry: str) -> Mapping[Quantity, Any]:
    """A mapping whose keys were declared; ExpressionError, or SymbolError for a key, that shows how to write it."""
    if not isinstance(mapping, Mapping):
        relations = f", and relations as {what}_conditions=[...]" if what in ("start", "end") else ""
        raise ExpressionError(f"{what} is a {type(mapping).__name__}", f"write {what} as {{{entry}, ...}}{relations}")
    for key in mapping:
        require_declared(what, "has the key", key)
    return mapping


def require_declared(what: str, has: str, symbol: Any) -> None:
    """Raise SymbolError for a key or an entry of `what` that is no declared symbol."""
    if isinstance(symbol, Quantity):
        return
    is_known = (
        isinstance(symbol, sympy.Expr) and symbol.atoms(Quantity) and symbol.free_symbols <= symbol.atoms(Quantity)
    )
    if what == "bounds" and is_known:
        raise SymbolError(f"bounds has the key {symbol}, which is no symbol", f"write path=[{symbol} <= ...]")
    raise SymbolError(
        f"{what} {has} {symbol!r}, which was never declared",
        "use the symbols that coordinates(...) or control(...) returned",
    )


def checked_sequence(what: str, values: Any, entry: str) -> Sequence[Any]:
    """A list or tuple; ExpressionError that shows how to write it."""
    if not isinstance(values, (list, tuple)):
        found = type(values).__name__
        if isinstance(values, sympy.Basic):
            found = "single relation" if isinstance(values, relational.Relational) else "single expression"
        raise ExpressionError(f"{what} is a {found}", f"write {what} as [{entry}, ...]")
    return values


def value_entries(what: str, mapping: Any) -> Iterator[Entry]:
    """The values that an argument, which is its role, gives to symbols."""
    for key, value in checked_mapping(what, mapping, "symbol: value").items():
        if what in ("start", "end") and isinstance(value, (tuple, list)):
            raise ExpressionError(
                f"{what} of {key} is a {type(value).__name__}",
                f"give one value there, or limits as in {what}_conditions=[{key} >= ..., {key} <= ...]",
            )
        yield entry_of(what, f"{what} of {key}", value, key)


def relation_entries(what: str, values: Any) -> Iterator[Entry]:
    """The relations of an argument, which is their role; ExpressionError for names or relations that occur twice."""
    seen, named = set[sympy.Expr](), set[str]()
    for index, (given_name, written) in enumerate(named_relations(what, values)):
        found = relation(written, f"{what}[{given_name or index!r}]")
        name = given_name or found.name
        if given_name in named:
            raise ExpressionError(f"{what} has two relations of the name {given_name!r}", "give each another name")
        named |= {given_name} if given_name else set()
        if found.expression in seen:
            raise ExpressionError(f"{what} lists {short(name)} twice", "list it once")
        seen.add(found.expression)
        yield Entry(what, f"{what} {short(name)}", found.expression, None, name, found.equality)


def named_relations(what: str, values: Any) -> Iterator[tuple[str, Any]]:
    """Relations, each after the name that its author gave it, or nothing."""
    for value in [*values.items()] if isinstance(values, Mapping) else checked_sequence(what, values, "relation"):
        # A pair is a relation with its name, as mappings have them.
        name, written = value if isinstance(value, tuple) and len(value) == 2 else ("", value)
        yield _given_name(what, name) if isinstance(value, tuple) else "", written


def _given_name(what: str, name: Any) -> str:
    if not isinstance(name, str) or not name.strip() or not name.isprintable():
        raise ExpressionError(f"{what} has the name {name!r}", f'write {what} as {{"name": relation, ...}}')
    return name.strip()


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
    left, right, sign = sides(value)
    left, right = (expressions.checked(side, what) for side in (left, right))
    name = f"{text(left)} {sign} {text(right)}"
    difference = right - left if sign == ">=" else left - right
    # Cancellation shows whether anything is left to hold; the expression stays as its author wrote it.
    remainder = _expanded_to_number(expressions.tidied(difference))
    if remainder is not None:
        raise _decided(f"{what}, {name},", bool(remainder == 0 or (sign != "=" and remainder.is_negative)))
    return Relation(name, expressions.checked(difference, what), sign == "=")


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


def sides(value: Any) -> tuple[Any, Any, str]:
    """Left side, right side and sign of a relation; what is none is to vanish."""
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
