"""Conditions that hold at every time, on the intervals and at the nodes.

Where rates or controls occur, a condition holds at the points at which the scheme evaluates the dynamics:
l gains y g for g = 0, and y (g + s) with a slack s >= 0 for g <= 0, both y and s being unknowns of the interval.

A condition on coordinates and time alone holds at the nodes. An inequality is imposed at the right node of each
interval, and at the start unless the coordinates are given there. An equality has its multiplier on the node, and l
gains (y_k g_k + y_k1 g_k1)/2, because then each end can do without it where the coordinates are given (a condition on
given numbers has no derivative, and the KKT matrix would be singular).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sympy import Expr, S, Symbol

from codegen.discretise import STEP, PathValue, at_nodes
from codegen.model import Boundary, Condition, Model
from codegen.transcribe.forms import occurring, same_after
from codegen.transcribe.names import Names, symbols
from codegen.transcribe.program import Unknown


@dataclass(frozen=True)
class IntervalTerms:
    """Path conditions on one interval: multipliers, slacks with the place of their multiplier, and their share of l."""

    multipliers: tuple[Unknown, ...]
    slacks: tuple[Unknown, ...]
    slack_multipliers: tuple[int, ...]
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


def with_inner_path(model: Model) -> Model:
    """The model with those path conditions only that hold inside an interval: rates or controls occur in them."""
    return replace(model, path=tuple(g for g in model.path if not _nodal(model, g)))


def nodal_conditions(model: Model, equality: bool) -> tuple[Condition, ...]:
    """The path equalities, or the path inequalities, in which neither rates nor controls occur."""
    return tuple(g for g in model.path if _nodal(model, g) and g.equality == equality)


def _nodal(model: Model, condition: Condition) -> bool:
    return not condition.expression.free_symbols & {*model.rates, *model.controls}


def start_inequalities(model: Model) -> tuple[Condition, ...]:
    """Path inequalities on coordinates at a start that is neither given nor periodic; the right nodes leave it out."""
    return tuple(
        g
        for g in nodal_conditions(model, equality=False)
        if not (given_at(model, model.start, g.expression) or repeated_at_end(model, g.expression))
    )


def interval_terms(model: Model, inner: Sequence[PathValue], first: int, names: Names) -> IntervalTerms:
    """Multipliers and slacks of all conditions of an interval; `first` unknowns of the interval come before them."""
    right = dict(zip(model.coordinates, at_nodes(model.coordinates, "_k1"), strict=True))
    right[model.time] = model.time + STEP
    values = [
        *inner,
        *(
            PathValue(g, S.One, g.expression.subs(right, simultaneous=True))
            for g in nodal_conditions(model, equality=False)
        ),
    ]
    multipliers, slacks, places, equations = list[Unknown](), list[Unknown](), list[int](), list[tuple[str, Expr]]()
    element: Expr = S.Zero
    for value in values:
        condition = value.condition
        where = f"{condition.name} at {value.place} of an interval"
        multipliers.append(Unknown(names.numbered("y"), f"multiplier of {where}", True))
        (y,) = symbols([multipliers[-1].name], "_k")
        term, left_side = value.value, "0"
        if not condition.equality:
            slacks.append(Unknown(names.numbered("s"), f"slack of {where}", lower=S.Zero))
            places.append(first + len(multipliers) - 1)
            (s,) = symbols([slacks[-1].name], "_k")
            term += s
            left_side = f"-{slacks[-1].name}"
        element += y * term
        equations.append((f"{left_side} ({condition.name})", value.value))
    return IntervalTerms(tuple(multipliers), tuple(slacks), tuple(places), element, tuple(equations))


def nodal_equalities(model: Model, conditions: Sequence[Condition], stem: str, names: Names) -> NodalTerms:
    """Impose conditions on coordinates and time at every node by multipliers `<stem>_<number>`.

    A multiplier is pinned at an end where every coordinate of its condition is given, and at the end of a motion that
    is periodic in all of them, where the condition at the start says the same.
    """
    unknowns, start_pins, end_pins, element = list[Unknown](), list[str](), list[str](), S.Zero
    for condition in conditions:
        name = names.numbered(stem)
        unknowns.append(Unknown(name, f"multiplier of {condition.name}", True))
        for suffix, instant in (("_k", model.time), ("_k1", model.time + STEP)):
            place: dict[Symbol, Expr] = dict(zip(model.coordinates, at_nodes(model.coordinates, suffix), strict=True))
            place[model.time] = instant
            element += symbols([name], suffix)[0] * condition.expression.subs(place, simultaneous=True) / 2
        assert model.end is not None, "a control problem has an end"
        if given_at(model, model.start, condition.expression):
            start_pins.append(name)
        if given_at(model, model.end, condition.expression) or repeated_at_end(model, condition.expression):
            end_pins.append(name)
    equations = tuple((f"0 at every node ({condition.name})", condition.expression) for condition in conditions)
    return NodalTerms(tuple(unknowns), element, tuple(start_pins), tuple(end_pins), equations)


def given_at(model: Model, boundary: Boundary, expression: Expr) -> bool:
    """Whether an end gives all that an expression in coordinates depends on."""
    free = {parameter.symbol for parameter in model.free_parameters}
    places = occurring(model.coordinates, expression)
    return not expression.free_symbols & free and all(boundary.positions[i] is not None for i in places)


def repeated_at_end(model: Model, expression: Expr) -> bool:
    """Whether an expression in coordinates must have the same value at the end as at the start, by periodicity."""
    shifts = dict(model.periodic)
    present = [model.coordinates[i] for i in occurring(model.coordinates, expression)]
    periodic = bool(present) and all(q in shifts for q in present) and not expression.has(model.time)
    return periodic and same_after(expression, {q: shifts[q] for q in present})
