"""Checks with numbers: what has to be finite, positive, in order or in agreement at the default parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import sympy

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.conditions.base import Points
from codegen.discretise.model.definitions import Bounds, Condition, Model, prescribed
from codegen.errors import BoundaryError, DegenerateError, ExpressionError
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounding_at, rounding_of
from codegen.symbolic.derivatives import hessian_samples


def values_at_guess(model: Model) -> dict[sympy.Symbol, float]:
    """Parameters at their defaults and free parameters at their first guesses; those without a number are left out."""
    values = model.default_values
    guesses = {f.symbol: expressions.rounded_at(f.guess, values) for f in model.free_parameters}
    return values | {symbol: number for symbol, number in guesses.items() if number is not None}


def require_values(model: Model, bounds: Sequence[Bounds], points: Points) -> None:
    """Refuse values that are not finite at the default parameters, and values that contradict each other.

    `bounds` are all that the author gave, those of velocities and free parameters included; at one of `points` every
    expression is expected to have a value.
    """
    for free in model.free_parameters:
        _number(f"guess of {free.symbol}", free.guess, model.default_values)
    for what, expression in _given_values(model):
        for values in _bodies(model, expression):
            _number(what, expression, values)
    duration = _number("duration", model.duration, values_at_guess(model))
    if duration <= 0.0:
        where = " at the first guess" if model.duration.free_symbols - set(model.parameters) else ""
        raise ExpressionError(f"duration is {duration:g}{where}", "give a positive duration")
    for bound in bounds:
        _require_order(model, bound)
    _require_within(model, bounds)
    _require_real(model, points)


def require_regular_lagrangian(model: Model, points: Points) -> None:
    """Refuse a Lagrangian whose velocities cannot be recovered from the momenta (its Hessian in v is singular).

    Across holonomic constraints there is no velocity to recover: a rigid body's Lagrangian says nothing of how the
    length of its quaternion changes.
    """
    if model.form != "lagrangian":
        return
    across = [sympy.Matrix([c]).jacobian(model.coordinates).dot(model.rates) for c in model.holonomic]
    known = model.function + sum(rate**2 for rate in across)
    null = expressions.null_direction(hessian_samples(known, model.rates, points))
    if null is not None:
        names = " ".join(str(v) for v, weight in zip(model.rates, null, strict=True) if abs(weight) > 1e-6)
        raise DegenerateError(
            f"the Lagrangian is degenerate in {names}", "give every coordinate a kinetic energy, or leave it out"
        )


def _bodies(model: Model, *expressions: sympy.Expr | None) -> Iterator[dict[sympy.Symbol, float]]:
    """Values of parameters and free parameters, once for each body if some expression depends on its number."""
    values = values_at_guess(model)
    if model.body is None or not any(e is not None and e.has(model.body) for e in expressions):
        yield values
        return
    for number in range(model.bodies):
        yield {**values, model.body: float(number)}


def _number(what: str, expression: sympy.Expr, values: Mapping[sympy.Symbol, float]) -> float:
    number = expressions.rounded_at(expression, values)
    if number is None:
        raise ExpressionError(
            f"{what} is {expression}, which is no finite number at the default parameters", "correct the values"
        )
    return number


def _given_values(model: Model) -> Iterator[tuple[str, sympy.Expr]]:
    for end in ("start", "end"):
        for symbol, value in prescribed(model, end).items():
            yield f"{end} of {symbol}", value
    for kind in CONDITIONS:
        yield from kind.numbers(model)


def _require_order(model: Model, bound: Bounds) -> None:
    for values in _bodies(model, bound.lower, bound.upper):
        lower, upper = (
            _number(f"{which} bound of {bound.symbol}", expression, values) if expression is not None else None
            for which, expression in (("lower", bound.lower), ("upper", bound.upper))
        )
        if lower is None or upper is None:
            continue
        where = f"{bound.symbol} has the lower bound {lower:g} and the upper bound {upper:g}"
        if lower == upper:
            raise BoundaryError(where, _instead_of_equal_bounds(model, bound.symbol))
        if lower > upper:
            raise BoundaryError(where, "exchange them")


def _instead_of_equal_bounds(model: Model, symbol: sympy.Symbol) -> str:
    """How to hold a quantity at one value."""
    if symbol in model.controls or symbol in [free.symbol for free in model.free_parameters]:
        return "make it a parameter of that value"
    return "give it by start or end where it is fixed, or hold it by a path equality, Eq(..., ...)"


def _require_within(model: Model, bounds: Sequence[Bounds]) -> None:
    """Refuse values at the ends, and first guesses of free parameters, that lie outside their bounds."""
    given = [(f.symbol, f"guess of {f.symbol}", f.guess) for f in model.free_parameters]
    given += [(s, f"{end} of {s}", value) for end in ("start", "end") for s, value in prescribed(model, end).items()]
    limits = {bound.symbol: bound for bound in bounds}
    for symbol, what, expression in given:
        bound = limits.get(symbol, Bounds(symbol, None, None))
        for values in _bodies(model, expression, bound.lower, bound.upper):
            number = _number(what, expression, values)
            for word, sign, limit in (("below its lower", -1, bound.lower), ("above its upper", 1, bound.upper)):
                if limit is None:
                    continue
                edge = _number(f"bound of {symbol}", limit, values)
                if sign * (number - edge) > rounding_of((number, edge)):
                    raise BoundaryError(f"{what} is {number:g}, {word} bound {edge:g}", "correct one of them")


def _require_real(model: Model, points: Points) -> None:
    """Refuse dynamics, costs, conditions and guesses that have no real value at any trial point."""
    form = "dynamics" if model.form == "first-order" else model.form
    named = [(f"the {form}", model.function), *((f"guess of {s}", value) for s, value in model.guess)]
    named += [(f"force of {q}", value) for q, value in zip(model.coordinates, model.force, strict=False)]
    named += [(f"dynamics of {x}", value) for x, value in zip(model.coordinates, model.dynamics, strict=False)]
    named += [("cost", model.cost)] if model.cost is not None else []
    named += [("terminal_cost", model.terminal_cost)]
    named += [(f"history of {delay.quantity}", delay.history) for delay in model.delays]
    named += [pair for kind in CONDITIONS for pair in kind.values(model)]
    for what, expression in named:
        for body in _bodies(model, expression):
            if all(expressions.rounded_at(expression, {**point, **body}) is None for point in points):
                raise ExpressionError(
                    f"{what} has no finite real value at the default parameters", "correct it, or the parameters"
                )


def require_agreement(model: Model) -> None:
    """Refuse values at an end that violate a condition which depends on nothing else."""
    for end in ("start", "end"):
        fixed = {**prescribed(model, end), model.time: sympy.S.Zero if end == "start" else model.duration}
        for condition in (condition for kind in CONDITIONS for condition in kind.at(model, end)):
            _require_agreement(model, end, fixed, condition)


def _require_agreement(model: Model, end: str, fixed: Mapping[sympy.Symbol, sympy.Expr], condition: Condition) -> None:
    symbols = condition.expression.free_symbols
    values = [value for symbol, value in fixed.items() if symbol in symbols]
    inside = symbols.union(*(value.free_symbols for value in values))
    if not inside <= {*fixed, *model.parameters, model.body}:
        return
    for body in _bodies(model, *values):
        numbers = {s: _number(f"{end} of {s}", value, body) for s, value in fixed.items() if s in symbols}
        excess = expressions.rounded_at(condition.expression, {**body, **numbers})
        if excess is None:
            continue
        excess = abs(excess) if condition.equality else excess
        if excess > rounding_at(condition.expression, {**body, **numbers}):
            raise BoundaryError(f"{end} violates {condition} by {excess:g}", "correct one of them")
