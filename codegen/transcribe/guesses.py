"""Where the solver starts: expressions of time, duration and parameters for the primal unknowns."""

from __future__ import annotations

import sympy
from sympy import Expr, Symbol

from codegen.expressions.tangents import gradient
from codegen.model import Model
from codegen.model.lines import at_guess, guessed, values_given_by

DURATION = Symbol("duration", positive=True)
"""The length of the whole time interval, in guesses."""


def coordinate_guess(model: Model) -> tuple[Expr, ...]:
    """The author's guess for each coordinate as a function of time, else the straight line between its end values."""
    return guessed(model, model.coordinates, DURATION)


def momentum_guess(model: Model) -> tuple[Expr, ...]:
    """Momenta along the guessed motion (Lagrangian form), straight lines between their end values, or no momenta."""
    if model.form != "lagrangian":
        return guessed(model, model.rates, DURATION)
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


def inner_guess(model: Model) -> tuple[tuple[int, tuple[tuple[int, Expr], ...]], ...]:
    """For coordinates without a guess of the author, by index, what conditions at inner times give.

    Of each inner time its number and the value there, as far as it is one of parameters.
    """
    given, times = dict(model.guess), range(len(model.inner_times))
    known = [values_given_by(model, [c for c in model.inner_conditions if c.number == number]) for number in times]
    found = []
    for i, q in enumerate(model.coordinates):
        pairs = [(number, at_guess(model, values[q])) for number, values in enumerate(known) if q in values]
        values = tuple((number, value) for number, value in pairs if value.free_symbols <= set(model.parameters))
        if values and q not in given:
            found.append((i, values))
    return tuple(found)


def measured_guess(model: Model) -> tuple[tuple[int, int], ...]:
    """Coordinates, by index, that a column of measurements holds, and its index, unless the author has a guess.

    Near what was measured the parameters that fit it are nearly those of a linear problem, wherever a motion with other
    parameters may lead. Source: Bock (1983), Recent advances in parameter identification techniques for O.D.E.
    """
    given, columns = dict(model.guess), [observed.expression for observed in model.observed]
    measured = [(i, q) for i, q in enumerate(model.coordinates) if q in columns and q not in given]
    return tuple((i, columns.index(q)) for i, q in measured)
