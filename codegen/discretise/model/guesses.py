"""The initial guess: expressions of time, duration and parameters for the primal unknowns.

The guess of a coordinate, state or momentum is the author's guess, or else the straight line between its values at both
ends. A coordinate of a Lagrangian with a value at one end only, and with velocities at both ends, moves with the
velocities on the line between these. In a problem of several phases, the quantity also has a value at each switch where
the end of a phase prescribes one. In every phase a line runs from the value after the last jump to the next prescribed
value, which may be several phases later. If no value is prescribed before the next jump of the quantity, the guess is
constant. A quantity without any value is zero, and an attitude without any value is the identity.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Add, Expr, S, Symbol

from codegen.discretise.model.definitions import Boundary, Condition, Model
from codegen.symbolic.derivatives import gradient

DURATION = Symbol("duration", positive=True)
"""The symbol of the length of the whole time interval in guesses."""


def coordinate_guess(model: Model) -> tuple[Expr, ...]:
    """Return the guess of each coordinate, an expression in time and DURATION."""
    return guessed(model, model.coordinates, DURATION)


def momentum_guess(model: Model) -> tuple[Expr, ...]:
    """Return the guess of each momentum; for a Lagrangian, dL/dv along the guess of the coordinates."""
    if model.form != "lagrangian":
        return guessed(model, model.rates, DURATION)
    motion = coordinate_guess(model)
    values = dict(zip(model.coordinates, motion, strict=True))
    values |= {v: sympy.diff(q, model.time) for v, q in zip(model.rates, motion, strict=True)}
    momenta = (slope.subs(values, simultaneous=True) for slope in gradient(model.function, model.rates))
    return tuple(at_guess(model, momentum) for momentum in momenta)


def guessed(model: Model, quantities: Sequence[Symbol], duration: Expr) -> tuple[Expr, ...]:
    """Return the guesses of coordinates or momenta: the author's guess, or a straight line between end values."""
    first = known_values(model, model.start, model.start_conditions)
    last = known_values(model, model.end, model.end_conditions)
    lines = last | first | {x: first[x] + (last[x] - first[x]) * model.time / duration for x in first if x in last}
    lines |= moving(model, first, last, duration)
    guess = lines | dict(model.guess)
    return tuple(at_guess(model, guess.get(x, without_value(model, x))) for x in quantities)


def without_value(model: Model, quantity: Symbol) -> Expr:
    """Return the guess of a quantity that has no value: zero, but one for the real part of a quaternion."""
    return S.One if quantity.name in {f"{name}_w" for name in model.attitudes} else S.Zero


def moving(model: Model, first: dict[Symbol, Expr], last: dict[Symbol, Expr], duration: Expr) -> dict[Symbol, Expr]:
    """Return the motions of coordinates with a value at one end, whose velocities have values at both ends.

    A velocity is linear in time. For example, the momenta of a constant angle would contradict two orbits.
    """
    motions: dict[Symbol, Expr] = {}
    if model.form != "lagrangian":
        return motions
    for q, v in zip(model.coordinates, model.rates, strict=True):
        if (q in first) != (q in last) and v in first and v in last:
            way = first[v] * model.time + (last[v] - first[v]) * model.time**2 / (2 * duration)
            start = first[q] if q in first else last[q] - (first[v] + last[v]) * duration / 2
            motions[q] = start + way
    return motions


def at_guess(model: Model, expression: Expr) -> Expr:
    """Return an expression with the free parameters replaced by their initial guesses."""
    return expression.xreplace({parameter.symbol: parameter.guess for parameter in model.free_parameters})


def known_values(model: Model, boundary: Boundary | None, conditions: Sequence[Condition]) -> dict[Symbol, Expr]:
    """Return the values of coordinates and rates at an end, with free parameters at their initial guesses.

    The value comes from the boundary, or from a condition that is linear in one quantity and has no other quantity.
    """
    assert boundary is not None, "a control problem has an end"
    quantities = (*model.coordinates, *model.rates)
    pairs = zip(quantities, (*boundary.positions, *boundary.rates), strict=True)
    fixed = {symbol: value for symbol, value in pairs if value is not None}
    values = values_given_by(model, conditions) | fixed
    return {symbol: at_guess(model, value) for symbol, value in values.items()}


def values_given_by(model: Model, conditions: Iterable[Condition]) -> dict[Symbol, Expr]:
    """Return the values from equations that are linear in a single coordinate or rate; the first equation counts."""
    values: dict[Symbol, Expr] = {}
    for condition in conditions:
        present = condition.expression.free_symbols & {*model.coordinates, *model.rates}
        if len(present) == 1 and condition.equality:
            (symbol,) = present
            slope = sympy.diff(condition.expression, symbol)
            if slope.is_number and slope != 0:
                values.setdefault(symbol, -condition.expression.subs(symbol, 0) / slope)
    return values


def inner_guess(model: Model) -> tuple[tuple[int, tuple[tuple[int, Expr], ...]], ...]:
    """Return pairs (index of a coordinate, its values at inner times) for coordinates without the author's guess.

    The values are pairs (index of the inner time, value). Values that depend on more than parameters are left out.
    """
    guess, times = dict(model.guess), range(len(model.inner_times))
    at_times = [values_given_by(model, [c for c in model.inner_conditions if c.number == number]) for number in times]
    guesses = []
    for i, q in enumerate(model.coordinates):
        pairs = [(number, at_guess(model, values[q])) for number, values in enumerate(at_times) if q in values]
        values = tuple((number, value) for number, value in pairs if value.free_symbols <= set(model.parameters))
        if values and q not in guess:
            guesses.append((i, values))
    return tuple(guesses)


@dataclass(frozen=True)
class MeasuredGuess:
    """The guess (z - offset)/slope of an unknown of a node from the measured values z of a column.

    `index` is the index of the unknown, and `column` the index of the measured quantity. The offset and the slope are
    numbers, or depend on parameters.
    """

    index: int
    column: int
    offset: Expr
    slope: Expr


def measured_guess(model: Model) -> tuple[MeasuredGuess, ...]:
    """Return the guesses of coordinates from measured expressions that are affine in one coordinate, such as 180 q/pi.

    Coordinates with the author's guess are left out. For a motion near the measurements, the fit of the parameters is
    nearly a linear problem. Source: Bock (1983), Recent advances in parameter identification techniques for O.D.E.
    """
    guess, found = dict(model.guess), dict[int, MeasuredGuess]()
    moving_symbols = {*model.coordinates, *model.rates, *model.controls, model.time}
    for column, observed in enumerate(model.observed):
        (*present,) = observed.expression.free_symbols & moving_symbols
        if len(present) != 1 or present[0] not in model.coordinates or present[0] in guess:
            continue
        index, slope = model.coordinates.index(present[0]), at_guess(model, sympy.diff(observed.expression, present[0]))
        offset = at_guess(model, observed.expression.subs(present[0], 0))
        is_affine = slope != 0 and {*slope.free_symbols, *offset.free_symbols} <= {*model.parameters}
        if is_affine and (index not in found or (offset, slope) == (0, 1)):
            found[index] = MeasuredGuess(index, column, offset, slope)
    return tuple(found.values())


def with_guesses(model: Model) -> Model:
    """Return a model whose phases have guesses of all coordinates and momenta, in the time of the whole motion."""
    durations = [at_guess(model, phase.duration) for phase in model.phases]
    times, phases = [Add(*durations[:i]) for i in range(len(durations) + 1)], list(model.phases)
    values = known_values(model, model.start, model.start_conditions)
    for i, phase in enumerate(phases):
        guess = dict(phase.guess)
        for q in model.coordinates if model.form != "hamiltonian" else (*model.coordinates, *model.rates):
            guess.setdefault(q, _line(model, q, i, values.get(q), times))
        phases[i] = replace(phase, guess=tuple(guess.items()))
        if i + 1 < len(phases):
            time = times[i + 1]
            before = {q: at_guess(model, value).subs(model.time, time) for q, value in guess.items()}
            if model.form == "lagrangian":
                pairs = zip(model.coordinates, model.rates, strict=True)
                before |= {
                    v: at_guess(model, sympy.diff(guess[q], model.time)).subs(model.time, time) for q, v in pairs
                }
            fixed = known_values(model, model.phases[i].end, model.phases[i].end_conditions)
            fixed |= {q: at_guess(model, value).xreplace(before | fixed) for q, value in model.jumps[i]}
            values = {q: value for q, value in (before | fixed).items() if value != 0 or q in fixed}
    return replace(model, phases=tuple(phases))


def _line(model: Model, quantity: Symbol, index: int, left: Expr | None, times: Sequence[Expr]) -> Expr:
    """Return the line from the value `left` at the start of phase `index` to the next prescribed value."""
    for last, phase in enumerate(model.phases[index:], start=index):
        right = known_values(model, phase.end, phase.end_conditions).get(quantity)
        if right is not None:
            if left is None:
                return right
            return left + (right - left) * (model.time - times[index]) / (times[last + 1] - times[index])
        if last < len(model.jumps) and quantity in dict(model.jumps[last]):
            break
    return without_value(model, quantity) if left is None else left
