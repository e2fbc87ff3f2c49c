"""Read what an author wrote: values of symbols, and relations as expressions that vanish or are not positive."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from sympy.core import relational
from sympy.logic import boolalg

from codegen.errors import ExpressionError, SymbolError
from codegen.problem.problem import Expression
from codegen.problem.rotations import in_matrices, names_of, spheres_in
from codegen.problem.symbols import Coordinate, FreeParameter, Momentum, Parameter, Quantity, State, Velocity
from codegen.symbolic import checks as expressions

MOVING = (Coordinate, Velocity, Momentum, State)
"""Kinds of symbols whose values change along the motion."""
STATIC = (Parameter, FreeParameter)
"""Kinds of symbols that have one value for the whole motion."""


@dataclass(frozen=True)
class Entry:
    """An expression of a problem.

    `role` is where it occurs, such as "cost" or "start". `what` is its name in messages, and `key` the symbol that it
    belongs to, if any. Relations have a `name`: in an equality the expression vanishes, else it is not positive.
    """

    role: str
    what: str
    expression: sympy.Expr
    key: Quantity | None = None
    name: str = ""
    equality: bool = True


def entry_of(role: str, what: str, value: Expression, key: Quantity | None = None) -> Entry:
    """Return the entry of an expression; raise ExpressionError for a value from which no code can be generated."""
    return Entry(role, what, expressions.checked(value, what), key)


def checked_mapping(what: str, mapping: object, entry: str) -> Mapping[Quantity, Expression]:
    """Return a mapping with declared keys; raise SymbolError, or ExpressionError with the notation of an `entry`."""
    if not isinstance(mapping, Mapping):
        relations = f", and relations as {what}_conditions=[...]" if what in ("start", "end") else ""
        raise ExpressionError(f"{what} is a {type(mapping).__name__}", f"write {what} as {{{entry}, ...}}{relations}")
    for key in mapping:
        require_declared(what, "has the key", key)
    return mapping


def require_declared(what: str, has: str, symbol: Expression) -> None:
    """Raise SymbolError for an undeclared symbol in the argument `what`; `has` is the verb of the message."""
    if isinstance(symbol, Quantity):
        return
    if isinstance(symbol, tuple) and symbol and all(isinstance(one, Quantity) for one in symbol):
        raise SymbolError(
            f"{what} {has} {symbol}, which is a tuple of symbols",
            'unpack it, as in x, y = states("x y"), or declare a single one, as in x = state("x")',
        )
    quantities = symbol.atoms(Quantity) if isinstance(symbol, sympy.Expr) else set()
    if what == "bounds" and quantities and symbol.free_symbols <= quantities:
        raise SymbolError(
            f"bounds has the key {text(symbol)}, which is no symbol", f"write path=[{text(symbol)} <= ...]"
        )
    if spheres := spheres_in(symbol):
        is_matrix = getattr(symbol, "is_Matrix", False)
        key = names_of(sorted(symbol.free_symbols, key=str))[-1] if is_matrix else text(symbol)
        remedy = f"give all of R or omega, by the matrix that the declaration of {spheres[0].name} returned"
        if what.startswith("then of"):
            remedy = "an event changes no rotation or unit vector: end the motion there, and start another one"
        raise SymbolError(f"{what} {has} {key}, which is no single symbol", remedy)
    raise SymbolError(
        f"{what} {has} {short(repr(symbol))}, which was never declared",
        "use the symbols that coordinates(...) or control(...) returned",
    )


def checked_sequence(what: str, values: object, entry: str) -> Sequence[Expression]:
    """Return a list or tuple; raise ExpressionError, with the notation `entry` of an item, for other objects."""
    if not isinstance(values, (list, tuple)):
        kind = type(values).__name__
        if isinstance(values, sympy.Basic):
            kind = "single relation" if isinstance(values, relational.Relational) else "single expression"
        raise ExpressionError(f"{what} is a {kind}", f"write {what} as [{entry}, ...]")
    return values


def value_entries(what: str, mapping: object) -> Iterator[Entry]:
    """Yield an Entry for each value of the argument `what`, a mapping by symbols; the role is `what`."""
    for key, value in checked_mapping(what, mapping, "symbol: value").items():
        if what in ("start", "end") and isinstance(value, (tuple, list)):
            raise ExpressionError(
                f"{what} of {key} is a {type(value).__name__}",
                f"give one value there, or limits as in {what}_conditions=[{key} >= ..., {key} <= ...]",
            )
        if what == "guess" and isinstance(value, (tuple, list, np.ndarray)):
            remedy = (
                'write a function of time(), or a Table of time, or all guesses in a file: guess=Trajectory("g.csv")'
            )
            raise ExpressionError(f"guess of {key} is a {type(value).__name__}", remedy)
        yield entry_of(what, f"{what} of {key}", value, key)


def relation_entries(what: str, values: object) -> Iterator[Entry]:
    """Yield an Entry for each relation in the argument `what`; the role is `what`.

    Raise ExpressionError for equal names or relations.
    """
    seen, named = set[sympy.Expr](), set[str]()
    for index, (chosen_name, written) in enumerate(named_relations(what, values)):
        written_name, expression, equality = relation(written, f"{what}[{chosen_name or index!r}]")
        name = chosen_name or written_name
        if chosen_name in named:
            raise ExpressionError(f"{what} has two relations of the name {chosen_name!r}", "give each another name")
        named |= {chosen_name} if chosen_name else set()
        if expression in seen:
            raise ExpressionError(f"{what} lists {short(name)} twice", "list it once")
        seen.add(expression)
        yield Entry(what, f"{what} {short(name)}", expression, None, name, equality)


def named_relations(what: str, values: object) -> Iterator[tuple[str, Expression]]:
    """Yield pairs of the author's name for a relation, or "" without a name, and the relation."""
    for value in [*values.items()] if isinstance(values, Mapping) else checked_sequence(what, values, "relation"):
        if not isinstance(value, tuple):
            yield "", value
            continue
        # A pair is a relation with its name, as in the items of a mapping.
        name, written = value if len(value) == 2 else ("", value)
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ExpressionError(f"{what} has the name {name!r}", f'write {what} as {{"name": relation, ...}}')
        yield name.strip(), written


def text(expression: sympy.Expr) -> str:
    """Return an expression on one line, with decimal numbers as short as their author wrote them."""
    return str(sympy.sstr(in_matrices(expression), full_prec=False))


def short(name: str, limit: int = 60) -> str:
    """Return the name of a condition, shortened for messages."""
    return name if len(name) <= limit else f"{name[:limit].rstrip()} ..."


def relation(value: Expression, what: str) -> tuple[str, sympy.Expr, bool]:
    """Read Eq(a, b), a <= b, a >= b, a < b, a > b, or an expression that is to vanish.

    Return the relation as it was written, an expression that vanishes or is not positive, and True if it vanishes.
    A strict inequality means the same as the inequality that is not strict. Raises ExpressionError with the name `what`
    if the value is no single relation, or if it holds always or never.
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
    # Expansion detects a relation between numbers; the returned expression remains as its author wrote it.
    remainder = _expanded_to_number(expressions.tidied(difference))
    if remainder is not None:
        raise _decided(f"{what}, {name},", bool(remainder == 0 or (sign != "=" and remainder.is_negative)))
    return name, expressions.checked(difference, what), sign == "="


def _expanded_to_number(expression: sympy.Expr) -> sympy.Expr | None:
    """Return the number that an expression equals after expansion, or None."""
    terms = sympy.Add.make_args(expression)
    counts = Counter(symbol for term in terms for symbol in term.free_symbols)
    for term in terms:
        # A symbol in one term alone cannot cancel with other terms; to expand this term alone is faster.
        alone = {symbol for symbol in term.free_symbols if counts[symbol] == 1}
        if alone:
            if sympy.expand(term).free_symbols & alone:
                return None
            break
    remainder = sympy.expand(expression)
    return remainder if remainder.is_number else None


def sides(value: Expression) -> tuple[Expression, Expression, str]:
    """Return left side, right side and sign ("=", "<=" or ">=") of a relation; a plain expression equals zero."""
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
