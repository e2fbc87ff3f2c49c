"""Where the solver starts: expressions of time, duration and parameters for the primal unknowns."""

from __future__ import annotations

import sympy
from sympy import Expr, Symbol

from codegen.model import Model

DURATION = Symbol("duration", positive=True)
"""The length of the whole time interval, in guesses."""


def coordinate_guess(model: Model) -> tuple[Expr, ...]:
    """The author's guess for each coordinate as a function of time, else the straight line between its end values."""
    given = dict(model.guess)
    assert model.end is not None, "a control problem has an end"
    pairs = zip(model.coordinates, model.start.positions, model.end.positions, strict=True)
    return tuple(at_guess(model, given.get(q, straight_line(model, first, last))) for q, first, last in pairs)


def momentum_guess(model: Model) -> tuple[Expr, ...]:
    """Momenta along the guessed motion (Lagrangian form), straight lines between their end values, or no momenta."""
    assert model.end is not None, "a control problem has an end"
    if model.form != "lagrangian":
        given = dict(model.guess)
        triples = zip(model.rates, model.start.rates, model.end.rates, strict=True)
        return tuple(at_guess(model, given.get(p, straight_line(model, first, last))) for p, first, last in triples)
    motion = coordinate_guess(model)
    values = dict(zip(model.coordinates, motion, strict=True))
    values |= {v: sympy.diff(q, model.time) for v, q in zip(model.rates, motion, strict=True)}
    momenta = (sympy.diff(model.function, v).subs(values, simultaneous=True) for v in model.rates)
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


def straight_line(model: Model, first: Expr | None, last: Expr | None) -> Expr:
    """The line between two end values; a constant where one of them is free, zero where both are."""
    if first is None or last is None:
        return first if first is not None else last if last is not None else sympy.S.Zero
    return first + (last - first) * model.time / DURATION
