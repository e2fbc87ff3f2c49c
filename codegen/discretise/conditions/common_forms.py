"""Expressions that differ in numbers alone, such as x - 1 and x - 2, as one form with different values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from sympy import Add, Expr, Mul, Pow, Symbol


@dataclass(frozen=True)
class Form:
    """An expression in `places`, which stand for numbers, and for each of the expressions of this form its values.

    `members` maps the indices of the expressions to values in the order of the places.
    """

    expression: Expr
    places: tuple[Symbol, ...]
    members: Mapping[int, tuple[Expr, ...]]


def common_forms(expressions: Sequence[Expr], moving: AbstractSet[Symbol]) -> tuple[Form, ...]:
    """The forms of expressions, in the order in which they occur first.

    What holds none of the `moving` symbols is a number, however it is written. Exponents are part of the form, and so
    is every number that all expressions of the form share.
    """
    groups: dict[str, dict[int, tuple[Expr, tuple[Expr, ...]]]] = {}
    for index, expression in enumerate(expressions):
        values = list[Expr]()
        pattern = _sum(expression, moving, values)
        groups.setdefault(str(pattern), {})[index] = pattern, tuple(values)
    return tuple(map(_form, groups.values()))


def _form(group: Mapping[int, tuple[Expr, tuple[Expr, ...]]]) -> Form:
    pattern, values = next(iter(group.values()))
    different = [i for i in range(len(values)) if any(own[i] != values[i] for _, own in group.values())]
    shared = {_place(i): value for i, value in enumerate(values) if i not in different}
    return Form(
        pattern.xreplace(shared),
        tuple(map(_place, different)),
        {index: tuple(own[i] for i in different) for index, (_, own) in group.items()},
    )


def _place(index: int) -> Symbol:
    return Symbol(f"number[{index}]", real=True)


def _noted(value: Expr, values: list[Expr]) -> Symbol:
    values.append(value)
    return _place(len(values) - 1)


def _pattern(expression: Expr, moving: AbstractSet[Symbol], values: list[Expr]) -> Expr:
    """The expression with places, and its numbers added to `values`."""
    if not expression.free_symbols & moving:
        return _noted(expression, values)
    if not expression.args:
        return expression
    if isinstance(expression, Add):
        return _sum(expression, moving, values)
    if isinstance(expression, Mul):
        number, rest = expression.as_independent(*moving, as_Add=False)
        factors = [_pattern(factor, moving, values) for factor in _sorted(Mul.make_args(rest), moving)]
        return Mul(_noted(number, values), *factors) if number != 1 else Mul(*factors)
    if isinstance(expression, Pow) and not expression.exp.free_symbols & moving:
        return Pow(_pattern(expression.base, moving, values), expression.exp)
    return expression.func(*(_pattern(argument, moving, values) for argument in expression.args))


def _sum(expression: Expr, moving: AbstractSet[Symbol], values: list[Expr]) -> Expr:
    """The pattern of a sum, in which every term has a factor, and which has a constant, though it be zero."""
    constant, rest = expression.as_independent(*moving, as_Add=True)
    pairs = [term.as_independent(*moving, as_Add=False) for term in Add.make_args(rest)]
    by_part = {part: number for number, part in pairs}
    terms = [_noted(by_part[part], values) * _pattern(part, moving, values) for part in _sorted(list(by_part), moving)]
    return Add(*terms, _noted(constant, values))


def _sorted(parts: Sequence[Expr], moving: AbstractSet[Symbol]) -> list[Expr]:
    """The parts in an order that does not depend on the numbers in them."""
    return sorted(parts, key=lambda part: (str(_pattern(part, moving, [])), str(part)))
