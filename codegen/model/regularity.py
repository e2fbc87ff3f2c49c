"""Checks of rank: what has to have full rank for a motion to be determined, and not more than determined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy

from codegen.errors import BoundaryError, DegenerateError, ExpressionError
from codegen.expressions import checks as expressions
from codegen.expressions.samples import hessian_samples
from codegen.expressions.terms import distinct
from codegen.model.definitions import Condition, Model
from codegen.model.relations import text
from codegen.model.trials import trial_points
from codegen.model.values import prescribed

Points = Sequence[Mapping[sympy.Symbol, float]]


def require_regular(model: Model) -> None:
    """Refuse a degenerate Lagrangian, and conditions that say nothing or follow from each other."""
    points = trial_points(model)
    _require_regular_lagrangian(model, points)
    _require_independent_constraints(model, points)
    _require_effective_path(model, points)
    for end in ("start", "end"):
        _require_independent_conditions(model, end, points)
    _require_effective_couplings(model, points)


def _require_regular_lagrangian(model: Model, points: Points) -> None:
    """Refuse a Lagrangian whose velocities cannot be recovered from the momenta (its Hessian in v is singular)."""
    if model.form != "lagrangian":
        return
    null = expressions.null_direction(hessian_samples(model.function, model.rates, points))
    if null is not None:
        names = " ".join(str(v) for v, weight in zip(model.rates, null, strict=True) if abs(weight) > 1e-6)
        raise DegenerateError(
            f"the Lagrangian is degenerate in {names}", "give every coordinate a kinetic energy, or leave it out"
        )


def _require_independent_constraints(model: Model, points: Points) -> None:
    named = [Condition(f"{text(c)} = 0", c) for c in model.holonomic]
    for condition in named:
        if _is_constant(condition, model.coordinates, points):
            raise DegenerateError(f"constraint {condition} depends on no coordinate", "leave it out")
    names = _dependent(named, model.coordinates, points)
    if names:
        raise DegenerateError(f"the constraints {names} depend on each other", "leave out one of them")
    if len(named) >= len(model.coordinates) > 0 and named:
        raise DegenerateError(
            f"{len(named)} constraints on {len(model.coordinates)} coordinates leave nothing to move",
            "leave out a constraint",
        )


def _require_effective_path(model: Model, points: Points) -> None:
    symbols = (*model.coordinates, *model.rates, *model.controls)
    for condition in model.path:
        if _is_constant(condition, symbols, points):
            raise ExpressionError(
                f"path {condition} depends on no coordinate, rate or control",
                "limit free parameters and the duration by bounds, or leave it out",
            )
    names = _dependent([c for c in model.path if c.equality], symbols, points)
    if names:
        raise DegenerateError(f"the path conditions {names} depend on each other", "leave out one of them")


def _require_independent_conditions(model: Model, end: str, points: Points) -> None:
    """At one end, equations have to determine something that no value there has fixed already."""
    conditions = model.start_conditions if end == "start" else model.end_conditions
    own = tuple(free.symbol for free in model.free_parameters)
    for condition in conditions:
        symbols = (*model.coordinates, *model.rates, *(own if model.bodies == 1 else ()))
        if _is_constant(condition, symbols, points):
            raise BoundaryError(
                f"{end}_conditions {condition} depends on no coordinate or rate", "correct it, or leave it out"
            )
    fixed = prescribed(model, end)
    unknown = [s for s in (*model.coordinates, *model.rates, *own) if s not in fixed]
    equations = [condition for condition in conditions if condition.equality]
    likely = _with_values(fixed, points)
    for condition in equations:
        if _is_constant(condition, unknown, likely):
            raise BoundaryError(
                f"{end}_conditions {condition} ties only values that {end} fixes already",
                "leave it out, or let one of the values be free",
            )
    names = _dependent(equations, unknown, likely)
    if names:
        raise BoundaryError(f"the {end}_conditions {names} depend on each other", "leave out one of them")


def _require_effective_couplings(model: Model, points: Points) -> None:
    symbols = [value.symbol for value in model.end_values]
    for place in distinct([condition.expression for condition in model.couplings], symbols):
        condition = model.couplings[place]
        if _is_constant(condition, symbols, points):
            raise BoundaryError(f"end_conditions {condition} couples nothing, since its bodies cancel", "leave it out")


def _with_values(fixed: Mapping[sympy.Symbol, sympy.Expr], points: Points) -> Points:
    """The points with the prescribed values in them, which depend on nothing that the points differ in."""
    numbers = {symbol: expressions.rounded_at(value, points[0]) for symbol, value in fixed.items()}
    known = {symbol: number for symbol, number in numbers.items() if number is not None}
    return [{**point, **known} for point in points]


def _gradient(conditions: Sequence[Condition], symbols: Sequence[sympy.Symbol]) -> sympy.Matrix:
    return sympy.Matrix(
        len(conditions), len(symbols), [sympy.diff(c.expression, s) for c in conditions for s in symbols]
    )


def _is_constant(condition: Condition, symbols: Sequence[sympy.Symbol], points: Points) -> bool:
    """Whether a condition does not depend on any of the symbols, wherever it is tried; short slopes come first."""
    inside = [symbol for symbol in symbols if symbol in condition.expression.free_symbols]
    inside.sort(key=lambda symbol: sympy.count_ops(sympy.diff(condition.expression, symbol)))
    return all(_dependent([condition], [symbol], points) for symbol in inside)


def _dependent(conditions: Sequence[Condition], symbols: Sequence[sympy.Symbol], points: Points) -> str:
    """The names of conditions that follow from each other to first order wherever they are tried, else nothing."""
    if not conditions:
        return ""
    weights = expressions.dependent_rows(_gradient(conditions, symbols), points)
    if weights is None:
        return ""
    return " and ".join(c.name for c, weight in zip(conditions, weights, strict=True) if abs(weight) > 1e-6)
