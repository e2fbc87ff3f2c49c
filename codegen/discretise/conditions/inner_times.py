"""Conditions at times between start and end, fixed or free, imposed at nodes of one chain of intervals.

A condition g = 0 has a multiplier y on the node, and g <= 0 also a slack s >= 0. Only the running module knows which
nodes are inner times. Therefore every node has these unknowns and a number m, one at inner times and zero elsewhere.
The contribution l of each interval to the Lagrangian of the optimisation problem gains, at its left node,

    m y g + (1 - m) y^2/2    or    m y (g + s) + (1 - m) (y^2 + s^2)/2,

so that the unknowns vanish at other nodes. Conditions that differ in numbers alone are one expression, whose numbers
belong to the node like m. Different conditions at different times have a common multiplier. Neither the code nor the
time of a build grows with the number of times.

Where times are free, every node has its time e and a pace a > 0: the derivative of time with respect to a parameter, on
the interval before the node. The parameter runs from 0 to 1 over the motion, and grows by the same amount between any
two consecutive inner times. An interval of length h in the parameter lasts a_k1 h, and its l gains

    mu_e (e_k1 - e_k - a_k1 h) + mu_a (a_k1 - a_k),

the second term only where its left node is not at an inner time: the pace is constant between two inner times. Each
interval depends on its own length alone, so that the bandwidth of the KKT matrix does not depend on the number of
inner times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import ClassVar

import numpy as np
import sympy
from sympy import Add, Expr, Integer, Mul, Pow, Rational, S, Symbol

from codegen.discretise.conditions.base import (
    ConditionKind,
    Latex,
    Points,
    Remedies,
    Scope,
    dependent,
    is_constant,
    listed,
)
from codegen.discretise.conditions.ends import End
from codegen.discretise.conditions.path import NodalTerms, nodal_conditions
from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import Condition, InnerCondition, InnerTime, Model
from codegen.discretise.model.relations import MOVING, STATIC, Entry, checked_sequence, entry_of, relation_entries, text
from codegen.discretise.program import Equation, InnerTimes, Names, Unknown, symbols
from codegen.errors import BoundaryError, ExpressionError
from codegen.problem.problem import Control, Relations, Waypoint
from codegen.problem.symbols import ControlInput, Parameter, Time
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic import checks as expressions

_SAME = 1e-9
"""Two times differ by at least this fraction of the duration."""
_ORDER = "let each be before the next, and all before the end"
_TRIALS = 30
"""Number of random points of each size at which an expression is tried."""


class AtTimes(ConditionKind):
    """Equations and inequalities at fixed times, which become nodes."""

    argument, field, words = "at", "inner_conditions", "conditions at inner times"
    check = "inner times"
    scope: ClassVar[Scope] = {"at": (*MOVING, Time, *STATIC), "inner time": (Parameter,)}
    remedies: ClassVar[Remedies] = {ControlInput: "limit controls by bounds or path, or make the control a state"}
    not_in_phases = BoundaryError, "it has conditions at inner times", "end a phase there, with end_conditions"

    def written(self, control: Control) -> Iterator[Entry]:
        """Yield each time, followed by the conditions at this time."""
        if not isinstance(control.at, Mapping):
            finding = f"at is a {type(control.at).__name__}"
            raise ExpressionError(finding, "write at as {time: [relation, ...], ...}, as in {2: [x >= 1]}")
        if control.at and control.waypoints:
            raise BoundaryError("at beside waypoints", "write Waypoint([...], window=(time, time)) for a given time")
        for time, relations in control.at.items():
            entry = entry_of("inner time", "a time of at", time)
            name = text(entry.expression)
            yield replace(entry, what=f"the time {name} of at")
            yield from _conditions(self.argument, f"at[{name}]", name, relations)

    def of_model(self, model: Model) -> tuple[InnerCondition, ...]:
        return () if any(inner.time is None for inner in model.inner_times) else model.inner_conditions

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """Return a model with the conditions added, and with their times, sorted at the default parameters."""
        times = [entry.expression for entry in entries if entry.role == "inner time"]
        numbers = [expressions.rounded_at(time, model.default_values) or 0.0 for time in times]
        order = sorted(range(len(times)), key=numbers.__getitem__)
        return replace(
            model,
            inner_times=(*model.inner_times, *(InnerTime(times[i]) for i in order)),
            inner_conditions=(*model.inner_conditions, *_numbered(self.argument, "inner time", entries, order)),
        )

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ((condition.name, condition.expression) for condition in model.inner_conditions)

    def numbers(self, model: Model) -> Iterator[tuple[str, Expr]]:
        for inner in model.inner_times:
            limits = inner.time, inner.earliest, inner.latest
            yield from ((f"the inner time {text(time)}", time) for time in limits if time is not None)

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise an error for times out of order or outside the motion, and for constant or dependent conditions."""
        _require_order(model)
        symbols = (*model.coordinates, *model.rates, *(free.symbol for free in model.free_parameters))
        always = [*nodal_conditions(model, equality=True), *(Condition(f"{text(c)} = 0", c) for c in model.holonomic)]
        for condition in model.inner_conditions:
            if is_constant(condition, (*model.coordinates, *model.rates), points):
                raise ExpressionError(f"the condition {condition} depends on nothing that moves", "leave it out")
        for number in range(len(model.inner_times)):
            equations = [c for c in model.inner_conditions if c.number == number and c.equality]
            names = dependent([*always, *equations], symbols, points) if equations else ""
            if names:
                raise BoundaryError(f"the conditions {names} depend on each other", "leave out one of them")

    def sentences(self, model: Model) -> list[str]:
        lines = [condition.name for condition in model.inner_conditions]
        for number, inner in enumerate(model.inner_times, start=1):
            limits = [f">= {text(inner.earliest)}"] if inner.earliest is not None else []
            limits += [f"<= {text(inner.latest)}"] if inner.latest is not None else []
            lines += [f"the time of waypoint {number} {' and '.join(limits)}"] if limits else []
        return lines

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        for number, inner in enumerate(model.inner_times):
            conditions = [c for c in model.inner_conditions if c.number == number]
            where = f"waypoint {number + 1}" if inner.time is None else f"the inner time {text(inner.time)}"
            limits = (("earliest", inner.earliest), ("latest", inner.latest))
            if equations := tuple(("0", c.expression) for c in conditions if c.equality):
                yield f"At {where}", equations
            if inequalities := tuple((f"g_{i}", c.expression) for i, c in enumerate(conditions, 1) if not c.equality):
                yield f"At {where}, not positive", inequalities
            if window := tuple((name, limit) for name, limit in limits if limit is not None):
                yield f"The time of {where}", window

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        for time, relations in control.at.items() if isinstance(control.at, Mapping) else ():
            where = rf"\quad\text{{at }} t = {latex(time)}"
            yield from (f"&{latex.relation(relation)}{where}" for relation in listed(relations))


class Waypoints(ConditionKind):
    """Equations and inequalities at free times in a given order, in the same fields of the model as `AtTimes`."""

    argument, field, words = "waypoints", "inner_conditions", "waypoints"
    check = AtTimes.check
    scope: ClassVar[Scope] = {
        "waypoints": (*MOVING, Time, *STATIC),
        "waypoint": (),
        "earliest": (Parameter,),
        "latest": (Parameter,),
    }
    remedies: ClassVar[Remedies] = AtTimes.remedies
    not_in_phases = BoundaryError, "it has waypoints", "end a phase at each of them, with end_conditions"

    def written(self, control: Control) -> Iterator[Entry]:
        """Yield the number of each waypoint, followed by its window and its conditions."""
        if control.waypoints and control.bodies != 1:
            raise BoundaryError("waypoints beside bodies", "give times, as in at={time: [...]}, or use together(...)")
        for number, written in enumerate(checked_sequence(self.argument, control.waypoints, "[relation, ...]")):
            waypoint, what = _waypoint(written), f"waypoints[{number}]"
            yield entry_of("waypoint", f"waypoint {number + 1}", Integer(number))
            if not isinstance(waypoint.window, (tuple, list)) or len(waypoint.window) != 2:
                finding = f"the window of {what} is {waypoint.window!r}"
                raise ExpressionError(finding, "write window=(earliest, latest)")
            for role, limit in zip(("earliest", "latest"), waypoint.window, strict=True):
                if limit is not None:
                    yield entry_of(role, f"the {role} time of {what}", limit)
            yield from _conditions(self.argument, what, f"waypoint {number + 1}", waypoint.conditions)

    def of_model(self, model: Model) -> tuple[InnerCondition, ...]:
        return model.inner_conditions if any(inner.time is None for inner in model.inner_times) else ()

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        times = list[InnerTime]()
        for entry in entries:
            if entry.role == "waypoint":
                times.append(InnerTime(None))
            elif entry.role == "earliest":
                times[-1] = replace(times[-1], earliest=entry.expression)
            elif entry.role == "latest":
                times[-1] = replace(times[-1], latest=entry.expression)
        conditions = _numbered(self.argument, "waypoint", entries, range(len(times)))
        return replace(
            model,
            inner_times=(*model.inner_times, *times),
            inner_conditions=(*model.inner_conditions, *conditions),
        )

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ()

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        """Yield the conditions at the free times t_1, t_2, ..., the windows, and the order of the times."""
        times = [f"t_{{{number}}}" for number in range(1, len(control.waypoints) + 1)]
        for written, time in zip(control.waypoints, times, strict=True):
            waypoint = _waypoint(written)
            conditions = r",\; ".join(map(latex.relation, listed(waypoint.conditions)))
            yield rf"&{conditions}\quad\text{{at }} t = {time}"
            if waypoint.window != (None, None):
                yield f"&{latex.between(time, waypoint.window)}"
        if times:
            yield "&" + " < ".join([latex.first, *times, latex.last])


def _waypoint(written: Waypoint | Relations) -> Waypoint:
    return written if isinstance(written, Waypoint) else Waypoint(written)


def _conditions(role: str, what: str, where: str, relations: Relations) -> Iterator[Entry]:
    """Yield the conditions at one inner time; raise ExpressionError if there is no condition."""
    entries = list(relation_entries(what, relations))
    if not entries:
        raise ExpressionError(f"{what} has no condition", "write what holds then, or leave it out")
    yield from (replace(entry, role=role, name=f"{entry.name} at {where}") for entry in entries)


def _numbered(role: str, time: str, entries: Sequence[Entry], order: Sequence[int]) -> list[InnerCondition]:
    """Return the conditions of a `role`, sorted by the `order` of their times; each follows the entry of its `time`."""
    conditions, number = list[InnerCondition](), -1
    for entry in entries:
        if entry.role == time:
            number += 1
        elif entry.role == role:
            conditions.append(InnerCondition(entry.name, entry.expression, entry.equality, list(order).index(number)))
    return sorted(conditions, key=lambda condition: condition.number)


def _require_order(model: Model) -> None:
    """Raise BoundaryError for empty windows, and for times that are not in order between start and end."""
    if not model.inner_times:
        return
    values = model.default_values
    values |= {f.symbol: expressions.rounded_at(f.guess, values) or 0.0 for f in model.free_parameters}
    duration = expressions.rounded_at(model.duration, values) or 0.0
    is_free = bool(model.duration.free_symbols & {f.symbol for f in model.free_parameters})

    def number(time: Expr | None) -> float | None:
        return None if time is None else expressions.rounded_at(time, values)

    fixed = [(text(inner.time), number(inner.time) or 0.0) for inner in model.inner_times if inner.time is not None]
    for name, time in fixed:
        if time <= _SAME * duration:
            raise BoundaryError(
                f"the time {name} of at is {time:g}, not after the start", "write it into start or start_conditions"
            )
        if time >= (1 - _SAME) * duration and not is_free:
            raise BoundaryError(
                f"the time {name} of at is {time:g}, not before the end, {duration:g}",
                "write it into end or end_conditions",
            )
    for (first, one), (second, other) in pairwise(fixed):
        if other - one <= _SAME * duration:
            finding = f"the times {first} and {second} of at are the same"
            raise BoundaryError(finding, "write the conditions there into one list")
    soonest = 0.0
    for index, inner in enumerate(model.inner_times, start=1):
        earliest, latest = number(inner.earliest), number(inner.latest)
        if earliest is not None and latest is not None and earliest > latest:
            raise BoundaryError(f"the window of waypoint {index} ends before it begins", "exchange the two times")
        soonest = max(soonest, earliest or 0.0)
        if latest is not None and latest <= (soonest if earliest is None or soonest > earliest else 0.0):
            before = f"an earlier one at {soonest:g} or later" if soonest > 0.0 else "the start at 0"
            raise BoundaryError(f"waypoint {index} is to be at {latest:g} or before, and {before}", _ORDER)
        if earliest is not None and earliest >= duration and not is_free:
            raise BoundaryError(f"waypoint {index} is to be at {earliest:g} or later, after the end", _ORDER)


def inner_terms(
    model: Model, at_left: Callable[[Expr], Expr], names: Names, clock: Clock | None
) -> tuple[NodalTerms, InnerTimes]:
    """Return the unknowns that conditions at inner times add to each node, and the InnerTimes of a program.

    `at_left` writes an expression in the symbols of the left node of an interval. The indices in the InnerTimes count
    only the added unknowns, from zero. If the times are free, `clock` has the unknowns for them, otherwise it is None.
    """
    if not model.inner_conditions:
        return NodalTerms(), InnerTimes()
    numbers, element = range(len(model.inner_times)), S.Zero
    if clock is None:
        times = tuple(inner.time for inner in model.inner_times if inner.time is not None)
        table = _Table(model, names, clock)
    else:
        times = tuple(Rational(i + 1, len(numbers) + 1) for i in numbers)  # equal shares of the chain
        # Fixed times, and windows without length, are conditions on the clock.
        conditions, inner_times = list(model.inner_conditions), list(model.inner_times)
        for number, inner in enumerate(model.inner_times):
            window = inner.earliest if inner.earliest == inner.latest else None
            fixed = inner.time if inner.time is not None else window
            if fixed is not None:
                conditions.append(InnerCondition(f"the time {text(fixed)}", clock.symbol - fixed, True, number))
                inner_times[number] = replace(inner, earliest=None, latest=None)
        conditions = [replace(c, expression=c.expression.xreplace({model.time: clock.symbol})) for c in conditions]
        model = replace(model, inner_conditions=tuple(conditions), inner_times=tuple(inner_times))
        table = _Table(model, names, clock)
        # The contribution to an interval before lengths are replaced.
        left, right = (symbols([unknown.name for unknown in clock.node], end) for end in ("_k", "_k1"))
        mu_time, mu_pace = symbols([unknown.name for unknown in clock.interval], "_k")
        constant, is_inner = mu_pace * (right[1] - left[1]), table.symbol(dict.fromkeys(numbers, S.One))
        element = mu_time * (right[0] - left[0] - STEP) + constant + is_inner * (mu_pace**2 / 2 - constant)
    unknowns = list[Unknown]()
    present, multipliers = dict[int, list[int]](), list[tuple[str, int, int]]()
    at: dict[int, list[InnerCondition]] = {}
    for condition in model.inner_conditions:
        at.setdefault(condition.number, []).append(condition)
    lanes: list[list[InnerCondition]] = [[] for _ in range(max(map(len, at.values())))]
    for simultaneous in at.values():
        for rank, condition in zip(lanes, (c for c in simultaneous if c.equality), strict=False):
            rank.append(condition)
        for rank, condition in zip(reversed(lanes), (c for c in simultaneous if not c.equality), strict=False):
            rank.append(condition)
    for lane in lanes:
        first = len(unknowns)
        unknowns.append(Unknown(names.numbered("nu"), Meaning(Kind.INNER_CONDITION)))
        slack = S.Zero
        if any(not c.equality for c in lane):
            unknowns.append(Unknown(names.numbered("s"), Meaning(Kind.INNER_SLACK), lower=S.Zero))
            (slack,) = symbols([unknowns[-1].name], "_k")
        (multiplier,) = symbols([unknowns[first].name], "_k")
        element += table.share(lane, multiplier, slack, at_left)
        for c in lane:
            present.setdefault(c.number, []).extend([first] if c.equality else [first, first + 1])
            multipliers.append((c.name, c.number, first))
    pins = tuple(unknown.name for unknown in unknowns)
    return (
        NodalTerms(tuple(unknowns), element, pins, pins),
        InnerTimes(
            times=times,
            symbols=tuple(table.rows),
            numbers=tuple(tuple(row.get(number, S.Zero) for number in numbers) for row in table.rows.values()),
            unknowns=tuple(range(len(unknowns))),
            present=tuple(tuple(i in present.get(number, []) for i in range(len(unknowns))) for number in numbers),
            multipliers=tuple(sorted(multipliers, key=lambda entry: entry[1:])),
            windows=tuple(
                (number, inner.earliest, inner.latest)
                for number, inner in enumerate(model.inner_times)
                if inner.earliest is not None or inner.latest is not None
            ),
            scales=() if clock is None else clock.scales,
        ),
    )


class _Table:
    """The numbers that belong to nodes: `rows` maps each symbol to its values by the index of the inner time."""

    def __init__(self, model: Model, names: Names, clock: Clock | None) -> None:
        self._model, self._names = model, names
        self._moving = {*model.coordinates, *model.rates, *(free.symbol for free in model.free_parameters)}
        self._at_node: dict[Symbol, Expr] = {}
        if clock is not None:
            self._moving.add(clock.symbol)
            self._at_node = {clock.symbol: dict(clock.scales)[model.time]}
        self.rows: dict[Symbol, dict[int, Expr]] = {}

    def share(
        self, lane: Sequence[InnerCondition], multiplier: Symbol, slack: Expr, at_left: Callable[[Expr], Expr]
    ) -> Expr:
        """Return the contribution to l of the conditions in a `lane`, which have a common multiplier and slack."""
        element, present, slacked = S.Zero, S.Zero, S.Zero
        for equality in (True, False):
            alike = [c for c in lane if c.equality == equality]
            at_times = list[Expr]()
            for c in alike:
                time = self._model.inner_times[c.number].time
                at_times.append(c.expression if time is None else c.expression.xreplace({self._model.time: time}))
            for form in common_forms(at_times, self._moving):
                members = {alike[i].number: values for i, values in form.members.items()}
                is_here = self.symbol(dict.fromkeys(members, S.One))
                columns = [{time: values[i] for time, values in members.items()} for i in range(len(form.places))]
                numbers = dict(zip(form.places, (self.symbol(column) for column in columns), strict=True))
                value = at_left(self._defined_everywhere(form, numbers, is_here)).xreplace(self._at_node)
                element += is_here * multiplier * (value + (0 if equality else slack))
                present, slacked = present + is_here, slacked + (0 if equality else is_here)
        absent = multiplier**2 + slack**2 - present * multiplier**2 - slacked * slack**2
        return element + sympy.expand(absent / 2)

    def _defined_everywhere(self, form: Form, numbers: Mapping[Symbol, Symbol], is_here: Symbol) -> Expr:
        """Return the expression of a form with symbols for `numbers`, which is also finite where `is_here` is zero.

        A distance has no derivative at zero, and a root has no value below zero. At nodes where the condition does not
        hold, the expression is evaluated at a regular point: zero times infinity is no number.
        """
        moving = sorted(form.expression.free_symbols & self._moving, key=str)
        if form.expression.is_polynomial(*moving, *numbers):
            return form.expression.xreplace(numbers)
        first = dict(zip(numbers, next(iter(form.members.values())), strict=True))
        point = _regular_point(form.expression.xreplace(first), moving, self._model.default_values)
        values = {x: is_here * x + (1 - is_here) * value for x, value in point.items()}
        values |= {place: symbol + (1 - is_here) * first[place] for place, symbol in numbers.items()}
        return form.expression.xreplace(values)

    def symbol(self, row: Mapping[int, Expr]) -> Symbol:
        """Return the symbol for numbers by the index of the inner time; equal rows have one symbol."""
        for symbol, numbers in self.rows.items():
            if numbers == row:
                return symbol
        symbol = Symbol(self._names.numbered("at"), real=True)
        self.rows[symbol] = dict(row)
        return symbol


def _regular_point(expression: Expr, moving: Sequence[Symbol], values: Mapping[Symbol, float]) -> dict[Symbol, Expr]:
    """Return values of the moving symbols at which an expression and two derivatives are finite, or {}."""
    slopes = [sympy.diff(expression, x) for x in moving]
    derivatives = [expression, *slopes, *(sympy.diff(slope, x) for slope in slopes for x in moving)]
    generator = np.random.default_rng(7)
    for size in np.repeat((1.0, 10.0, 0.1, 100.0), _TRIALS):
        drawn = size * generator.uniform(-0.3, 1.0, len(moving))
        point = {x: Rational(str(round(float(number), 3))) for x, number in zip(moving, drawn, strict=True)}
        at = {**values, **{x: float(number) for x, number in point.items()}}
        if all(expressions.rounded_at(value, at) is not None for value in derivatives):
            return point
    return {}


@dataclass(frozen=True)
class Clock:
    """Time and pace as unknowns of a node, and the multipliers of their equations as unknowns of an interval.

    `symbol` is the time in conditions at inner times. `scales` pair h and t with the length of an interval and the time
    at its left node. `start` and `end` fix the time to zero and to the duration.
    """

    symbol: Symbol
    node: tuple[Unknown, Unknown]
    interval: tuple[Unknown, Unknown]
    scales: tuple[tuple[Symbol, Expr], ...]
    start: End
    end: End


def clock_of(model: Model, names: Names) -> Clock | None:
    """Return the unknown times of the nodes as a Clock; None if inner times and duration are prescribed."""
    free, duration = {parameter.symbol for parameter in model.free_parameters}, model.duration
    if not any(inner.time is None or duration.free_symbols & free for inner in model.inner_times):
        return None
    time, pace = names.named("time", model.time), names.named("pace", model.time)
    mu_time, mu_pace = names.numbered("mu_time"), names.numbered("mu_pace")
    (left_time,), (right_time, right_pace) = symbols([time], "_k"), symbols([time, pace], "_k1")
    end = End(pins=((time, duration),))
    if duration.free_symbols & free:
        multiplier, excess = Unknown(names.numbered("nu"), Meaning(Kind.DURATION)), right_time - duration
        (nu,) = symbols([multiplier.name], "_k1")
        end = End(extra=(multiplier,), element=nu * excess, conditions=(Equation(excess, condition=time),))
    return Clock(
        symbol=Symbol(time, real=True),
        node=(Unknown(time, Meaning(Kind.TIME)), Unknown(pace, Meaning(Kind.PACE), lower=S.Zero)),
        interval=(Unknown(mu_time, Meaning(Kind.PASSING_TIME)), Unknown(mu_pace, Meaning(Kind.CONSTANT_PACE))),
        scales=((STEP, right_pace * STEP), (model.time, left_time)),
        start=End(pins=((time, S.Zero),)),
        end=end,
    )


@dataclass(frozen=True)
class Form:
    """The common form of several expressions: x - 1 and x - 2 have the form x - n, with a symbol n in `places`.

    `members` maps the index of each expression to its numbers, in the order of `places`.
    """

    expression: Expr
    places: tuple[Symbol, ...]
    members: Mapping[int, tuple[Expr, ...]]


def common_forms(expressions: Sequence[Expr], moving: AbstractSet[Symbol]) -> tuple[Form, ...]:
    """Group expressions that differ in numbers alone, and return their forms in the order of first occurrence.

    A part without `moving` symbols is a number. Exponents belong to the form, and so does every number that is equal in
    all expressions of the form.
    """
    groups: dict[str, dict[int, tuple[Expr, tuple[Expr, ...]]]] = {}
    for index, expression in enumerate(expressions):
        values = list[Expr]()
        pattern = _sum(expression, moving, values)
        groups.setdefault(str(pattern), {})[index] = pattern, tuple(values)
    forms = list[Form]()
    for group in groups.values():
        pattern, values_of_first = next(iter(group.values()))
        numbers = range(len(values_of_first))
        different = [i for i in numbers if any(values[i] != values_of_first[i] for _, values in group.values())]
        shared = {_place(i): value for i, value in enumerate(values_of_first) if i not in different}
        members = {index: tuple(values[i] for i in different) for index, (_, values) in group.items()}
        forms.append(Form(pattern.xreplace(shared), tuple(map(_place, different)), members))
    return tuple(forms)


def _place(index: int) -> Symbol:
    return Symbol(f"number[{index}]", real=True)


def _placed(value: Expr, values: list[Expr]) -> Symbol:
    """Append a number to `values`, and return the symbol in its place."""
    values.append(value)
    return _place(len(values) - 1)


def _pattern(expression: Expr, moving: AbstractSet[Symbol], values: list[Expr]) -> Expr:
    """Return the expression with symbols in place of numbers, and append the numbers to `values`."""
    if not expression.free_symbols & moving:
        return _placed(expression, values)
    if not expression.args:
        return expression
    if isinstance(expression, Add):
        return _sum(expression, moving, values)
    if isinstance(expression, Mul):
        number, rest = expression.as_independent(*moving, as_Add=False)
        factors = [_pattern(factor, moving, values) for factor in _sorted(Mul.make_args(rest), moving)]
        return Mul(_placed(number, values), *factors) if number != 1 else Mul(*factors)
    if isinstance(expression, Pow) and not expression.exp.free_symbols & moving:
        return Pow(_pattern(expression.base, moving, values), expression.exp)
    return expression.func(*(_pattern(argument, moving, values) for argument in expression.args))


def _sum(expression: Expr, moving: AbstractSet[Symbol], values: list[Expr]) -> Expr:
    """Return a sum with symbols for numbers: the factor of every term, and a constant that may be zero."""
    constant, rest = expression.as_independent(*moving, as_Add=True)
    pairs = [term.as_independent(*moving, as_Add=False) for term in Add.make_args(rest)]
    factors = {part: number for number, part in pairs}
    parts = _sorted(list(factors), moving)
    terms = [_placed(factors[part], values) * _pattern(part, moving, values) for part in parts]
    return Add(*terms, _placed(constant, values))


def _sorted(parts: Sequence[Expr], moving: AbstractSet[Symbol]) -> list[Expr]:
    """Return the parts in an order that does not depend on their numbers."""
    return sorted(parts, key=lambda part: (str(_pattern(part, moving, [])), str(part)))
