"""Conditions that hold at every time, on the intervals and at the nodes.

Where rates or controls occur, a condition holds at the points at which the scheme evaluates cost and dynamics. The
contribution l of the interval to the Lagrangian of the optimisation problem gains y g for g = 0, and y (g + s) with a
slack s >= 0 for g <= 0. Both y and s are unknowns of the interval.

A condition on coordinates and time alone holds at the nodes. An inequality is imposed at the right node of each
interval, and at the start unless the coordinates are fixed there. It is also imposed where the scheme evaluates cost
and dynamics. Otherwise nodes could alternate between two sides of a forbidden region, with the middle of every interval
inside it, where the cost is less. On a straight line between two nodes a convex condition follows from the nodes.
A bound of a state holds at the nodes, and where an implicit scheme evaluates the dynamics inside the interval: the
rate of a reaction may change sign beyond it. A stage that is an unknown has the bound itself. A value between two
bounded values needs no bound. Other values, as on a polynomial, are limited by an inequality with a slack. Stages of
explicit schemes follow from the nodes with less accuracy than the step, and have no bounds.

An equality has its multiplier on the node, and l gains (y_k g_k + y_k1 g_k1)/2. An end where the coordinates are fixed
has no multiplier: a condition on fixed numbers has no derivative, and the KKT matrix would be singular.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import ClassVar

import sympy
from sympy import Expr, Rational, S, Symbol

from codegen.discretise.conditions.base import ConditionKind, Latex, Points, Scope, dependent, is_constant
from codegen.discretise.conditions.ends import imposed
from codegen.discretise.interval import STEP, PathValue, StateValue, at_nodes
from codegen.discretise.model.definitions import Boundary, Condition, Model
from codegen.discretise.model.relations import MOVING, STATIC
from codegen.discretise.program import (
    Equation,
    HoldingForces,
    Names,
    Unknown,
    is_invariant_under_shifts,
    occurring,
    symbols,
)
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
        """Raise an error for conditions without coordinates, rates and controls, and for dependent equations."""
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
    """Return True if neither rates nor controls occur in a condition."""
    return not condition.expression.free_symbols & {*model.rates, *model.controls}


def nodal_conditions(model: Model, equality: bool) -> tuple[Condition, ...]:
    """Return the path equalities, or the path inequalities, in which neither rates nor controls occur."""
    return tuple(g for g in model.path if is_nodal(model, g) and g.equality == equality)


YIELDING = Rational(1, 10**8)
"""Tolerated violation at nodes of inequalities that also hold inside intervals.

Where a motion rests on a curved limit, both inequalities are active, and multipliers are not unique. The quadrature
evaluates the cost inside the intervals. With multipliers there, and none at nodes, the Hessian of the Lagrangian has
the inertia of a minimum.
"""


@dataclass(frozen=True)
class IntervalTerms:
    """The path conditions of an interval: their unknowns, and their contribution `element` to the Lagrangian.

    Each inequality has a slack. `slack_multipliers` are the indices of the multipliers of these equations.
    """

    multipliers: tuple[Unknown, ...]
    slacks: tuple[Unknown, ...]
    slack_multipliers: tuple[int, ...]
    inequalities: tuple[PathValue, ...]
    element: Expr
    equations: tuple[Equation, ...]


@dataclass(frozen=True)
class NodalTerms:
    """Unknowns of every node, their contribution to an interval, and names of unknowns that are zero at an end.

    The indices of `holding` are those in `unknowns`.
    """

    unknowns: tuple[Unknown, ...] = ()
    element: Expr = S.Zero
    start_pins: tuple[str, ...] = ()
    end_pins: tuple[str, ...] = ()
    equations: tuple[Equation, ...] = ()
    holding: tuple[HoldingForces, ...] = ()

    def __add__(self, other: NodalTerms) -> NodalTerms:
        """Return the terms of both."""
        return NodalTerms(*(getattr(self, part.name) + getattr(other, part.name) for part in fields(NodalTerms)))


def with_inner_path(model: Model) -> Model:
    """Return the model with only the path conditions inside intervals: all but equalities on coordinates."""
    return replace(model, path=tuple(g for g in model.path if not (is_nodal(model, g) and g.equality)))


def start_inequalities(model: Model) -> tuple[Condition, ...]:
    """Return the path inequalities that are imposed at the start.

    Inequalities are left out if all their coordinates are fixed there, or equal those of another node: of the end of a
    periodic motion, or of the end of the segment before.
    """
    inequalities = ((g, g.expression) for g in nodal_conditions(model, equality=False))
    return tuple(
        g
        for g, expression in inequalities
        if not _fixed_at(model, model.start, expression)
        and not _repeats_start(model, expression)
        and not _repeats_segment(model, expression)
    )


def bounded_stages(model: Model, inside: Sequence[StateValue], stages: Sequence[Unknown]) -> tuple[Unknown, ...]:
    """Return the unknowns `stages` of an interval, each with the bounds of the state whose value it is."""
    quantities = {v.value.name: v.quantity for v in inside if isinstance(v.value, Symbol)}
    bounds = {bound.symbol: bound for bound in model.bounds}
    pairs = ((unknown, bounds.get(quantities.get(unknown.name))) for unknown in stages)
    return tuple(replace(u, lower=b.lower, upper=b.upper) if b else u for u, b in pairs)


def stage_inequalities(model: Model, inside: Sequence[StateValue]) -> tuple[PathValue, ...]:
    """Return the bounds of states inside intervals that do not follow from the bounds of unknowns.

    `inside` are the values at evaluations of the dynamics. Raises ExpressionError for bounds that depend on the body.
    """
    bounds, values = {bound.symbol: bound for bound in model.bounds}, list[PathValue]()
    for state in inside:
        bound = bounds.get(state.quantity)
        if bound is None or isinstance(state.value, Symbol):
            continue
        bounded = {v.value for v in inside if v.quantity == state.quantity and isinstance(v.value, Symbol)}
        bounded |= {x for suffix in ("_k", "_k1") for x in at_nodes([state.quantity], suffix)}
        present = state.value.free_symbols
        if present <= bounded and all(sympy.diff(state.value, x).is_nonnegative for x in present):
            continue
        for condition in bound.conditions:
            if model.body is not None and condition.expression.has(model.body):
                raise ExpressionError(
                    f"a bound on {bound.symbol} depends on the body's number, and the scheme has no unknown with it "
                    "where the dynamics are evaluated",
                    "give every body the same bound, or use scheme midpoint",
                )
            value = condition.expression.xreplace({state.quantity: state.value})
            values.append(PathValue(condition, state.abscissa, value, Kind.BOUND))
    return tuple(values)


def interval_terms(model: Model, inner: Sequence[PathValue], first: int, names: Names) -> IntervalTerms:
    """Return the terms of all path conditions inside an interval and at its right node.

    Values in `inner` that follow from the nodes are left out. `first` counts the unknowns before the multipliers.
    """
    nodal = nodal_conditions(model, equality=False)
    values = [
        v for v in inner if v.kind is not Kind.PATH or v.condition not in nodal or not _follows_from_nodes(model, v)
    ]
    values += [PathValue(g, S.One, _at_node(model, g, S.One)) for g in nodal]
    multipliers, slacks, indices, equations = list[Unknown](), list[Unknown](), list[int](), list[Equation]()
    element: Expr = S.Zero
    for value in values:
        condition, kind = value.condition, value.kind
        others = {(other.condition, other.kind) for other in values if other.abscissa != value.abscissa}
        yields = (condition, kind) in others
        least = -YIELDING if yields and value.value == _at_node(model, condition, S.One) else S.Zero
        (multiplier, *slack), term, equation = imposed(
            condition, value.value, names, kind, "_k", float(value.abscissa), least
        )
        multipliers.append(multiplier)
        slacks += slack
        indices += [first + len(multipliers) - 1] * len(slack)
        element += term
        equations.append(equation)
    inequalities = tuple(value for value in values if not value.condition.equality)
    return IntervalTerms(tuple(multipliers), tuple(slacks), tuple(indices), inequalities, element, tuple(equations))


def _follows_from_nodes(model: Model, value: PathValue) -> bool:
    """Return True if a value equals the value at a node, or if its condition is convex on the line between nodes."""
    if value.value in [_at_node(model, value.condition, abscissa) for abscissa in (S.Zero, S.One)]:
        return True
    along = {model.time, STEP, *model.parameters, *(free.symbol for free in model.free_parameters)}
    along |= {q for suffix in ("_k", "_k1") for q in at_nodes(model.coordinates, suffix)}
    return value.value.free_symbols <= along and is_convex(model, value.condition)


def _at_node(model: Model, condition: Condition, abscissa: Expr) -> Expr:
    """Return the value of a condition on coordinates at the left (0) or right (1) node of an interval."""
    values: dict[Symbol, Expr] = dict(
        zip(model.coordinates, at_nodes(model.coordinates, "_k1" if abscissa else "_k"), strict=True)
    )
    values[model.time] = model.time + abscissa * STEP
    return condition.expression.subs(values, simultaneous=True)


def is_convex(model: Model, condition: Condition) -> bool:
    """Return True if constant second derivatives prove that a condition is convex in coordinates and rates."""
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
    """Return the terms that impose equalities on coordinates at every node, with multipliers `<stem>_<number>`.

    A multiplier is zero at an end where every coordinate of its condition is fixed. A multiplier is also zero where the
    condition repeats another condition. This is the end of a motion that is periodic in all of the coordinates, and the
    start of a segment that follows another segment.
    """
    unknowns, start_pins, end_pins, element = list[Unknown](), list[str](), list[str](), S.Zero
    equations = list[Equation]()
    for condition in conditions:
        name = names.numbered(stem)
        unknowns.append(Unknown(name, Meaning(kind, condition.name, segment=condition.segment)))
        equations.append(Equation(condition.expression, condition=unknowns[-1].meaning.subject, at_nodes=True))
        for suffix, abscissa in (("_k", S.Zero), ("_k1", S.One)):
            element += symbols([name], suffix)[0] * _at_node(model, condition, abscissa) / 2
        assert model.end is not None, "a control problem has an end"
        if _fixed_at(model, model.start, condition.expression) or _repeats_segment(model, condition.expression):
            start_pins.append(name)
        if _fixed_at(model, model.end, condition.expression) or _repeats_start(model, condition.expression):
            end_pins.append(name)
    return NodalTerms(tuple(unknowns), element, tuple(start_pins), tuple(end_pins), tuple(equations))


def _fixed_at(model: Model, boundary: Boundary, expression: Expr) -> bool:
    """Return True if an end fixes all coordinates in an expression, and no free parameter occurs."""
    free = {parameter.symbol for parameter in model.free_parameters}
    indices = occurring(model.coordinates, expression)
    return not expression.free_symbols & free and all(boundary.positions[i] is not None for i in indices)


def _repeats_segment(model: Model, expression: Expr) -> bool:
    """Return True if all coordinates in an expression start where another segment of the motion ends."""
    joined = {first for _, first in model.joined}
    present = [model.coordinates[i] for i in occurring(model.coordinates, expression)]
    return bool(present) and all(q in joined for q in present)


def _repeats_start(model: Model, expression: Expr) -> bool:
    """Return True if periodicity gives an expression in coordinates the same value at both ends."""
    shifts = dict(model.periodic)
    present = [model.coordinates[i] for i in occurring(model.coordinates, expression)]
    periodic = bool(present) and all(q in shifts for q in present) and not expression.has(model.time)
    return periodic and is_invariant_under_shifts(expression, {q: shifts[q] for q in present})
