"""Checks of numbers at the default parameters: values must be finite, in order, and consistent with each other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import sympy

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.conditions.base import Points
from codegen.discretise.degenerate import is_linear
from codegen.discretise.model.definitions import Bounds, Model, prescribed
from codegen.errors import BoundaryError, DegenerateError, ExpressionError
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounding_at, rounding_of
from codegen.symbolic.derivatives import hessian_samples


def values_at_guess(model: Model) -> dict[sympy.Symbol, float]:
    """Return the default values of parameters, and the initial guesses of free parameters that are finite."""
    values = model.default_values
    guesses = {f.symbol: expressions.rounded_at(f.guess, values) for f in model.free_parameters}
    return values | {symbol: number for symbol, number in guesses.items() if number is not None}


def require_values(model: Model, bounds: Sequence[Bounds], points: Points) -> None:
    """Raise an error for values that are not finite at the default parameters, or contradict each other.

    `bounds` are all bounds of the author, including velocities and free parameters. Every expression must have a finite
    real value at one of the trial `points` or more.
    """
    for free in model.free_parameters:
        _number(f"guess of {free.symbol}", free.guess, model.default_values)
    at_ends = [(s, f"{end} of {s}", value) for end in ("start", "end") for s, value in prescribed(model, end).items()]
    fixed = [(what, value) for _, what, value in at_ends]
    for what, expression in (*fixed, *(pair for kind in CONDITIONS for pair in kind.numbers(model))):
        for values in _bodies(model, expression):
            _number(what, expression, values)
    duration = _number("duration", model.duration, values_at_guess(model))
    if duration <= 0.0:
        where = " at the first guess" if model.duration.free_symbols - set(model.parameters) else ""
        raise ExpressionError(f"duration is {duration:g}{where}", "give a positive duration")
    for bound in bounds:
        for values in _bodies(model, bound.lower, bound.upper):
            lower, upper = (
                _number(f"{side} bound of {bound.symbol}", expression, values) if expression is not None else None
                for side, expression in (("lower", bound.lower), ("upper", bound.upper))
            )
            if lower is None or upper is None or lower < upper:
                continue
            finding = f"{bound.symbol} has the lower bound {lower:g} and the upper bound {upper:g}"
            if lower > upper:
                raise BoundaryError(finding, "exchange them")
            if bound.symbol in (*model.controls, *(free.symbol for free in model.free_parameters)):
                raise BoundaryError(finding, "make it a parameter of that value")
            remedy = "give it by start or end where it is fixed, or hold it by a path equality, Eq(..., ...)"
            raise BoundaryError(finding, remedy)
    limits = {bound.symbol: bound for bound in bounds}
    for symbol, what, expression in (
        *((f.symbol, f"guess of {f.symbol}", f.guess) for f in model.free_parameters),
        *at_ends,
    ):
        bound = limits.get(symbol, Bounds(symbol, None, None))
        for values in _bodies(model, expression, bound.lower, bound.upper):
            number = _number(what, expression, values)
            for word, sign, limit in (("below its lower", -1, bound.lower), ("above its upper", 1, bound.upper)):
                if limit is None:
                    continue
                edge = _number(f"bound of {symbol}", limit, values)
                if sign * (number - edge) > rounding_of((number, edge)):
                    raise BoundaryError(f"{what} is {number:g}, {word} bound {edge:g}", "correct one of them")
    # Dynamics, costs, conditions and guesses have a real value at one trial point or more.
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


def require_regular_lagrangian(model: Model, points: Points) -> None:
    """Raise DegenerateError if the Hessian of a Lagrangian with respect to the velocities is singular.

    Directions normal to holonomic constraints are excepted in control problems: the Lagrangian of a rigid body does not
    depend on the rate of change of the length of its quaternion. A simulation has momenta, which determine velocities.
    """
    if model.form != "lagrangian":
        return
    constraints = model.holonomic if model.task == "control" else ()
    across = [sympy.Matrix([c]).jacobian(model.coordinates).dot(model.rates) for c in constraints]
    regularised = model.function + sum(rate**2 for rate in across)
    null = expressions.null_direction(hessian_samples(regularised, model.rates, points))
    if null is not None:
        singular = [v for v, weight in zip(model.rates, null, strict=True) if abs(weight) > 1e-6]
        turning = {f"d{name}_{part}": f"the angular velocity of {name}" for name in model.attitudes for part in "wxyz"}
        names = " ".join(dict.fromkeys(turning.get(str(v), str(v)) for v in singular))
        remedy = "give every coordinate a kinetic energy, or leave it out"
        if all(str(v) in turning for v in singular):
            raise DegenerateError(f"the Lagrangian is degenerate in {names}", "give all moments of inertia values > 0")
        if model.task == "control" and is_linear(model.function, model.rates):
            remedy = "it is linear in the velocities, for simulations only; write the equations as dynamics={x: ...}"
        elif any(sympy.diff(model.function, v) != 0 for v in singular):
            remedy += ", or let the Lagrangian be linear in all velocities"
        if len(constraints) < len(model.holonomic):
            remedy += "; across a constraint, add the square of its time derivative, which vanishes along the motion"
        raise DegenerateError(f"the Lagrangian is degenerate in {names}", remedy)


def require_agreement(model: Model) -> None:
    """Raise BoundaryError if the prescribed values at an end determine a condition and violate it."""
    for end in ("start", "end"):
        fixed = {**prescribed(model, end), model.time: sympy.S.Zero if end == "start" else model.duration}
        for condition in (condition for kind in CONDITIONS for condition in kind.at(model, end)):
            symbols = condition.expression.free_symbols
            values = {symbol: value for symbol, value in fixed.items() if symbol in symbols}
            present = symbols.union(*(value.free_symbols for value in values.values()))
            if not present <= {*fixed, *model.parameters, model.body}:
                continue
            for body in _bodies(model, *values.values()):
                numbers = {**body, **{s: _number(f"{end} of {s}", value, body) for s, value in values.items()}}
                excess = expressions.rounded_at(condition.expression, numbers)
                if excess is None:
                    continue
                excess = abs(excess) if condition.equality else excess
                if excess > rounding_at(condition.expression, numbers):
                    raise BoundaryError(f"{end} violates {condition} by {excess:g}", "correct one of them")


def _bodies(model: Model, *expressions: sympy.Expr | None) -> Iterator[dict[sympy.Symbol, float]]:
    """Yield the values of parameters and free parameters: once, or for each body if an expression depends on it."""
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
