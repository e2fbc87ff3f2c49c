"""Conditions on coordinates and rates at one end, beside values that are given there; at the end, also between bodies.

`transcribe.conditions.ends` imposes them, those between bodies `transcribe.conditions.shared`.

The two ends of the time interval: pins, conditions and unknowns that only an end has.

An unknown of an end is an unknown of every node, for the sake of one layout; x^2/2 in every interval's share makes it
vanish wherever it has no meaning.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import sympy
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
from codegen.discretise.program import EndBound, EndElement, Names, Unknown, symbols
from codegen.errors import BoundaryError
from codegen.problem.bodies import require_single_bodies
from codegen.problem.symbols import ControlInput, EndValue, Time
from codegen.runtime.record import Kind, Meaning
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
        """Equations have to determine something that no value there has fixed already."""
        conditions: tuple[Condition, ...] = self.of_model(model)
        own = tuple(free.symbol for free in model.free_parameters)
        for condition in conditions:
            symbols = (*model.coordinates, *model.rates, *(own if model.bodies == 1 else ()))
            if is_constant(condition, symbols, points):
                raise BoundaryError(
                    f"{self.argument} {condition} depends on no coordinate or rate", "correct it, or leave it out"
                )
        fixed = prescribed(model, self.end)
        unknown = [s for s in (*model.coordinates, *model.rates, *own) if s not in fixed]
        equations = [condition for condition in conditions if condition.equality]
        likely = _with_values(fixed, points)
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
    """Equations and inequalities at the end, and equations there between bodies, which are `couplings` of the model."""

    argument = field = "end_conditions"
    end = "end"
    scope: ClassVar[Scope] = {"end_conditions": (*MOVING, EndValue, *STATIC)}
    remedies: ClassVar[Remedies] = {Time: _DURATION, ControlInput: _CONTROLS}

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """Those with values of single bodies couple these; the others hold for every body by itself.

        Raises BoundaryError for a coupling that is an inequality, ExpressionError for one that does not tell whose
        coordinate it means.
        """
        values, moving = {value.symbol for value in model.end_values}, {*model.coordinates, *model.rates}
        own = [entry for entry in entries if entry.role == self.argument]
        couplings = [entry for entry in own if entry.expression.free_symbols & values]
        for entry in couplings:
            symbols = entry.expression.free_symbols
            if not entry.equality:
                raise BoundaryError(f"{entry.what} couples bodies by an inequality", "couple them by equations only")
            require_single_bodies(entry.what, symbols & values, symbols & moving)
        model = super().added(model, [entry for entry in own if not entry.expression.free_symbols & values])
        return replace(model, couplings=conditions_of(couplings, self.argument))

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Couplings that are alike but for the bodies are tried once."""
        yield from super().values(model)
        yield from ((c.name, c.expression) for c in _distinct(model))

    def require_regular(self, model: Model, points: Points) -> None:
        """Refuse couplings in which bodies cancel, too."""
        super().require_regular(model, points)
        for condition in _distinct(model):
            if is_constant(condition, [value.symbol for value in model.end_values], points):
                raise BoundaryError(
                    f"{self.argument} {condition} couples nothing, since its bodies cancel", "leave it out"
                )


def _distinct(model: Model) -> list[Condition]:
    indices = distinct([c.expression for c in model.couplings], [value.symbol for value in model.end_values])
    return [model.couplings[index] for index in indices]


def _with_values(fixed: Mapping[sympy.Symbol, Expr], points: Points) -> Points:
    """The points with the prescribed values in them, which depend on nothing that the points differ in."""
    numbers = {symbol: expressions.rounded_at(value, points[0]) for symbol, value in fixed.items()}
    known = {symbol: number for symbol, number in numbers.items() if number is not None}
    return [{**point, **known} for point in points]


@dataclass(frozen=True)
class End:
    """One end: pinned unknowns, own unknowns, own share of the Lagrangian, conditions to read, and terminal cost.

    `aliases` equate an unknown of the node to a shared unknown plus an offset; `slacks` pair a slack with its
    multiplier; `bounds` are unknowns with what bounds them there. All unknowns go by their names.
    """

    pins: tuple[tuple[str, Expr], ...] = ()
    extra: tuple[Unknown, ...] = ()
    element: Expr = S.Zero
    conditions: tuple[tuple[str, Expr], ...] = ()
    cost: Expr = S.Zero
    aliases: tuple[tuple[str, str, Expr], ...] = ()
    slacks: tuple[tuple[str, str], ...] = ()
    bounds: tuple[tuple[str, EndBound], ...] = ()

    def __add__(self, other: End) -> End:
        """Both together."""
        return End(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(End)))


def pinned_at_zero(names: Sequence[str]) -> End:
    """An end at which some unknowns of the node have no meaning."""
    return End(pins=tuple((name, S.Zero) for name in names))


def conditioned_end(
    conditions: Sequence[Condition],
    cost: Expr,
    substitution: Mapping[Symbol, Expr],
    suffix: str,
    unknowns: set[Symbol],
    names: Names,
    own: Mapping[Symbol, Unknown],
    known: Collection[Symbol],
) -> End:
    """Impose g = 0 by nu g, and g <= 0 by nu (g + s) with a slack s >= 0; add the terminal cost.

    `substitution` puts the quantities of this end into a condition, `unknowns` are the symbols that are not given
    there. An inequality that bounds one of the node's `own` unknowns by the `known` ones is a bound of it, unless an
    equation says what it is: it costs no unknowns, which all nodes would have. Raises BoundaryError for a condition on
    what is given.
    """
    values = [condition.expression.subs(substitution, simultaneous=True) for condition in conditions]
    equations = [value for condition, value in zip(conditions, values, strict=True) if condition.equality]
    undecided = {symbol: unknown for symbol, unknown in own.items() if not any(e.has(symbol) for e in equations)}
    out = End(element=cost.subs(substitution, simultaneous=True), cost=cost.subs(substitution, simultaneous=True))
    for condition, value in zip(conditions, values, strict=True):
        if not value.free_symbols & unknowns:
            raise BoundaryError(
                f"the condition {condition} at the {_where(suffix)} is on values that are given there",
                "leave it out, or leave a value free",
            )
        bound = None if condition.equality else _as_bound(condition, value, undecided, known)
        if bound is not None and not _is_repeated(bound, out.bounds):
            out += End(bounds=(bound,))
            continue
        kind = Kind.START_CONDITION if suffix == "_k" else Kind.END_CONDITION
        extra, term, equation = imposed(condition, value, Imposed("nu", kind, suffix), names)
        slacks = tuple((slack.name, extra[0].name) for slack in extra[1:])
        out += End(extra=extra, element=term, conditions=(equation,), slacks=slacks)
    return out


def with_bounds(unknowns: Sequence[Unknown], model: Model) -> tuple[Unknown, ...]:
    """Give unknowns the bounds of the quantity that they stand for."""
    bounds = {bound.symbol.name: bound for bound in model.bounds}
    return tuple(
        replace(unknown, lower=bounds[unknown.name].lower, upper=bounds[unknown.name].upper)
        if unknown.name in bounds
        else unknown
        for unknown in unknowns
    )


def _as_bound(
    condition: Condition, value: Expr, own: Mapping[Symbol, Unknown], known: Collection[Symbol]
) -> tuple[str, EndBound] | None:
    """The name of the one unknown in value <= 0, and its bound; None if it is none, or another one may be tighter."""
    found = value.free_symbols - set(known)
    if len(found) != 1 or not found <= own.keys():
        return None
    symbol = found.pop()
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


def _is_repeated(found: tuple[str, EndBound], before: Sequence[tuple[str, EndBound]]) -> bool:
    """Whether an unknown has a bound on the same side already."""
    name, bound = found
    return any(name == other and (bound.lower is None) == (first.lower is None) for other, first in before)


@dataclass(frozen=True)
class Imposed:
    """How a condition is imposed: stem and kind of the multiplier, suffix of symbols, abscissa or number of switch."""

    stem: str
    kind: Kind
    suffix: str
    at: float = 0


_SLACKS = {
    Kind.PATH: Kind.PATH_SLACK,
    Kind.BOUND: Kind.BOUND_SLACK,
    Kind.START_CONDITION: Kind.START_SLACK,
    Kind.END_CONDITION: Kind.END_SLACK,
    Kind.SWITCH_CONDITION: Kind.SWITCH_SLACK,
}
"""The kinds of slacks, by those of multipliers."""


def imposed(
    condition: Condition, value: Expr, how: Imposed, names: Names, least: Expr | None = None
) -> tuple[tuple[Unknown, ...], Expr, tuple[str, Expr]]:
    """A value g that vanishes by y g, or g <= 0 by y (g + s) with a slack s that is not below `least`.

    Return the multiplier and the slack, the share of l, and the equation to read.
    """
    meaning = Meaning(how.kind, condition.name, how.at, condition.segment)
    unknowns, left_side = [Unknown(names.numbered(how.stem), meaning)], "0"
    if not condition.equality:
        slack_meaning = replace(meaning, kind=_SLACKS[how.kind])
        unknowns.append(Unknown(names.numbered("s"), slack_meaning, lower=least))
        left_side = f"-{unknowns[1].name}"
    multiplier, *slack = symbols([unknown.name for unknown in unknowns], how.suffix)
    return tuple(unknowns), multiplier * sum(slack, value), (f"{left_side} ({meaning.subject})", value)


def _where(suffix: str) -> str:
    return "start" if suffix == "_k" else "end"


@dataclass(frozen=True)
class Ends:
    """Both ends, whose own unknowns become unknowns of every node, with value zero wherever they have no meaning."""

    start: End
    end: End

    @property
    def extra(self) -> tuple[Unknown, ...]:
        """The own unknowns of both ends, each name once."""
        named = {unknown.name: unknown for unknown in (*self.start.extra, *self.end.extra)}
        return tuple(named.values())

    def symbols(self, suffix: str) -> tuple[Symbol, ...]:
        """Their symbols at a node."""
        return symbols([unknown.name for unknown in self.extra], suffix)

    def filling(self) -> Expr:
        """A share of every interval's l that makes the end's unknowns vanish at its left node."""
        return sum((symbol**2 / 2 for symbol in self.symbols("_k")), S.Zero)

    def start_element(self, node: Sequence[Unknown], shared: Sequence[Unknown]) -> EndElement:
        """The start's share, with the filling of its own unknowns taken back; those of the end are pinned."""
        own = {unknown.name for unknown in self.start.extra}
        filling = sum((symbol**2 / 2 for symbol in symbols(sorted(own), "_k")), S.Zero)
        foreign = [unknown.name for unknown in self.extra if unknown.name not in own]
        return _element(self.start + pinned_at_zero(foreign) + End(element=-filling), node, shared)

    def end_element(self, node: Sequence[Unknown], shared: Sequence[Unknown], idle: Sequence[str]) -> EndElement:
        """The end's share; unknowns of the start and `idle` ones, which nothing depends on, are pinned."""
        own = {unknown.name for unknown in self.end.extra}
        foreign = [unknown.name for unknown in self.extra if unknown.name not in own]
        return _element(self.end + pinned_at_zero([*foreign, *idle]), node, shared)


def _element(end: End, node: Sequence[Unknown], shared: Sequence[Unknown]) -> EndElement:
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
