"""What the ends of a motion say of its way between them: values that an end gives, and straight lines."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import sympy
from sympy import Expr, Symbol

from codegen.discretise.model.definitions import Boundary, Condition, Model


def at_guess(model: Model, expression: Expr) -> Expr:
    """Put the guesses of the free parameters into an expression, which holds them no more."""
    return expression.xreplace({parameter.symbol: parameter.guess for parameter in model.free_parameters})


def known_values(model: Model, boundary: Boundary | None, conditions: Sequence[Condition]) -> dict[Symbol, Expr]:
    """What an end gives of coordinates and rates, by itself or by a condition that is linear in one of them alone.

    Free parameters have their guesses there.
    """
    assert boundary is not None, "a control problem has an end"
    quantities = (*model.coordinates, *model.rates)
    pairs = zip(quantities, (*boundary.positions, *boundary.rates), strict=True)
    known = {symbol: value for symbol, value in pairs if value is not None}
    known = values_given_by(model, conditions) | known
    return {symbol: at_guess(model, value) for symbol, value in known.items()}


def values_given_by(model: Model, conditions: Iterable[Condition]) -> dict[Symbol, Expr]:
    """What conditions that are linear in a single coordinate or rate say of it, the first of several."""
    found: dict[Symbol, Expr] = {}
    for condition in conditions:
        present = condition.expression.free_symbols & {*model.coordinates, *model.rates}
        if len(present) == 1 and condition.equality:
            (symbol,) = present
            slope = sympy.diff(condition.expression, symbol)
            if slope.is_number and slope != 0:
                found.setdefault(symbol, -condition.expression.subs(symbol, 0) / slope)
    return found


def straight_line(model: Model, first: Expr | None, last: Expr | None, duration: Expr) -> Expr:
    """The line between two end values; a constant where one of them is free, zero where both are."""
    if first is None or last is None:
        return first if first is not None else last if last is not None else sympy.S.Zero
    return first + (last - first) * model.time / duration


def guessed(model: Model, quantities: Sequence[Symbol], duration: Expr) -> tuple[Expr, ...]:
    """The author's guess for each of coordinates or momenta, else the straight line between its end values."""
    given = dict(model.guess)
    first = known_values(model, model.start, model.start_conditions)
    last = known_values(model, model.end, model.end_conditions)
    lines = {x: straight_line(model, first.get(x), last.get(x), duration) for x in quantities}
    return tuple(at_guess(model, given.get(x, lines[x])) for x in quantities)
