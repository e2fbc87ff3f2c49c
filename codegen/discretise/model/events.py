"""Events and gaps of a simulation: what the author wrote as entries, and the checks of both.

A gap g(q, t) >= 0 is an event whose effect is derived: see `codegen.discretise.events`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import sympy

from codegen.discretise.conditions.base import Points, is_constant
from codegen.discretise.model.definitions import Condition, Gap, Model, MotionEvent, prescribed
from codegen.discretise.model.relations import MOVING, Entry, checked_mapping, entry_of, relation_entries
from codegen.errors import BoundaryError, ExpressionError
from codegen.problem import perhaps
from codegen.problem.problem import Event, Simulate
from codegen.problem.rotations import spheres_in
from codegen.problem.symbols import Coordinate, Parameter, Quantity, Time
from codegen.runtime.record import EventAction
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounding_at

SCOPE: dict[str, tuple[type[Quantity], ...]] = {
    "event": (*MOVING, Time, Parameter),
    "event change": (*MOVING, Time, Parameter),
    "unilateral": (Coordinate, Time, Parameter),
    "restitution": (Parameter,),
}
"""The kinds of symbols that may occur in an expression, by its role."""
MOST_GAPS = 62
"""Largest number of gaps: the closed gaps at an event are the bits of an integer."""
_WORDS = {"stop": EventAction.STOP, "record": EventAction.RECORD}


def written(problem: Simulate) -> Iterator[Entry]:
    """Yield the author's events and gaps as entries; raise ExpressionError for unsuitable objects."""
    if not isinstance(problem.events, Mapping):
        kind = type(problem.events).__name__
        raise ExpressionError(f"events is a {kind}", 'write events as {"name": expression, ...}')
    for name, value in problem.events.items():
        if not isinstance(name, str) or not name.strip() or not name.isprintable():
            raise ExpressionError(f"events has the name {name!r}", 'write events as {"name": expression, ...}')
        event, what = value if isinstance(value, Event) else Event(value), f"event {name!r}"
        if isinstance(event.expression, sympy.core.relational.Relational):
            finding = f"{what} is the relation {event.expression}"
            raise ExpressionError(finding, "give the expression that vanishes at the event")
        if isinstance(event.direction, bool) or event.direction not in (-1, 0, 1):
            raise ExpressionError(f"{what} has the direction {event.direction!r}", "give 1, -1 or 0")
        yield replace(entry_of("event", what, event.expression), name=name)
        yield from _changes(name, what, event.then)
    yield from relation_entries("unilateral", problem.unilateral)
    values, count = problem.restitution, len(problem.unilateral)
    if not count and values not in (1, [], ()):
        raise ExpressionError("restitution without unilateral", "write unilateral=[gap >= 0], or leave restitution out")
    if isinstance(values, (list, tuple)):
        if len(values) != count:
            raise ExpressionError(
                f"restitution has {len(values)} values for {count} gaps", "give one number, or one for each gap"
            )
    elif isinstance(values, Mapping):
        raise ExpressionError("restitution is a mapping", "give one number, or a list with one for each gap")
    else:
        values = [values] * count
    for index, value in enumerate(values):
        yield entry_of("restitution", f"restitution of gap {index + 1}", value)


def _changes(name: str, what: str, then: object) -> Iterator[Entry]:
    """Yield the values after an event as entries."""
    if isinstance(then, str):
        if then not in _WORDS:
            raise ExpressionError(
                f"{what} has then={then!r}", perhaps(then, _WORDS) or 'give "stop", "record" or a dict'
            )
        return
    mapping = checked_mapping(f"then of {what}", then, "velocity: value after the event")
    if not mapping:
        raise ExpressionError(f"{what} has then={{}}", 'write then="record", or the values after the event')
    for key, value in mapping.items():
        entry = replace(entry_of("event change", f"{what}, then of {key},", value, key), name=name)
        if entry.expression == key:
            raise ExpressionError(f"{entry.what} is its value before", "leave it out, it is continuous")
        yield entry


def require_fitting(problem: Simulate, form: str, entries: Sequence[Entry]) -> None:
    """Raise an error for events and gaps that contradict the form of the problem or its other arguments."""
    if sum(entry.role == "unilateral" for entry in entries) > MOST_GAPS:
        raise ExpressionError(f"unilateral has more than {MOST_GAPS} gaps", "leave out gaps that stay open")
    constraint, remedy = "", "use generalised coordinates in place of the constraint"
    if spheres := spheres_in(problem.lagrangian):
        constraint, remedy = f"the rotation or direction {spheres[0].name}", "leave it out"
    elif problem.constraint:
        constraint = "a holonomic constraint"
    elif problem.rolling:
        constraint, remedy = "a rolling constraint", "leave it out"
    for entry in entries:
        if entry.role == "event change" and constraint:
            raise ExpressionError(f"{entry.what} with {constraint}, which the new values may violate", remedy)
        if entry.role != "unilateral":
            continue
        if entry.equality:
            raise ExpressionError(f"{entry.what} is no inequality", "write gap >= 0, or an equation in constraint")
        if form == "dynamics":
            raise ExpressionError(f"{entry.what} with dynamics", "give a Lagrangian or a Hamiltonian")
        if constraint:
            raise ExpressionError(f"{entry.what} with {constraint}", remedy)


def added(model: Model, problem: Simulate, entries: Sequence[Entry]) -> Model:
    """Return a model with the author's events and gaps; the entries are in the symbols of the model."""
    events = list[MotionEvent]()
    for entry in (entry for entry in entries if entry.role == "event"):
        event = problem.events[entry.name]
        then = event.then if isinstance(event, Event) else "stop"
        changes = [e for e in entries if e.role == "event change" and e.name == entry.name]
        events.append(
            MotionEvent(
                entry.name.strip(),
                entry.expression,
                _WORDS[then] if isinstance(then, str) else EventAction.CHANGE,
                int(event.direction) if isinstance(event, Event) else 0,
                tuple((e.key, e.expression) for e in changes if e.key is not None),
            )
        )
    names = [event.name for event in events]
    gaps = list[Gap]()
    restitutions = [entry.expression for entry in entries if entry.role == "restitution"]
    for entry, e in zip((entry for entry in entries if entry.role == "unilateral"), restitutions, strict=True):
        gaps.append(Gap(entry.name, -entry.expression, e))
        names.append(entry.name)
    for name in names:
        if names.count(name) > 1:
            raise ExpressionError(f"two events or gaps are called {name!r}", "give one of them another name")
    return replace(model, events=tuple(events), gaps=tuple(gaps))


def require_regular(model: Model, points: Points) -> None:
    """Raise an error for constant events and gaps, and for values that are not real at any trial point."""
    for event in model.events:
        named = [(f"event {event.name!r}", event.expression)]
        named += [(f"event {event.name!r}, then of {symbol},", value) for symbol, value in event.changes]
        _require_real(named, points)
        moving = (*model.coordinates, *model.rates, model.time)
        if is_constant(Condition(event.name, event.expression), moving, points):
            raise ExpressionError(
                f"event {event.name!r} is constant: {event.expression}", "let it depend on what moves, or on time"
            )
    for gap in model.gaps:
        _require_real([(f"unilateral {gap.name}", gap.expression)], points)
        if is_constant(Condition(gap.name, gap.expression), model.coordinates, points):
            raise ExpressionError(f"unilateral {gap.name} depends on no coordinate", "leave it out")
    defaults = model.default_values
    for gap in model.gaps:
        number = expressions.rounded_at(gap.restitution, defaults)
        if number is None or not 0.0 <= number <= 1.0:
            raise ExpressionError(
                f"restitution of {gap.name} is {gap.restitution if number is None else f'{number:g}'}",
                "give a number from 0 (inelastic) to 1 (elastic)",
            )


def _require_real(named: Sequence[tuple[str, sympy.Expr]], points: Points) -> None:
    for what, expression in named:
        if all(expressions.rounded_at(expression, point) is None for point in points):
            raise ExpressionError(
                f"{what} has no finite real value at the default parameters", "correct it, or the parameters"
            )


def require_agreement(model: Model) -> None:
    """Raise BoundaryError if the start violates a gap, or if a gap that is closed there begins to become negative."""
    fixed = {**prescribed(model, "start"), model.time: sympy.S.Zero}
    defaults = model.default_values
    values = {symbol: expressions.rounded_at(value, defaults) for symbol, value in fixed.items()}
    numbers = {**defaults, **{symbol: number for symbol, number in values.items() if number is not None}}
    for gap in model.gaps:
        value, level = expressions.rounded_at(gap.expression, numbers), rounding_at(gap.expression, numbers)
        if value is not None and value < -level:
            raise BoundaryError(f"start violates {gap.name}: the gap is {value:g}", "correct one of them")
        if value is None or value > level or model.form != "lagrangian":
            continue
        terms = zip(model.coordinates, model.rates, strict=True)
        rate = sympy.Add(gap.expression.diff(model.time), *(gap.expression.diff(q) * v for q, v in terms))
        speed = expressions.rounded_at(rate, numbers)
        if speed is not None and speed < -rounding_at(rate, numbers):
            raise BoundaryError(
                f"start closes {gap.name} with the velocity {speed:g}", "start before the impact, or after it"
            )
