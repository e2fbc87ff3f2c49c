"""Conditions that hold at every time; `transcribe.conditions.path_conditions` imposes them.

Conditions that hold at every time, on the intervals and at the nodes.

Where rates or controls occur, a condition holds at the points at which the scheme evaluates cost and dynamics:
l gains y g for g = 0, and y (g + s) with a slack s >= 0 for g <= 0, both y and s being unknowns of the interval.

A condition on coordinates and time alone holds at the nodes. An inequality is imposed at the right node of each
interval, at the start unless the coordinates are given there, and where the scheme evaluates cost and dynamics as well.
Otherwise nodes could alternate between two sides of a forbidden region, and the middle of every interval would lie
inside it, where the cost is less. Between two nodes on a straight line it follows from theirs if it is convex.
A bound of a state holds at the nodes, and where an implicit scheme evaluates the dynamics inside the interval: kinetics
may have another sign beyond it. A stage that is an unknown has the bound itself, and between two values with bounds it
follows; elsewhere, as on a polynomial, it is an inequality with a slack. Stages of explicit schemes follow from the
nodes with less accuracy than the step, and have no bounds (`solutions.stages` looks at them).

An equality has its multiplier on the node, and l gains (y_k g_k + y_k1 g_k1)/2, because then each end can do without it
where the coordinates are given (a condition on given numbers has no derivative, and the KKT matrix would be singular).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import sympy
from sympy import Expr, Rational, S, Symbol

from codegen.discretise.conditions.base import ConditionKind, Latex, Points, Scope, dependent, is_constant
from codegen.discretise.conditions.ends import Imposed, imposed
from codegen.discretise.interval import STEP, PathValue, StateValue, at_nodes
from codegen.discretise.model.definitions import Boundary, Condition, Model
from codegen.discretise.model.relations import MOVING, STATIC
from codegen.discretise.program import Names, Unknown, is_invariant_under_shifts, occurring, symbols
from codegen.errors import DegenerateError, ExpressionError
from codegen.problem.symbols import ControlInput, Delayed, Time
from codegen.runtime.record import Kind, Meaning


class Path(ConditionKind):
    """Equations and inequalities between coordinates, rates, controls, time and parameters."""

    argument, field, words = "path", "path", "path conditions"
    scope: ClassVar[Scope] = {"path": (*MOVING, Delayed, ControlInput, Time, *STATIC)}

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        yield from model.path

    def require_regular(self, model: Model, points: Points) -> None:
        """Refuse conditions on nothing that moves, and equations that follow from each other."""
        symbols = (*model.coordinates, *model.rates, *model.controls)
        for condition in model.path:
            if is_constant(condition, symbols, points):
                raise ExpressionError(
                    f"path {condition} depends on no coordinate, rate or control",
                    "limit free parameters and the duration by bounds, or leave it out",
                )
        names = dependent([c for c in model.path if c.equality], symbols, points)
        if names:
            raise DegenerateError(f"the path conditions {names} depend on each other", "leave out one of them")

    def sentences(self, model: Model) -> list[str]:
        nodal = {True: "at the nodes", False: "at the nodes and on the intervals"}
        return [f"{c.name} {nodal[c.equality] if is_nodal(model, c) else 'on the intervals'}" for c in model.path]

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        if equations := tuple(("0", c.expression) for c in model.path if c.equality):
            yield "At every time", equations
        if inequalities := tuple((f"g_{i}", c.expression) for i, c in enumerate(model.path, 1) if not c.equality):
            yield "At every time, not positive", inequalities

    def when(self, latex: Latex) -> str:
        return r"\text{at every time}"


def is_nodal(model: Model, condition: Condition) -> bool:
    """Whether neither rates nor controls occur in a condition."""
    return not condition.expression.free_symbols & {*model.rates, *model.controls}


def nodal_conditions(model: Model, equality: bool) -> tuple[Condition, ...]:
    """The path equalities, or the path inequalities, in which neither rates nor controls occur."""
    return tuple(g for g in model.path if is_nodal(model, g) and g.equality == equality)


YIELDING = Rational(1, 10**8)
"""By how much nodes may violate what holds inside intervals as well.

Where a motion rests on a curved limit, both are met, and multipliers are not unique. The cost has its weight inside the
intervals: with multipliers there, and none at nodes, the Hessian of the Lagrangian is that of a minimum.
"""


@dataclass(frozen=True)
class IntervalTerms:
    """Path conditions on one interval: multipliers, slacks with the indices of their multipliers, and their share of l.

    `inequalities` are the values to which the slacks belong.
    """

    multipliers: tuple[Unknown, ...]
    slacks: tuple[Unknown, ...]
    slack_multipliers: tuple[int, ...]
    inequalities: tuple[PathValue, ...]
    element: Expr
    equations: tuple[tuple[str, Expr], ...]


@dataclass(frozen=True)
class NodalTerms:
    """Unknowns of every node, their share of l, and which of them have no meaning at the start and at the end."""

    unknowns: tuple[Unknown, ...] = ()
    element: Expr = S.Zero
    start_pins: tuple[str, ...] = ()
    end_pins: tuple[str, ...] = ()
    equations: tuple[tuple[str, Expr], ...] = ()

    def __add__(self, other: NodalTerms) -> NodalTerms:
        """Both together."""
        return NodalTerms(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(NodalTerms)))


def with_inner_path(model: Model) -> Model:
    """The model with those path conditions only that hold inside an interval: all but equalities on coordinates."""
    return replace(model, path=tuple(g for g in model.path if not (is_nodal(model, g) and g.equality)))


def start_inequalities(model: Model) -> tuple[Condition, ...]:
    """Path inequalities on coordinates at a start that is not given, nor also an end; right nodes leave it out."""
    return tuple(
        g
        for g in nodal_conditions(model, equality=False)
        if not (given_at(model, model.start, g.expression) or _is_repeated(model, g.expression))
    )


def bounded_stages(model: Model, inside: Sequence[StateValue], stages: Sequence[Unknown]) -> tuple[Unknown, ...]:
    """Unknowns of an interval with the bounds of the states whose values they are."""
    quantities = {v.value.name: v.quantity for v in inside if isinstance(v.value, Symbol)}
    bounds = {bound.symbol: bound for bound in model.bounds}
    found = ((unknown, bounds.get(quantities.get(unknown.name))) for unknown in stages)
    return tuple(replace(u, lower=b.lower, upper=b.upper) if b else u for u, b in found)


def stage_inequalities(model: Model, inside: Sequence[StateValue]) -> tuple[PathValue, ...]:
    """The bounds of states where dynamics are evaluated, as far as they do not follow from the bounds of unknowns.

    Raises ExpressionError for a bound that differs from body to body.
    """
    bounds, values = {bound.symbol: bound for bound in model.bounds}, list[PathValue]()
    for state in inside:
        bound = bounds.get(state.quantity)
        if bound is None or isinstance(state.value, Symbol):
            continue
        own = {v.value for v in inside if v.quantity == state.quantity and isinstance(v.value, Symbol)}
        own |= {x for suffix in ("_k", "_k1") for x in at_nodes([state.quantity], suffix)}
        present = state.value.free_symbols
        if present <= own and all(sympy.diff(state.value, x).is_nonnegative for x in present):
            continue
        for condition in bound.conditions:
            if model.body is not None and condition.expression.has(model.body):
                raise ExpressionError(
                    f"a bound on {bound.symbol} depends on the body's number, and the scheme has no unknown with it "
                    "where the dynamics are evaluated",
                    "give every body the same bound, or use scheme midpoint",
                )
            value = condition.expression.xreplace({state.quantity: state.value})
            values.append(PathValue(condition, state.abscissa, value, is_bound=True))
    return tuple(values)


def interval_terms(model: Model, inner: Sequence[PathValue], first: int, names: Names) -> IntervalTerms:
    """Multipliers and slacks of all conditions of an interval; `first` unknowns of the interval come before them."""
    values = _imposed(model, inner)
    multipliers, slacks, indices, equations = list[Unknown](), list[Unknown](), list[int](), list[tuple[str, Expr]]()
    element: Expr = S.Zero
    for value in values:
        condition, kind = value.condition, Kind.BOUND if value.is_bound else Kind.PATH
        others = {(other.condition, other.is_bound) for other in values if other.abscissa != value.abscissa}
        yields = (condition, value.is_bound) in others
        least = -YIELDING if yields and value.value == _at_node(model, condition, S.One) else S.Zero
        (multiplier, *slack), term, equation = imposed(
            condition, value.value, Imposed("y", kind, "_k", float(value.abscissa)), names, least
        )
        multipliers.append(multiplier)
        slacks += slack
        indices += [first + len(multipliers) - 1] * len(slack)
        element += term
        equations.append(equation)
    inequalities = tuple(value for value in values if not value.condition.equality)
    return IntervalTerms(tuple(multipliers), tuple(slacks), tuple(indices), inequalities, element, tuple(equations))


def _imposed(model: Model, inner: Sequence[PathValue]) -> list[PathValue]:
    """The values inside an interval and at its right node, without those that follow from values at nodes."""
    nodal = nodal_conditions(model, equality=False)
    values = [v for v in inner if v.is_bound or v.condition not in nodal or not _follows_from_nodes(model, v)]
    return [*values, *(PathValue(g, S.One, _at_node(model, g, S.One)) for g in nodal)]


def _follows_from_nodes(model: Model, value: PathValue) -> bool:
    """Whether a value is that of a node, or on the straight line between two nodes with a convex condition."""
    if value.value in [_at_node(model, value.condition, abscissa) for abscissa in (S.Zero, S.One)]:
        return True
    along = {model.time, STEP, *model.parameters, *(free.symbol for free in model.free_parameters)}
    along |= {q for suffix in ("_k", "_k1") for q in at_nodes(model.coordinates, suffix)}
    return value.value.free_symbols <= along and is_convex(model, value.condition)


def _at_node(model: Model, condition: Condition, abscissa: Expr) -> Expr:
    """The value of a condition on coordinates at the left (0) or right (1) node of an interval."""
    values: dict[Symbol, Expr] = dict(
        zip(model.coordinates, at_nodes(model.coordinates, "_k1" if abscissa else "_k"), strict=True)
    )
    values[model.time] = model.time + abscissa * STEP
    return condition.expression.subs(values, simultaneous=True)


def is_convex(model: Model, condition: Condition) -> bool:
    """Whether a condition is proved to be convex in the quantities of nodes: its second derivatives are numbers."""
    quantities = (*model.coordinates, *model.rates)
    present = [quantities[i] for i in sorted(occurring(quantities, condition.expression))]
    if not present:
        return True
    curvature = sympy.hessian(condition.expression, present).applyfunc(sympy.expand)
    if curvature.free_symbols or not all(entry.is_rational for entry in curvature):
        return False
    return bool(curvature.is_positive_semidefinite)


def nodal_equalities(
    model: Model, conditions: Sequence[Condition], stem: str, names: Names, kind: Kind = Kind.NODAL
) -> NodalTerms:
    """Impose conditions on coordinates and time at every node by multipliers `<stem>_<number>` of a kind.

    A multiplier is pinned at an end where every coordinate of its condition is given, and at the end of a motion that
    is periodic in all of them, where the condition at the start says the same, or at the start of a segment that
    follows another one.
    """
    unknowns, start_pins, end_pins, element = list[Unknown](), list[str](), list[str](), S.Zero
    equations = list[tuple[str, Expr]]()
    for condition in conditions:
        name = names.numbered(stem)
        unknowns.append(Unknown(name, Meaning(kind, condition.name, segment=condition.segment)))
        equations.append((f"0 at every node ({unknowns[-1].meaning.subject})", condition.expression))
        for suffix, abscissa in (("_k", S.Zero), ("_k1", S.One)):
            element += symbols([name], suffix)[0] * _at_node(model, condition, abscissa) / 2
        assert model.end is not None, "a control problem has an end"
        if given_at(model, model.start, condition.expression) or is_repeated_at_start(model, condition.expression):
            start_pins.append(name)
        if given_at(model, model.end, condition.expression) or repeated_at_end(model, condition.expression):
            end_pins.append(name)
    return NodalTerms(tuple(unknowns), element, tuple(start_pins), tuple(end_pins), tuple(equations))


def given_at(model: Model, boundary: Boundary, expression: Expr) -> bool:
    """Whether an end gives all that an expression in coordinates depends on."""
    free = {parameter.symbol for parameter in model.free_parameters}
    indices = occurring(model.coordinates, expression)
    return not expression.free_symbols & free and all(boundary.positions[i] is not None for i in indices)


def is_repeated_at_start(model: Model, expression: Expr) -> bool:
    """Whether an expression in coordinates is at the start what that of the segment before is at the end."""
    joined = {first for _, first in model.joined}
    present = [model.coordinates[i] for i in occurring(model.coordinates, expression)]
    return bool(present) and all(q in joined for q in present)


def _is_repeated(model: Model, expression: Expr) -> bool:
    return repeated_at_end(model, expression) or is_repeated_at_start(model, expression)


def repeated_at_end(model: Model, expression: Expr) -> bool:
    """Whether an expression in coordinates must have the same value at the end as at the start, by periodicity."""
    shifts = dict(model.periodic)
    present = [model.coordinates[i] for i in occurring(model.coordinates, expression)]
    periodic = bool(present) and all(q in shifts for q in present) and not expression.has(model.time)
    return periodic and is_invariant_under_shifts(expression, {q: shifts[q] for q in present})
