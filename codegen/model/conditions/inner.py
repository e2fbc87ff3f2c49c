"""Conditions at times between start and end, given or free; imposed by `transcribe.conditions.inner_times`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any, ClassVar

from sympy import Expr, Integer

from codegen.author.problem import Control, Waypoint
from codegen.author.symbols import ControlInput, Parameter, Time
from codegen.errors import BoundaryError, ExpressionError
from codegen.expressions import checks as expressions
from codegen.model.conditions.base import Kind, Latex, Points, Remedies, Scope, dependent, is_constant, listed
from codegen.model.conditions.path import nodal_conditions
from codegen.model.definitions import Condition, InnerCondition, InnerTime, Model
from codegen.model.relations import MOVING, STATIC, Entry, checked_sequence, entry_of, relation_entries, text

_SAME = 1e-9
"""Parts of the duration by which two times differ at least."""
_ORDER = "let each be before the next, and all before the end"


class AtTimes(Kind):
    """Equations and inequalities at given times, which become nodes."""

    argument, field, words = "at", "inner_conditions", "conditions at inner times"
    check = "inner times"
    scope: ClassVar[Scope] = {"at": (*MOVING, Time, *STATIC), "inner time": (Parameter,)}
    remedies: ClassVar[Remedies] = {ControlInput: "limit controls by bounds or path, or make the control a state"}
    not_in_phases = BoundaryError, "it has conditions at inner times", "end a phase there, with end_conditions"

    def written(self, control: Control) -> Iterator[Entry]:
        """Each time, followed by the conditions there."""
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

    def of_model(self, model: Model) -> tuple[Any, ...]:
        return () if any(inner.time is None for inner in model.inner_times) else model.inner_conditions

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """The times in their order at the default parameters, as far as they have numbers, and what holds there."""
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
        """Refuse times that are not between start and end or not in order, and conditions that say nothing new."""
        _require_order(model)
        symbols = (*model.coordinates, *model.rates, *(free.symbol for free in model.free_parameters))
        always = [*nodal_conditions(model, equality=True), *(Condition(f"{text(c)} = 0", c) for c in model.holonomic)]
        for condition in model.inner_conditions:
            if is_constant(condition, (*model.coordinates, *model.rates), points):
                raise ExpressionError(f"the condition {condition} depends on nothing that moves", "leave it out")
        for number in range(len(model.inner_times)):
            there = [c for c in model.inner_conditions if c.number == number and c.equality]
            names = dependent([*always, *there], symbols, points) if there else ""
            if names:
                raise BoundaryError(f"the conditions {names} depend on each other", "leave out one of them")

    def sentences(self, model: Model) -> list[str]:
        return [*(condition.name for condition in model.inner_conditions), *filter(None, _windows(model))]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        for number, inner in enumerate(model.inner_times):
            there = [c for c in model.inner_conditions if c.number == number]
            where = f"waypoint {number + 1}" if inner.time is None else f"the inner time {text(inner.time)}"
            limits = (("earliest", inner.earliest), ("latest", inner.latest))
            if equations := tuple(("0", c.expression) for c in there if c.equality):
                yield f"At {where}", equations
            if inequalities := tuple((f"g_{i}", c.expression) for i, c in enumerate(there, 1) if not c.equality):
                yield f"At {where}, not positive", inequalities
            if window := tuple((name, limit) for name, limit in limits if limit is not None):
                yield f"The time of {where}", window

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        for time, relations in control.at.items() if isinstance(control.at, Mapping) else ():
            where = rf"\quad\text{{at }} t = {latex(time)}"
            yield from (f"&{latex.relation(relation)}{where}" for relation in listed(relations))


class Waypoints(Kind):
    """Equations and inequalities at times that are free, but in order; with given ones they are one field."""

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
        """The number of each, followed by its window and the conditions there."""
        if control.waypoints and control.bodies != 1:
            raise BoundaryError("waypoints beside bodies", "give times, as in at={time: [...]}, or use together(...)")
        for number, given in enumerate(checked_sequence(self.argument, control.waypoints, "[relation, ...]")):
            waypoint = given if isinstance(given, Waypoint) else Waypoint(given)
            yield entry_of("waypoint", f"waypoint {number + 1}", Integer(number))
            yield from _window(f"waypoints[{number}]", waypoint.window)
            yield from _conditions(self.argument, f"waypoints[{number}]", f"waypoint {number + 1}", waypoint.conditions)

    def of_model(self, model: Model) -> tuple[Any, ...]:
        return model.inner_conditions if any(inner.time is None for inner in model.inner_times) else ()

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        times = list[InnerTime]()
        for entry in entries:
            if entry.role == "waypoint":
                times.append(InnerTime(None))
            elif entry.role in ("earliest", "latest"):
                limit: dict[str, Any] = {entry.role: entry.expression}
                times[-1] = replace(times[-1], **limit)
        return replace(
            model,
            inner_times=(*model.inner_times, *times),
            inner_conditions=(
                *model.inner_conditions,
                *_numbered(self.argument, "waypoint", entries, range(len(times))),
            ),
        )

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        yield from ()

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        """What holds at times that are to be found, which have numbers, and their order."""
        times = [f"t_{{{number}}}" for number in range(1, len(control.waypoints) + 1)]
        for given, time in zip(control.waypoints, times, strict=True):
            waypoint = given if isinstance(given, Waypoint) else Waypoint(given)
            conditions = r",\; ".join(map(latex.relation, listed(waypoint.conditions)))
            yield rf"&{conditions}\quad\text{{at }} t = {time}"
            if waypoint.window != (None, None):
                yield f"&{latex.between(time, waypoint.window)}"
        if times:
            yield "&" + " < ".join([latex.first, *times, latex.last])


def _conditions(role: str, what: str, where: str, relations: Any) -> Iterator[Entry]:
    """What holds at one inner time; ExpressionError where that is nothing."""
    found = list(relation_entries(what, relations))
    if not found:
        raise ExpressionError(f"{what} has no condition", "write what holds then, or leave it out")
    yield from (replace(entry, role=role, name=f"{entry.name} at {where}") for entry in found)


def _window(what: str, window: Any) -> Iterator[Entry]:
    if not isinstance(window, (tuple, list)) or len(window) != 2:
        raise ExpressionError(f"the window of {what} is {window!r}", "write window=(earliest, latest)")
    for role, limit in zip(("earliest", "latest"), window, strict=True):
        if limit is not None:
            yield entry_of(role, f"the {role} time of {what}", limit)


def _numbered(role: str, time: str, entries: Sequence[Entry], order: Sequence[int]) -> list[InnerCondition]:
    """The conditions of a role, each of which follows the entry of its time, by times in their order."""
    found, number = list[InnerCondition](), -1
    for entry in entries:
        if entry.role == time:
            number += 1
        elif entry.role == role:
            found.append(InnerCondition(entry.name, entry.expression, entry.equality, list(order).index(number)))
    return sorted(found, key=lambda condition: condition.number)


def _windows(model: Model) -> Iterator[str]:
    """What windows say of times."""
    for number, inner in enumerate(model.inner_times, start=1):
        limits = [f">= {text(inner.earliest)}"] if inner.earliest is not None else []
        limits += [f"<= {text(inner.latest)}"] if inner.latest is not None else []
        yield f"the time of waypoint {number} {' and '.join(limits)}" if limits else ""


def _require_order(model: Model) -> None:
    """Refuse times that are not in order between start and end, and windows that leave none, at the defaults."""
    if not model.inner_times:
        return
    values = model.default_values
    values |= {f.symbol: expressions.rounded_at(f.guess, values) or 0.0 for f in model.free_parameters}
    duration = expressions.rounded_at(model.duration, values) or 0.0
    is_free = bool(model.duration.free_symbols & {f.symbol for f in model.free_parameters})

    def number(time: Expr | None) -> float | None:
        return None if time is None else expressions.rounded_at(time, values)

    given = [(text(inner.time), number(inner.time) or 0.0) for inner in model.inner_times if inner.time is not None]
    for name, time in given:
        if time <= _SAME * duration:
            raise BoundaryError(
                f"the time {name} of at is {time:g}, not after the start", "write it into start or start_conditions"
            )
        if time >= (1 - _SAME) * duration and not is_free:
            raise BoundaryError(
                f"the time {name} of at is {time:g}, not before the end, {duration:g}",
                "write it into end or end_conditions",
            )
    for (first, one), (second, other) in pairwise(given):
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
