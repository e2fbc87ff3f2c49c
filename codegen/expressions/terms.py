"""Conditions as sums of terms, and terms sorted into a few kinds.

Terms that differ only in the quantities that they read, such as the squared differences in the sides of a polygon, are
instances of one kind: what is done for each kind does not grow with the number of bodies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import count

from sympy import Add, Dummy, Expr, Symbol


@dataclass(frozen=True)
class Kind:
    """An expression of arguments a0, a1, ... that stand for the quantities which an instance reads."""

    expression: Expr
    arguments: tuple[Symbol, ...]


@dataclass(frozen=True)
class Instance:
    """One term: its kind, the condition (row) to which it belongs, and the indices of the quantities that it reads."""

    kind: int
    row: int
    indices: tuple[int, ...]


def sorted_terms(
    conditions: Sequence[Expr], indices: Mapping[Symbol, int]
) -> tuple[tuple[Kind, ...], tuple[Instance, ...]]:
    """The kinds of the terms of conditions, in order of appearance, and all terms; `indices` number the quantities."""
    symbols = set().union(*(condition.free_symbols for condition in conditions))
    taken = {symbol.name for symbol in symbols - indices.keys()}
    fresh = (Symbol(f"a{i}", real=True) for i in count() if f"a{i}" not in taken)
    arguments: list[Symbol] = []
    kinds: dict[Kind, int] = {}
    instances = []
    for row, condition in enumerate(conditions):
        for term in Add.make_args(condition):
            read = sorted(term.free_symbols & indices.keys(), key=lambda symbol: indices[symbol])
            arguments += [next(fresh) for _ in read[len(arguments) :]]
            general = _signed(term.xreplace(dict(zip(read, arguments, strict=False))))
            kind = kinds.setdefault(Kind(general, tuple(arguments[: len(read)])), len(kinds))
            instances.append(Instance(kind, row, tuple(indices[symbol] for symbol in read)))
    return tuple(kinds), tuple(instances)


def distinct(conditions: Sequence[Expr], quantities: Sequence[Symbol]) -> tuple[int, ...]:
    """The indices of those conditions that do not merely repeat an earlier one with other quantities."""
    indices = {symbol: index for index, symbol in enumerate(quantities)}
    arguments = [Dummy(f"a{i}", real=True) for i in range(len(quantities))]
    first: dict[Expr, int] = {}
    for index, condition in enumerate(conditions):
        read = sorted(condition.free_symbols & indices.keys(), key=lambda symbol: indices[symbol])
        first.setdefault(_signed(condition.xreplace(dict(zip(read, arguments, strict=False)))), index)
    return tuple(first.values())


def _signed(expression: Expr) -> Expr:
    """An equal expression in which (b - a)^2 is (a - b)^2, so that both are seen to be the same."""
    return expression.replace(
        lambda e: e.is_Pow and e.exp.is_even and e.base.could_extract_minus_sign(), lambda e: (-e.base) ** e.exp
    )
