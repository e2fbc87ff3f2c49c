"""Where the solver starts: expressions of time, duration and parameters for the primal unknowns."""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from sympy import Expr, Symbol

from codegen.expressions.tangents import gradient
from codegen.model import Boundary, Condition, Model

DURATION = Symbol("duration", positive=True)
"""The length of the whole time interval, in guesses."""


def coordinate_guess(model: Model) -> tuple[Expr, ...]:
    """The author's guess for each coordinate as a function of time, else the straight line between its end values."""
    return _guessed(model, model.coordinates)


def momentum_guess(model: Model) -> tuple[Expr, ...]:
    """Momenta along the guessed motion (Lagrangian form), straight lines between their end values, or no momenta."""
    if model.form != "lagrangian":
        return _guessed(model, model.rates)
    motion = coordinate_guess(model)
    values = dict(zip(model.coordinates, motion, strict=True))
    values |= {v: sympy.diff(q, model.time) for v, q in zip(model.rates, motion, strict=True)}
    momenta = (slope.subs(values, simultaneous=True) for slope in gradient(model.function, model.rates))
    return tuple(at_guess(model, momentum) for momentum in momenta)


def control_guess(model: Model) -> tuple[Expr, ...]:
    """The author's guess for each control, else zero."""
    given = dict(model.guess)
    return tuple(at_guess(model, given.get(u, sympy.S.Zero)) for u in model.controls)


def at_start(model: Model, guess: Expr) -> Expr:
    """A guess as function of time, at the start of the time interval."""
    return guess.subs(model.time, 0)


def at_end(model: Model, guess: Expr) -> Expr:
    """A guess as function of time, at the end of the time interval."""
    return guess.subs(model.time, DURATION)


def at_guess(model: Model, expression: Expr) -> Expr:
    """Put the guesses of the free parameters into an expression, which holds them no more."""
    return expression.xreplace({parameter.symbol: parameter.guess for parameter in model.free_parameters})


def _guessed(model: Model, quantities: Sequence[Symbol]) -> tuple[Expr, ...]:
    given = dict(model.guess)
    first = known_values(model, model.start, model.start_conditions)
    last = known_values(model, model.end, model.end_conditions)
    lines = {x: straight_line(model, first.get(x), last.get(x)) for x in quantities}
    return tuple(at_guess(model, given.get(x, lines[x])) for x in quantities)


def known_values(model: Model, boundary: Boundary | None, conditions: Sequence[Condition]) -> dict[Symbol, Expr]:
    """What an end gives of coordinates and rates, by itself or by a condition that is linear in one of them alone.

    Free parameters have their guesses there.
    """
    assert boundary is not None, "a control problem has an end"
    quantities = (*model.coordinates, *model.rates)
    pairs = zip(quantities, (*boundary.positions, *boundary.rates), strict=True)
    known = {symbol: value for symbol, value in pairs if value is not None}
    for condition in conditions:
        present = condition.expression.free_symbols & set(quantities)
        if len(present) == 1 and condition.equality:
            (symbol,) = present
            slope = sympy.diff(condition.expression, symbol)
            if slope.is_number and slope != 0:
                known.setdefault(symbol, -condition.expression.subs(symbol, 0) / slope)
    return {symbol: at_guess(model, value) for symbol, value in known.items()}


def straight_line(model: Model, first: Expr | None, last: Expr | None) -> Expr:
    """The line between two end values; a constant where one of them is free, zero where both are."""
    if first is None or last is None:
        return first if first is not None else last if last is not None else sympy.S.Zero
    return first + (last - first) * model.time / DURATION
