"""The two ends of the time interval: pins, conditions and unknowns that only an end has.

An unknown of an end is an unknown of every node, for the sake of one layout; x^2/2 in every interval's share makes it
vanish wherever it has no meaning.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace

from sympy import Expr, Max, Min, S, Symbol, expand

from codegen.errors import BoundaryError
from codegen.model import Condition, Model
from codegen.runtime.record import Kind, Meaning
from codegen.transcribe.names import Names, symbols
from codegen.transcribe.program import EndBound, EndElement, Unknown


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
