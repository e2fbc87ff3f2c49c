"""The method of steps: a motion with delays, cut into segments of equal length that run side by side.

With M segments of length T/M, of which every delay is a multiple, the value of the past is that of an earlier segment
at the same instant of its own, and of the history in the first ones: x_i'(t) = f(x_i(t), x_{i-a}(t), u_i(t), t + (i-1)
T/M). Where segments meet, x_i at the end is x_{i+1} at the start. What comes out has no delays: a problem of M times as
many states, on an M-th of the duration. Since all segments have the same grid, stages of a step fall on stages, and a
scheme keeps its order; kinks that a history leaves at multiples of the delay fall on nodes.
Source: Bellman and Cooke (1963), Differential-difference equations; Guinn (1976) for optimal control.

Values of the past, `x.delayed(tau)`, and what they were before t = 0: what is read, and what is refused.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from typing import Any

import sympy
from sympy import Add, Expr, Rational, S, Symbol

from codegen import identifiers
from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model.definitions import Boundary, Bounds, Condition, Delay, Model, Segments
from codegen.discretise.model.guesses import at_guess, guessed
from codegen.discretise.model.relations import Entry, entry_of, text, value_entries
from codegen.errors import BoundaryError, CodegenError, ExpressionError, SizeError, SymbolError
from codegen.problem.bodies import symbols_of
from codegen.problem.problem import Control, Phases
from codegen.problem.symbols import ControlInput, Coordinate, Delayed, Momentum, Quantity, State, Time, Velocity
from codegen.symbolic import checks as expressions

MOST_QUANTITIES = 96
"""Coordinates, rates and controls of all segments together: with as many a build takes three times as long as with six.

Two states and a control in 2, 8, 16 and 32 segments: 18, 23, 29 and 51 s of processor time, by midpoints.
"""


_CUT = frozenset(
    "coordinates rates controls function force dynamics cost duration start end guess steps bounds path integrals"
    " start_conditions end_conditions terminal_cost holonomic joined scales delays segments".split()
)
_KEPT = frozenset(
    "task name title form parameters defaults time maximised free_parameters bodies body end_values drawing"
    " unused".split()
)
"""What a cut model has for each segment, and what it has as it was; the rest no problem with delays may have."""


def in_segments(model: Model) -> Model:
    """The same problem without delays.

    Raises ExpressionError for delays that are no fixed part of the duration, and for a duration that is free; SizeError
    for more segments than can be derived.
    """
    if not model.delays:
        return model
    _require_known(model)
    number, steps_back = _common_parts(model)
    segments = _segments(model, number, steps_back)
    first, last = segments[0], segments[-1]
    assert model.end is not None, "only control problems have delays"
    assert model.cost is not None, "only control problems have delays"
    free = (None,) * len(model.coordinates), (None,) * len(model.rates)
    inner = (number - 1) * free[0], (number - 1) * free[1]
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
        start=Boundary((*model.start.positions, *inner[0]), (*model.start.rates, *inner[1])),
        end=Boundary((*inner[0], *model.end.positions), (*inner[1], *model.end.rates)),
        guess=tuple(pair for s in segments for pair in _guess(model, s)),
        steps=-(-model.steps // number),
        bounds=tuple(Bounds(s.of(b.symbol), b.lower, b.upper) for s in segments for b in model.bounds),
        path=tuple(s.condition(c) for s in segments for c in model.path),
        integrals=tuple(replace(c, expression=Add(*(s.put(c.expression) for s in segments))) for c in model.integrals),
        start_conditions=tuple(replace(c, expression=first.put(c.expression)) for c in model.start_conditions),
        end_conditions=tuple(replace(c, expression=last.put(c.expression)) for c in model.end_conditions),
        terminal_cost=last.put(model.terminal_cost),
        holonomic=tuple(s.put(c) for s in segments for c in model.holonomic),
        joined=tuple((before.of(x), after.of(x)) for before, after in pairwise(segments) for x in model.coordinates),
        scales=tuple((s.of(x), size) for s in segments for x, size in _moving_first(model, s)),
        delays=(),
        segments=Segments(number, model, steps_back, tuple(name for s in segments for name in s.names)),
    )


def in_names_of_the_whole(model: Model, text: str) -> str:
    """A text that names quantities of segments, as in `x in segment 2`."""
    if model.segments is None or model.segments.number == 1:
        return text
    words = {own: f"{whole} in segment {number}" for own, whole, number in model.segments.names}
    names = {identifiers.plain(own): identifiers.plain(described) for own, described in words.items()}
    pattern = rf"\b(p_|)({'|'.join(map(re.escape, names))})\b"
    return re.sub(pattern, lambda found: found[1] + names[found[2]], text)


@contextmanager
def errors_of_the_whole(model: Model) -> Iterator[None]:
    """Let errors name quantities of segments so."""
    try:
        yield
    except CodegenError as error:
        finding, remedy = (in_names_of_the_whole(model, text) for text in (error.finding, error.remedy))
        raise type(error)(finding, remedy) from error


@dataclass(frozen=True)
class _Segment:
    """One segment: its number, from 1, its quantities, and what stands in it for symbols of the whole problem."""

    number: int
    own: dict[Symbol, Symbol]
    values: dict[Symbol, Expr]
    is_only: bool

    def of(self, quantity: Symbol) -> Symbol:
        """The quantity of this segment; what does not move is that of all."""
        return self.own.get(quantity, quantity)

    def put(self, expression: Expr) -> Expr:
        """An expression of the whole problem, at the time of this segment."""
        return expression.xreplace(self.values)

    def condition(self, condition: Condition) -> Condition:
        """A condition that holds at every time."""
        changed = replace(condition, expression=self.put(condition.expression))
        if self.is_only:
            return changed
        return replace(changed, name=f"{condition.name} in segment {self.number}", segment=self.number)

    @property
    def names(self) -> Iterator[tuple[str, str, int]]:
        """Names of the segment's quantities."""
        return ((own.name, whole.name, self.number) for whole, own in self.own.items())


def _segments(model: Model, number: int, steps_back: Sequence[int]) -> list[_Segment]:
    moving = (*model.coordinates, *model.rates, *model.controls)
    others = (*model.parameters, *(free.symbol for free in model.free_parameters))
    taken = {symbol.name for symbol in (*moving, *others)}
    copies = []
    for i in range(1, number + 1):
        names = {x: f"{x.name}_{i}" if number > 1 else x.name for x in moving}
        names = {x: identifiers.marked(name, model.task, taken, moving=True) for x, name in names.items()}
        names = {x: name + identifiers.MARK if name in taken and number > 1 else name for x, name in names.items()}
        copies.append({x: Symbol(name, real=True) for x, name in names.items()})
    length, found = model.duration / number, []
    for i, own in enumerate(copies):
        values: dict[Symbol, Expr] = {**own, model.time: model.time + i * length}
        for delay, back in zip(model.delays, steps_back, strict=True):
            values[delay.symbol] = _past(model, delay, copies, i, back, length)
        found.append(_Segment(i + 1, own, values, number == 1))
    return found


def _past(model: Model, delay: Delay, copies: Sequence[dict[Symbol, Symbol]], i: int, back: int, length: Expr) -> Expr:
    """A value of the past in segment i, from 0: of an earlier one, or of the history."""
    if 0 < back <= i:
        return copies[i - back][delay.quantity]
    return delay.history.xreplace({model.time: model.time + i * length - delay.lag})


def _guess(model: Model, segment: _Segment) -> Iterator[tuple[Symbol, Expr]]:
    """Where the solver starts: the author's guess of the whole motion, or its straight line, as far as it is here."""
    lined = (*model.coordinates, *(model.rates if model.form == "hamiltonian" else ()))
    values = dict(zip(lined, guessed(model, lined, at_guess(model, model.duration)), strict=True))
    for symbol, value in {**values, **dict(model.guess)}.items():
        yield segment.of(symbol), segment.put(value)


def _moving_first(model: Model, segment: _Segment) -> list[tuple[Symbol, float]]:
    """Sizes of a segment's quantities; those of free parameters once, with the first."""
    return [(x, size) for x, size in model.scales if x in segment.own or segment.number == 1]


def _require_known(model: Model) -> None:
    """Refuse what is not cut, such as a kind of condition that segments know nothing of."""
    arguments: dict[str, list[str]] = {}
    for kind in CONDITIONS:
        arguments.setdefault(kind.field, []).append(kind.argument)
    unknown = [f for f in fields(model) if f.name not in _CUT | _KEPT and getattr(model, f.name) != f.default]
    for part in sorted(unknown, key=lambda part: part.name not in arguments):
        what = " or ".join(arguments.get(part.name, [part.name]))
        raise ExpressionError(f"{what} beside {_named(model.delays[0])}", "leave one of them out")


def _common_parts(model: Model) -> tuple[int, tuple[int, ...]]:
    """The least number of segments of which all delays are multiples, and how many each of them is.

    A delay that is not shorter than the duration reads nothing but the history, and counts as none.
    """
    if model.duration.free_symbols & {free.symbol for free in model.free_parameters}:
        raise ExpressionError(
            f"the duration {text(model.duration)} is free, and {_named(model.delays[0])} is a fixed part of it",
            "give the duration by numbers and parameters",
        )
    ratios = [_ratio(model, delay) for delay in model.delays]
    shorter = [ratio for ratio in ratios if ratio < 1]
    number = math.lcm(*(int(ratio.q) for ratio in shorter))
    quantities = number * len((*model.coordinates, *model.rates, *model.controls))
    if quantities > MOST_QUANTITIES:
        raise SizeError(*_too_many(model, ratios, number))
    return number, tuple(int(ratio * number) if ratio < 1 else 0 for ratio in ratios)


def _ratio(model: Model, delay: Delay) -> Rational:
    """The part of the duration that a delay lasts."""
    ratio = sympy.simplify(delay.lag / model.duration)
    if not ratio.is_Rational:
        finding = f"{_named(delay)} is no fixed rational part of the duration {text(model.duration)}"
        raise ExpressionError(finding, f"write the one as a multiple of the other, as in {_multiple(model, delay)}")
    if not ratio > 0:
        raise ExpressionError(f"{_named(delay)} is no value of the past", "give a positive delay")
    return ratio


def _multiple(model: Model, delay: Delay) -> str:
    """The duration as a multiple of a delay, or of another one where parameters' defaults make it none."""
    values = model.default_values
    lengths = [sympy.nsimplify(each.xreplace(values), rational=True) for each in (model.duration, delay.lag)]
    times = lengths[0] / lengths[1] if all(length.is_positive for length in lengths) else S.Zero
    if not (times.is_Integer and delay.lag.free_symbols):
        return "duration=4*tau"
    return f"duration={text(times * delay.lag)}"


def _too_many(model: Model, ratios: Sequence[Rational], number: int) -> tuple[str, str]:
    """What is too large, and with which delays it would not be."""
    values = model.default_values
    duration = expressions.rounded_at(model.duration, values) or 1.0
    worst = max(range(len(ratios)), key=lambda i: (ratios[i] < 1, ratios[i].q))
    times = int(1 / ratios[worst])
    each = MOST_QUANTITIES // len((*model.coordinates, *model.rates, *model.controls))
    near = [f"{duration / n:.6g}" for n in dict.fromkeys((times + 1, times, each)) if 0 < n <= each][:2]
    these = f"{' or '.join(near)} {'divide' if len(near) > 1 else 'divides'}"
    lag = expressions.rounded_at(model.delays[worst].lag, values) or 0.0
    return (
        f"the delay {lag:g} of {model.delays[worst].quantity} in the duration {duration:g} makes {number} equal "
        f"segments, where {each} can be derived",
        f"take a delay that goes into the duration fewer times as a whole; {these} it",
    )


def _named(delay: Delay) -> str:
    return f"the delay {text(delay.lag)} of {delay.quantity}"


def delayed_values(problem: Any) -> list[Delayed]:
    """The values of the past that a problem reads, of any phase, in the order of declaration."""
    parts = problem.phases if isinstance(problem, Phases) else (problem,)
    found = {symbol for part in parts for symbol in symbols_of(part) if isinstance(symbol, Delayed)}
    return sorted(found, key=lambda symbol: symbol.declared)


def require_supported(problem: Any) -> None:
    """Refuse values of the past where there are phases, several bodies in one, or a motion that is followed."""
    delayed = delayed_values(problem)
    if isinstance(problem, Phases) and any(getattr(phase, "history", None) for phase in problem.phases):
        raise ExpressionError("history in a problem of phases", "say by start how the first phase begins")
    if not delayed:
        return
    first = delayed[0]
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
    """What was before t = 0, and from it the values at the start of which nothing else is said."""
    entries = list(value_entries("history", control.history))
    yield from entries
    tied = {symbol for condition in _start_conditions(control) for symbol in getattr(condition, "free_symbols", ())}
    given = {*control.start, *control.history, *tied}
    for entry in entries:
        x, before = entry.key, entry.expression
        times = [symbol for symbol in before.free_symbols if isinstance(symbol, Time)]
        values = {x: before} if isinstance(x, (Coordinate, State, Momentum, Velocity)) else {}
        if isinstance(x, Coordinate) and isinstance(x.partner, Velocity) and x.partner not in given:
            values[x.partner] = sympy.diff(before, times[0]) if times else sympy.S.Zero
        for symbol, value in values.items():
            if symbol not in control.start and symbol not in tied:
                yield entry_of("start", f"start of {symbol}", value.subs(dict.fromkeys(times, 0)), symbol)


def _start_conditions(control: Control) -> Sequence[Any]:
    given = control.start_conditions
    return [*given.values()] if isinstance(given, Mapping) else given if isinstance(given, (list, tuple)) else ()


def require_history(entries: Sequence[Entry], delayed: Sequence[Delayed]) -> None:
    """Every value of the past needs a history; that of a control which nothing reads is a mistake."""
    given = [entry.key for entry in entries if entry.role == "history"]
    for value in delayed:
        x = _with_history(value.partner, given)
        if x is None:
            name = value.partner.partner if isinstance(value.partner, Velocity) else value.partner
            raise BoundaryError(
                f"{value} reaches before t = 0, and {name} has no history",
                f"say what it was for t <= 0, as in history={{{name}: 1}}",
            )
    read = {value.partner for value in delayed}
    for x in given:
        if isinstance(x, ControlInput) and x not in read:
            raise SymbolError(f"history gives {x}, which is never delayed", "leave it out, or write .delayed(...)")


def _with_history(x: Quantity, given: Sequence[Any]) -> Quantity | None:
    """The quantity whose history is that of another: its own, or a velocity's that of its coordinate."""
    if x in given:
        return x
    return x.partner if isinstance(x, Velocity) and x.partner in given else None


def delays_of(
    entries: Sequence[Entry], delayed: Sequence[Delayed], plain: Mapping[Quantity, sympy.Symbol], time: sympy.Symbol
) -> tuple[Delay, ...]:
    """The values of the past in the symbols of a model."""
    histories = {entry.key: entry.expression for entry in entries if entry.role == "history"}
    found = []
    for value in delayed:
        x, lag = plain[value.partner], value.lag.xreplace(plain)
        history = histories.get(x)
        if history is None:
            assert isinstance(value.partner, Velocity), "histories are there"
            history = sympy.diff(histories[plain[value.partner.partner]], time)
        found.append(Delay(plain[value], x, lag, history))
    return tuple(found)


def past_name(symbol: Delayed, quantity: str) -> str:
    """How a value of the past is called in a model, as notation reads it."""
    return f"{quantity}@t-{symbol.lag}" if not symbol.lag.is_Add else f"{quantity}@t-({symbol.lag})"
