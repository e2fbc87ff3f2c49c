"""Conditions on coordinates and rates at one end, in addition to prescribed values; at the end also between bodies.

An end of the time interval has prescribed values, conditions, and unknowns that other nodes do not need. All nodes have
the same layout, so that these unknowns exist at every node: a term x^2/2 in the contribution of every interval to the
Lagrangian makes them vanish elsewhere. `linking` imposes the conditions between bodies.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

from sympy import Expr, Max, Min, S, Symbol, expand

from codegen.discretise.conditions.base import (
    ConditionKind,
    Latex,
    Points,
    Remedies,
    Scope,
    conditions_of,
    dependent,
    is_constant,
)
from codegen.discretise.model.definitions import Condition, Model, prescribed
from codegen.discretise.model.relations import MOVING, STATIC, Entry
from codegen.discretise.program import EndBound, EndElement, Equation, Names, Unknown, symbols
from codegen.errors import BoundaryError
from codegen.problem.bodies import require_single_bodies
from codegen.problem.symbols import ControlInput, EndValue, Time
from codegen.runtime.record import Kind, Meaning, Place
from codegen.symbolic import checks as expressions
from codegen.symbolic.terms import distinct

_DURATION = "time is the duration there, so write its expression"
_CONTROLS = "limit controls by bounds or path, or make the control a state"


class AtStart(ConditionKind):
    """Equations and inequalities at the start."""

    argument = field = "start_conditions"
    words, end = "conditions at its ends", "start"
    scope: ClassVar[Scope] = {"start_conditions": (*MOVING, *STATIC)}
    remedies: ClassVar[Remedies] = {Time: "time is zero there", ControlInput: _CONTROLS}

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        yield from self.of_model(model) if end == self.end else ()

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise an error unless the equations restrict quantities that this end does not already prescribe."""
        conditions: tuple[Condition, ...] = self.of_model(model)
        free = tuple(parameter.symbol for parameter in model.free_parameters)
        symbols = (*model.coordinates, *model.rates, *(free if model.bodies == 1 else ()))
        for condition in conditions:
            if is_constant(condition, symbols, points):
                raise BoundaryError(
                    f"{self.argument} {condition} depends on no coordinate or rate", "correct it, or leave it out"
                )
        fixed = prescribed(model, self.end)
        unknown = [s for s in (*model.coordinates, *model.rates, *free) if s not in fixed]
        equations = [condition for condition in conditions if condition.equality]
        numbers = {symbol: expressions.rounded_at(value, points[0]) for symbol, value in fixed.items()}
        at_end = {symbol: number for symbol, number in numbers.items() if number is not None}
        likely = [{**point, **at_end} for point in points]
        for condition in equations:
            if is_constant(condition, unknown, likely):
                raise BoundaryError(
                    f"{self.argument} {condition} ties only values that {self.end} fixes already",
                    "leave it out, or let one of the values be free",
                )
        names = dependent(equations, unknown, likely)
        if names:
            raise BoundaryError(f"the {self.argument} {names} depend on each other", "leave out one of them")

    def when(self, latex: Latex) -> str:
        return rf"\text{{at }} t = {latex.first if self.end == 'start' else latex.last}"


class AtEnd(AtStart):
    """Equations and inequalities at the end; equations between bodies there become `couplings` of the model."""

    argument = field = "end_conditions"
    end = "end"
    scope: ClassVar[Scope] = {"end_conditions": (*MOVING, EndValue, *STATIC)}
    remedies: ClassVar[Remedies] = {Time: _DURATION, ControlInput: _CONTROLS}

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """Return a model with conditions on end values of single bodies as couplings, and others for every body.

        Raises BoundaryError for a coupling that is an inequality, ExpressionError for a coupling with a coordinate of
        no particular body.
        """
        values, moving = {value.symbol for value in model.end_values}, {*model.coordinates, *model.rates}
        relations = [entry for entry in entries if entry.role == self.argument]
        couplings = [entry for entry in relations if entry.expression.free_symbols & values]
        for entry in couplings:
            symbols = entry.expression.free_symbols
            if not entry.equality:
                raise BoundaryError(f"{entry.what} couples bodies by an inequality", "couple them by equations only")
            require_single_bodies(entry.what, symbols & values, symbols & moving)
        model = super().added(model, [entry for entry in relations if not entry.expression.free_symbols & values])
        return replace(model, couplings=conditions_of(couplings, self.argument))

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Yield the expressions, with one for all couplings that differ in their bodies alone."""
        yield from super().values(model)
        yield from ((c.name, c.expression) for c in _distinct_couplings(model))

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise an error also for couplings in which the bodies cancel."""
        super().require_regular(model, points)
        for condition in _distinct_couplings(model):
            if is_constant(condition, [value.symbol for value in model.end_values], points):
                raise BoundaryError(
                    f"{self.argument} {condition} couples nothing, since its bodies cancel", "leave it out"
                )


def _distinct_couplings(model: Model) -> list[Condition]:
    indices = distinct([c.expression for c in model.couplings], [value.symbol for value in model.end_values])
    return [model.couplings[index] for index in indices]


@dataclass(frozen=True)
class End:
    """The terms of one end of the time interval; unknowns are given by their names.

    `pins` pair unknowns of the node with prescribed values, and `extra` are unknowns of this end alone. `element` is
    the contribution to the Lagrangian of the optimisation problem; `conditions` are equations for display. `aliases`
    equate an unknown of the node to a linking variable plus an offset. `slacks` pair a slack with its multiplier.
    """

    pins: tuple[tuple[str, Expr], ...] = ()
    extra: tuple[Unknown, ...] = ()
    element: Expr = S.Zero
    conditions: tuple[Equation, ...] = ()
    cost: Expr = S.Zero
    aliases: tuple[tuple[str, str, Expr], ...] = ()
    slacks: tuple[tuple[str, str], ...] = ()
    bounds: tuple[tuple[str, EndBound], ...] = ()

    def __add__(self, other: End) -> End:
        """Return the terms of both."""
        return End(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(End)))


def pinned_at_zero(names: Sequence[str]) -> End:
    """Return an end at which the named unknowns of the node are zero, because they have no meaning there."""
    return End(pins=tuple((name, S.Zero) for name in names))


def conditioned_end(
    conditions: Sequence[Condition],
    cost: Expr,
    substitution: Mapping[Symbol, Expr],
    suffix: str,
    unknowns: set[Symbol],
    names: Names,
    own: Mapping[Symbol, Unknown],
    constants: Collection[Symbol],
) -> End:
    """Impose g = 0 by nu g, and g <= 0 by nu (g + s) with a slack s >= 0; add the terminal cost.

    `substitution` replaces coordinates and rates by symbols or values at this end; `unknowns` are the free symbols. An
    inequality that limits a single unknown in `own` (symbols and unknowns of the node) by `constants` becomes a bound,
    unless an equation determines the unknown. A bound needs no further unknowns of all nodes. Raises BoundaryError for
    a condition on prescribed values.
    """
    values = [condition.expression.subs(substitution, simultaneous=True) for condition in conditions]
    equations = [value for condition, value in zip(conditions, values, strict=True) if condition.equality]
    undecided = {symbol: unknown for symbol, unknown in own.items() if not any(e.has(symbol) for e in equations)}
    terminal = cost.subs(substitution, simultaneous=True)
    out = End(element=terminal, cost=terminal)
    for condition, value in zip(conditions, values, strict=True):
        if not value.free_symbols & unknowns:
            raise BoundaryError(
                f"the condition {condition} at the {'start' if suffix == '_k' else 'end'} is on values that are given "
                "there",
                "leave it out, or leave a value free",
            )
        if not condition.equality and (bound := _as_bound(condition, value, undecided, constants)) is not None:
            has_side = (
                name == bound[0] and (other.lower is None) == (bound[1].lower is None) for name, other in out.bounds
            )
            if not any(has_side):
                out += End(bounds=(bound,))
                continue
        kind = Kind.START_CONDITION if suffix == "_k" else Kind.END_CONDITION
        extra, term, equation = imposed(condition, value, names, kind, suffix)
        slacks = tuple((slack.name, extra[0].name) for slack in extra[1:])
        out += End(extra=extra, element=term, conditions=(equation,), slacks=slacks)
    return out


def with_bounds(unknowns: Sequence[Unknown], model: Model) -> tuple[Unknown, ...]:
    """Return the unknowns, each with the bounds of the quantity of the model that has the same name."""
    bounds = {bound.symbol.name: bound for bound in model.bounds}
    pairs = ((unknown, bounds.get(unknown.name)) for unknown in unknowns)
    return tuple(replace(u, lower=b.lower, upper=b.upper) if b is not None else u for u, b in pairs)


def _as_bound(
    condition: Condition, value: Expr, own: Mapping[Symbol, Unknown], constants: Collection[Symbol]
) -> tuple[str, EndBound] | None:
    """Return the name of the only unknown in value <= 0 with its bound; None for other inequalities."""
    present = value.free_symbols - set(constants)
    if len(present) != 1 or not present <= own.keys():
        return None
    symbol = present.pop()
    slope = value.diff(symbol)
    if not slope.is_number or slope.is_nonzero is not True:
        return None
    limit = expand(symbol - value / slope)
    if limit.has(symbol):
        return None
    unknown, is_upper = own[symbol], bool(slope > 0)
    other = unknown.upper if is_upper else unknown.lower
    if other is not None:
        if not (limit.is_number and other.is_number):
            return None
        limit = Min(limit, other) if is_upper else Max(limit, other)
    return unknown.name, EndBound(None if is_upper else limit, limit if is_upper else None, condition.name)


_SLACKS = {
    Kind.PATH: Kind.PATH_SLACK,
    Kind.BOUND: Kind.BOUND_SLACK,
    Kind.GAP: Kind.GAP_SLACK,
    Kind.FRICTION: Kind.FRICTION_SLACK,
    Kind.COMPLEMENTARITY: Kind.COMPLEMENTARITY_SLACK,
    Kind.START_CONDITION: Kind.START_SLACK,
    Kind.END_CONDITION: Kind.END_SLACK,
    Kind.SWITCH_CONDITION: Kind.SWITCH_SLACK,
}
"""The kind of a slack for each kind of multiplier."""


def imposed(
    condition: Condition, value: Expr, names: Names, kind: Kind, suffix: str, at: float = 0, least: Expr | None = None
) -> tuple[tuple[Unknown, ...], Expr, Equation]:
    """Return the terms that impose g = 0 by y g, or g <= 0 by y (g + s) with a slack s >= `least`.

    `value` is g in the symbols of an interval or end, and `at` its abscissa or the number of the switch. The terms are
    the multiplier with the slack, if any, the product in symbols with the `suffix`, and the equation for display.
    """
    meaning, stem = Meaning(kind, condition.name, at, condition.segment), "y" if kind.place is Place.INTERVAL else "nu"
    unknowns, equation = [Unknown(names.numbered(stem), meaning)], Equation(value, condition=meaning.subject)
    if not condition.equality:
        slack_meaning = replace(meaning, kind=_SLACKS[kind])
        unknowns.append(Unknown(names.numbered("s"), slack_meaning, lower=least))
        equation = replace(equation, slack=unknowns[1].name)
    multiplier, *slack = symbols([unknown.name for unknown in unknowns], suffix)
    return tuple(unknowns), multiplier * sum(slack, value), equation


def indexed(end: End, node: Sequence[Unknown], shared: Sequence[Unknown]) -> EndElement:
    """Return an end with the names of unknowns replaced by indices in the node and among the linking variables."""
    index = {unknown.name: i for i, unknown in enumerate(node)}
    shared_index = {unknown.name: i for i, unknown in enumerate(shared)}
    return EndElement(
        pins=tuple((index[name], value) for name, value in end.pins),
        element=end.element,
        conditions=end.conditions,
        cost=end.cost,
        shared=tuple((index[name], shared_index[other], offset) for name, other, offset in end.aliases),
        slacks=tuple((index[slack], index[multiplier]) for slack, multiplier in end.slacks),
        bounds=tuple((index[name], bound) for name, bound in end.bounds),
    )
