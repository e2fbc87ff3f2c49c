"""Delays: values of the past, `x.delayed(tau)`, and the method of steps that replaces them.

A motion is divided into M segments of length T/M, such that every delay is a multiple a of this length. The segments
are integrated simultaneously over 0 <= t <= T/M. A delayed value is then the value of an earlier segment at the same t,
or a value of the history: x_i'(t) = f(x_i(t), x_{i-a}(t), u_i(t), t + (i-1) T/M). Where segments meet, x_i at the end
equals x_{i+1} at the start. The result is a problem without delays, with M times as many states and the duration T/M.
Since all segments have the same grid, stages coincide, and a scheme keeps its order. Kinks that a history causes at
multiples of the delay fall on nodes.
Source: Bellman and Cooke (1963), Differential-difference equations; Guinn (1976) for optimal control.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import sympy
from sympy import Add, Expr, Rational, S, Symbol

from codegen import identifiers
from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model.definitions import Boundary, Bounds, Condition, Delay, Model, Segments
from codegen.discretise.model.guesses import at_guess, guessed
from codegen.discretise.model.relations import Entry, entry_of, text, value_entries
from codegen.errors import BoundaryError, CodegenError, ExpressionError, SizeError, SymbolError
from codegen.problem.bodies import symbols_of
from codegen.problem.problem import Control, Phases, Problem
from codegen.problem.symbols import ControlInput, Coordinate, Delayed, Momentum, Quantity, State, Time, Velocity
from codegen.symbolic import checks as expressions

MOST_QUANTITIES = 96
"""Greatest number of coordinates, rates and controls of all segments; a build takes three times as long as with six.

Two states and a control in 2, 8, 16 and 32 segments: 18, 23, 29 and 51 s of processor time, with scheme midpoint.
"""
_REWRITTEN = frozenset(
    "coordinates rates controls function force dynamics cost duration start end guess steps bounds path integrals"
    " start_conditions end_conditions terminal_cost holonomic joined scales delays segments".split()
)
"""Fields of the model that are rewritten for the segments."""
_KEPT = frozenset(
    "task name title form parameters defaults time maximised free_parameters bodies body end_values attitudes drawing"
    " unused".split()
)
"""Fields of the model that do not change; all other fields must have their defaults in a problem with delays."""


def require_supported(problem: Problem | Phases) -> None:
    """Raise an error for delays in phases, in several bodies, in periodic motions and in simulations."""
    phases = problem.phases if isinstance(problem, Phases) else (problem,)
    if isinstance(problem, Phases) and any(getattr(phase, "history", None) for phase in phases):
        raise ExpressionError("history in a problem of phases", "say by start how the first phase begins")
    delayed = {symbol for phase in phases for symbol in symbols_of(phase) if isinstance(symbol, Delayed)}
    if not delayed:
        return
    first = min(delayed, key=lambda symbol: symbol.declared)
    if isinstance(problem, Phases):
        raise ExpressionError(
            f"{first} in a problem of phases", "write one Control, with what changes as a function of t"
        )
    if not isinstance(problem, Control):
        remedy = "return codegen.Control(...) with the whole start and no cost, which has the same motion"
        raise ExpressionError(f"{first} in a simulation", remedy)
    if problem.bodies != 1:
        raise ExpressionError(
            f"{first} beside bodies={problem.bodies}", "give each body a Control of its own in together(...)"
        )
    if problem.periodic:
        raise BoundaryError(f"{first} in a periodic motion", "give start and end conditions, and a history")


def history_entries(control: Control) -> Iterator[Entry]:
    """Yield the history before t = 0, and start values from the history for quantities without start conditions."""
    entries = list(value_entries("history", control.history))
    yield from entries
    conditions: object = control.start_conditions
    if not isinstance(conditions, (Mapping, list, tuple)):
        conditions = ()
    relations = conditions.values() if isinstance(conditions, Mapping) else conditions
    tied = {symbol for relation in relations for symbol in getattr(relation, "free_symbols", ())}
    for entry in entries:
        x, before = entry.key, entry.expression
        times = [symbol for symbol in before.free_symbols if isinstance(symbol, Time)]
        values = {x: before} if isinstance(x, (Coordinate, State, Momentum, Velocity)) else {}
        if isinstance(x, Coordinate) and isinstance(x.partner, Velocity) and x.partner not in control.history:
            values[x.partner] = sympy.diff(before, times[0]) if times else sympy.S.Zero
        for symbol, value in values.items():
            if symbol not in control.start and symbol not in tied:
                yield entry_of("start", f"start of {symbol}", value.subs(dict.fromkeys(times, 0)), symbol)


def require_history(entries: Sequence[Entry], delayed: Sequence[Delayed]) -> None:
    """Raise an error for a delayed value without history, and for the history of a control that is never delayed."""
    histories = [entry.key for entry in entries if entry.role == "history"]
    for value in delayed:
        x = value.partner
        quantity = x.partner if isinstance(x, Velocity) else x
        if x not in histories and quantity not in histories:
            raise BoundaryError(
                f"{value} reaches before t = 0, and {quantity} has no history",
                f"say what it was for t <= 0, as in history={{{quantity}: 1}}",
            )
    delayed_quantities = {value.partner for value in delayed}
    for key in histories:
        if isinstance(key, ControlInput) and key not in delayed_quantities:
            raise SymbolError(f"history gives {key}, which is never delayed", "leave it out, or write .delayed(...)")


def delays_of(
    entries: Sequence[Entry], delayed: Sequence[Delayed], plain: Mapping[Quantity, Symbol], time: Symbol
) -> tuple[Delay, ...]:
    """Return the delayed values in the symbols of a model; a velocity may have the derivative of a history."""
    histories = {entry.key: entry.expression for entry in entries if entry.role == "history"}
    delays = []
    for value in delayed:
        x, lag = plain[value.partner], value.lag.xreplace(plain)
        history = histories.get(x)
        if history is None:
            assert isinstance(value.partner, Velocity), "require_history was called"
            history = sympy.diff(histories[plain[value.partner.partner]], time)
        delays.append(Delay(plain[value], x, lag, history))
    return tuple(delays)


def past_name(symbol: Delayed, quantity: str) -> str:
    """Return the name of a delayed value in a model, such as x@t-tau, from which printed notation is made."""
    return f"{quantity}@t-{symbol.lag}" if not symbol.lag.is_Add else f"{quantity}@t-({symbol.lag})"


def in_segments(model: Model) -> Model:
    """Rewrite a problem with delays as a problem of segments without delays.

    Raises ExpressionError for delays that are no fixed fraction of the duration, and for a free duration; SizeError for
    more segments than can be derived.
    """
    if not model.delays:
        return model
    arguments: dict[str, list[str]] = {}
    for kind in CONDITIONS:
        arguments.setdefault(kind.field, []).append(kind.argument)
    unsupported = [f for f in fields(model) if f.name not in _REWRITTEN | _KEPT and getattr(model, f.name) != f.default]
    for field in sorted(unsupported, key=lambda field: field.name not in arguments):
        what = " or ".join(arguments.get(field.name, [field.name]))
        raise ExpressionError(f"{what} beside {_named(model.delays[0])}", "leave one of them out")
    number, steps_back = _common_parts(model)
    moving = (*model.coordinates, *model.rates, *model.controls)
    others = (*model.parameters, *(free.symbol for free in model.free_parameters))
    taken = {symbol.name for symbol in (*moving, *others)}
    copies = []
    for i in range(1, number + 1):
        names = {x: f"{x.name}_{i}" if number > 1 else x.name for x in moving}
        names = {x: identifiers.marked(name, model.task, taken, moving=True) for x, name in names.items()}
        names = {x: name + identifiers.MARK if name in taken and number > 1 else name for x, name in names.items()}
        copies.append({x: Symbol(name, real=True) for x, name in names.items()})
    length, segments = model.duration / number, list[_Segment]()
    for i, copy in enumerate(copies):
        values: dict[Symbol, Expr] = {**copy, model.time: model.time + i * length}
        for delay, back in zip(model.delays, steps_back, strict=True):
            if 0 < back <= i:
                values[delay.symbol] = copies[i - back][delay.quantity]
            else:
                values[delay.symbol] = delay.history.xreplace({model.time: model.time + i * length - delay.lag})
        segments.append(_Segment(i + 1, copy, values))
    first, last = segments[0], segments[-1]
    assert model.end is not None, "only control problems have delays"
    assert model.cost is not None, "only control problems have delays"
    inner_positions = (None,) * len(model.coordinates) * (number - 1)
    inner_rates = (None,) * len(model.rates) * (number - 1)
    lined = (*model.coordinates, *(model.rates if model.form == "hamiltonian" else ()))
    lines = zip(lined, guessed(model, lined, at_guess(model, model.duration)), strict=True)
    guess = {**dict(lines), **dict(model.guess)}
    return replace(
        model,
        coordinates=tuple(s.of(x) for s in segments for x in model.coordinates),
        rates=tuple(s.of(x) for s in segments for x in model.rates),
        controls=tuple(s.of(x) for s in segments for x in model.controls),
        function=Add(*(s.put(model.function) for s in segments)),
        force=tuple(s.put(f) for s in segments for f in model.force),
        dynamics=tuple(s.put(f) for s in segments for f in model.dynamics),
        cost=Add(*(s.put(model.cost) for s in segments)),
        duration=model.duration / number,
        start=Boundary((*model.start.positions, *inner_positions), (*model.start.rates, *inner_rates)),
        end=Boundary((*inner_positions, *model.end.positions), (*inner_rates, *model.end.rates)),
        guess=tuple((s.of(x), s.put(value)) for s in segments for x, value in guess.items()),
        steps=-(-model.steps // number),
        bounds=tuple(Bounds(s.of(b.symbol), b.lower, b.upper) for s in segments for b in model.bounds),
        path=tuple(s.condition(c, number) for s in segments for c in model.path),
        integrals=tuple(replace(c, expression=Add(*(s.put(c.expression) for s in segments))) for c in model.integrals),
        start_conditions=tuple(replace(c, expression=first.put(c.expression)) for c in model.start_conditions),
        end_conditions=tuple(replace(c, expression=last.put(c.expression)) for c in model.end_conditions),
        terminal_cost=last.put(model.terminal_cost),
        holonomic=tuple(s.put(c) for s in segments for c in model.holonomic),
        joined=tuple((before.of(x), after.of(x)) for before, after in pairwise(segments) for x in model.coordinates),
        # Free parameters have one scale for all segments.
        scales=tuple((s.of(x), size) for s in segments for x, size in model.scales if x in s.copies or s is first),
        delays=(),
        segments=Segments(
            number,
            model,
            steps_back,
            tuple((copy.name, x.name, s.number) for s in segments for x, copy in s.copies.items()),
        ),
    )


def in_names_of_the_whole(model: Model, text: str) -> str:
    """Replace the names of quantities of segments in a text by descriptions such as `x in segment 2`."""
    if model.segments is None or model.segments.number == 1:
        return text
    names = {
        identifiers.plain(name): identifiers.plain(f"{whole} in segment {number}")
        for name, whole, number in model.segments.names
    }
    pattern = rf"\b(p_|)({'|'.join(map(re.escape, names))})\b"
    return re.sub(pattern, lambda match: match[1] + names[match[2]], text)


@contextmanager
def errors_of_the_whole(model: Model) -> Iterator[None]:
    """Replace the names of quantities of segments in the messages of errors by names of the whole problem."""
    try:
        yield
    except CodegenError as error:
        finding, remedy = (in_names_of_the_whole(model, text) for text in (error.finding, error.remedy))
        raise type(error)(finding, remedy) from error


@dataclass(frozen=True)
class _Segment:
    """A segment, numbered from 1: its copies of moving quantities, and the `values` of symbols of the whole problem."""

    number: int
    copies: dict[Symbol, Symbol]
    values: dict[Symbol, Expr]

    def of(self, quantity: Symbol) -> Symbol:
        """Return the copy of a quantity in this segment; constants are common to all segments."""
        return self.copies.get(quantity, quantity)

    def put(self, expression: Expr) -> Expr:
        """Return an expression of the whole problem in the symbols and at the time of this segment."""
        return expression.xreplace(self.values)

    def condition(self, condition: Condition, segments: int) -> Condition:
        """Return a path condition in this segment; with several segments its name ends with the number."""
        changed = replace(condition, expression=self.put(condition.expression))
        if segments == 1:
            return changed
        return replace(changed, name=f"{condition.name} in segment {self.number}", segment=self.number)


def _common_parts(model: Model) -> tuple[int, tuple[int, ...]]:
    """Return the least number of segments such that each delay is a multiple of their length, and the multiples.

    A delay that is not shorter than the duration refers to the history alone, and has the multiple 0.
    """
    if model.duration.free_symbols & {free.symbol for free in model.free_parameters}:
        raise ExpressionError(
            f"the duration {text(model.duration)} is free, and {_named(model.delays[0])} is a fixed part of it",
            "give the duration by numbers and parameters",
        )
    ratios = [_ratio(model, delay) for delay in model.delays]
    number = math.lcm(*(int(ratio.q) for ratio in ratios if ratio < 1))
    quantities = len((*model.coordinates, *model.rates, *model.controls))
    if number * quantities > MOST_QUANTITIES:
        most = MOST_QUANTITIES // quantities
        values = model.default_values
        duration = expressions.rounded_at(model.duration, values) or 1.0
        worst = max(range(len(ratios)), key=lambda i: (ratios[i] < 1, ratios[i].q))
        times = int(1 / ratios[worst])
        near = [f"{duration / n:.6g}" for n in dict.fromkeys((times + 1, times, most)) if 0 < n <= most][:2]
        these = f"{' or '.join(near)} {'divide' if len(near) > 1 else 'divides'}"
        lag = expressions.rounded_at(model.delays[worst].lag, values) or 0.0
        raise SizeError(
            f"the delay {lag:g} of {model.delays[worst].quantity} in the duration {duration:g} makes {number} equal "
            f"segments, where {most} can be derived",
            f"take a larger delay that divides the duration; {these} it",
        )
    return number, tuple(int(ratio * number) if ratio < 1 else 0 for ratio in ratios)


def _ratio(model: Model, delay: Delay) -> Rational:
    """Return a delay as a fraction of the duration; raise ExpressionError if it is not rational and positive."""
    ratio = sympy.simplify(delay.lag / model.duration)
    if not ratio.is_Rational:
        # An example for the message: the duration as a multiple of the delay, if the default values agree.
        values = model.default_values
        lengths = [sympy.nsimplify(each.xreplace(values), rational=True) for each in (model.duration, delay.lag)]
        times = lengths[0] / lengths[1] if all(length.is_positive for length in lengths) else S.Zero
        is_multiple = times.is_Integer and delay.lag.free_symbols
        example = f"duration={text(times * delay.lag)}" if is_multiple else "duration=4*tau"
        finding = f"{_named(delay)} is no fixed rational part of the duration {text(model.duration)}"
        raise ExpressionError(finding, f"write the one as a multiple of the other, as in {example}")
    if not ratio > 0:
        raise ExpressionError(f"{_named(delay)} is no value of the past", "give a positive delay")
    return ratio


def _named(delay: Delay) -> str:
    return f"the delay {text(delay.lag)} of {delay.quantity}"
