"""Where the solver starts: expressions of time, duration and parameters for the primal unknowns.

Where the solver starts in a problem of several phases: what the author guesses, else lines between known values.

A coordinate or state is known at the start, at the end, and at the switches where a phase says how it ends. In every
phase a line runs from where the phase before has led, after the jump, to the next known value, over as many phases as
lie before it; where none is known up to the next jump of the quantity, it keeps its value.

What the ends of a motion say of its way between them: values that an end gives, and straight lines.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.model.definitions import Boundary, Condition, Model
from codegen.symbolic.derivatives import gradient


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


Values = dict[Symbol, Expr]


def with_guesses(model: Model) -> Model:
    """The model whose phases have a guess of every coordinate or state, in the time of the whole problem.

    Momenta of a Hamiltonian get one as well.
    """
    times, phases = _switch_times(model), list(model.phases)
    values = known_values(model, model.start, model.start_conditions)
    for i, phase in enumerate(phases):
        guess = dict(phase.guess)
        for q in _quantities(model):
            guess.setdefault(q, _line(model, q, i, values.get(q), times))
        phases[i] = replace(phase, guess=tuple(guess.items()))
        if i + 1 < len(phases):
            values = _after(model, i, guess, times[i + 1])
    return replace(model, phases=tuple(phases))


def _switch_times(model: Model) -> list[Expr]:
    """When each phase begins, and when the last one ends, at the guesses of the free parameters."""
    durations = [at_guess(model, phase.duration) for phase in model.phases]
    return [Add(*durations[:i]) for i in range(len(durations) + 1)]


def _quantities(model: Model) -> Sequence[Symbol]:
    return model.coordinates if model.form != "hamiltonian" else (*model.coordinates, *model.rates)


def _line(model: Model, quantity: Symbol, index: int, left: Expr | None, times: Sequence[Expr]) -> Expr:
    """From the value at the beginning of a phase to the next one that is known."""
    for last, phase in enumerate(model.phases[index:], start=index):
        right = known_values(model, phase.end, phase.end_conditions).get(quantity)
        if right is not None:
            if left is None:
                return right
            return left + (right - left) * (model.time - times[index]) / (times[last + 1] - times[index])
        if last < len(model.jumps) and quantity in dict(model.jumps[last]):
            break
    return S.Zero if left is None else left


def _after(model: Model, index: int, guess: Values, time: Expr) -> Values:
    """The values with which the next phase begins, as far as anything says more than zero about them."""
    before = {q: at_guess(model, value).subs(model.time, time) for q, value in guess.items()}
    if model.form == "lagrangian":
        pairs = zip(model.coordinates, model.rates, strict=True)
        before |= {v: at_guess(model, sympy.diff(guess[q], model.time)).subs(model.time, time) for q, v in pairs}
    given = known_values(model, model.phases[index].end, model.phases[index].end_conditions)
    jump = {q: at_guess(model, value).xreplace(before | given) for q, value in model.jumps[index]}
    known = given | jump
    return {q: value for q, value in (before | known).items() if value != 0 or q in known}
