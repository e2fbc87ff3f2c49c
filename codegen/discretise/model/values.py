"""Checks of a model at numbers: values at the default parameters, trial points, and kinks and jumps of functions.

Values at the default parameters must be finite, in order, and consistent with each other.

Trial points lie where the expressions of a problem should have a value: near the expected motion, and at random.
Three kinds of functions make Newton's method fail. Functions may have no finite value or derivative at the initial
guess. A Piecewise may jump where a motion crosses a border: derivatives do not contain the jump, and the optimum is
wrong. The first derivative of a cost may jump at a kink, where the minimum then often lies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import sympy
from sympy import Dummy, Expr, Symbol

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.conditions.base import Points
from codegen.discretise.degenerate import is_linear
from codegen.discretise.model.definitions import Bounds, Model, expressions_of, prescribed
from codegen.discretise.model.guesses import guessed, known_values
from codegen.errors import BoundaryError, DegenerateError, ExpressionError
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounded_at, rounding_at, rounding_of
from codegen.symbolic.derivatives import hessian_samples
from codegen.symbolic.zeros import identically_zero


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


Singular = tuple[str, str, str]
"""A function, the name of its first infinite derivative, and the point, such as ("sqrt(u)", "slope", "u = 0")."""
_INSIDE = 0.3137, 0.7713
"""Fractions of the duration that are no points of usual schemes; a function singular at both is singular everywhere."""
_PUSH = 1e-2
"""Distance of initial values from their bounds in optimisers, relative to the absolute value or 1."""
_WITH_ENDS = (sympy.log, sympy.asin, sympy.acos, sympy.acosh, sympy.atanh)
"""Functions whose domain is bounded, like the domain of powers."""


def sample_points(
    model: Model, elsewhere: Mapping[sympy.Symbol, float] | None = None
) -> list[dict[sympy.Symbol, float]]:
    """Return trial points: values of all symbols near the expected motion, and values drawn at random.

    `elsewhere` has values, from earlier phases, of states that the problem does not prescribe. Parameters have their
    default values. The points are the same in every run.
    """
    fixed = _constants(model)
    others = [*(value.symbol for value in model.end_values), *(delay.symbol for delay in model.delays)]
    symbols = [*model.coordinates, *model.rates, *model.controls, *others, model.time]
    first, *others = [{**(elsewhere or {}), **expected_values(model, share)} for share in (0.0, 0.5, 1.0)]
    likely, *drawn = expressions.sample_points(symbols, fixed, first)
    return [likely, *({**drawn[0], **point, **fixed} for point in others), *drawn]


def expected_values(model: Model, share: float) -> dict[sympy.Symbol, float]:
    """Return the known values of states, controls and time after the fraction `share` of the duration.

    A value comes from the guess, else from the line between the prescribed values at both ends, else from the value at
    one end, else from the middle of the bounds.
    """
    constants = _constants(model)
    at = {**constants, model.time: share * (rounded_at(model.duration, constants) or 0.0)}
    values = {b.symbol: (b.lower + b.upper) / 2 for b in model.bounds if b.lower is not None and b.upper is not None}
    start, end = prescribed(model, "start"), prescribed(model, "end")
    lines = {symbol: (1 - share) * value + share * end[symbol] for symbol, value in start.items() if symbol in end}
    values |= {**start, **end, **lines, **dict(model.guess)}
    values |= {delay.symbol: values.get(delay.quantity, delay.history) for delay in model.delays}
    numbers = {symbol: rounded_at(value, at) for symbol, value in values.items()}
    return {model.time: at[model.time]} | {symbol: number for symbol, number in numbers.items() if number is not None}


def _constants(model: Model) -> dict[sympy.Symbol, float]:
    return values_at_guess(model) | ({model.body: 0.0} if model.body is not None else {})


def singular_at_guess(model: Model) -> tuple[Singular, ...]:
    """Return the functions in cost, dynamics and conditions of one phase that are singular on its whole guess."""
    moving = {*model.coordinates, *model.rates, *model.controls}
    singular = list[Singular]()
    for part, derivative, point in _singular_parts(model):
        at = ", ".join(f"{s} = {point[s]:g}" for s in sorted(part.free_symbols & moving, key=str))
        singular.append((str(part), derivative, at))
    return tuple(singular)


def with_regular_guesses(model: Model) -> Model:
    """Return a model with the guess 1 for controls in functions without value at zero, such as log(u) or 1/u.

    Kinks remain: they need another formulation, not another guess.
    """
    if model.phases:
        return replace(model, phases=tuple(with_regular_guesses(phase) for phase in model.phases))
    if not model.controls:
        return model
    guess, singular = dict(model.guess), _singular_parts(model)
    symbols = set[Symbol]().union(*(part.free_symbols for part, derivative, _ in singular if derivative == "value"))
    ones = tuple((u, sympy.S.One) for u in model.controls if u in symbols and u not in guess)
    changed = replace(model, guess=(*model.guess, *ones))
    return changed if ones and len(_singular_parts(changed)) < len(singular) else model


def _singular_parts(model: Model) -> list[tuple[Expr, str, dict[Symbol, float]]]:
    """Return triples: a singular function in one phase, its first infinite derivative, and the point."""
    points = [_point_of_guess(model, share) for share in _INSIDE]
    moving = {*model.coordinates, *model.rates, *model.controls}
    parts = dict[Expr, None]()
    for expression in expressions_of(model):
        for part in sympy.postorder_traversal(expression):
            is_power = isinstance(part, sympy.Pow) and not (part.exp.is_Integer and part.exp.is_nonnegative)
            if (is_power or isinstance(part, _WITH_ENDS)) and part.free_symbols & moving:
                parts[part] = None
    singular = [(part, [_singular_derivative(part, point) for point in points]) for part in parts]
    return [(part, derivatives[0], points[0]) for part, derivatives in singular if all(derivatives)]


def _point_of_guess(model: Model, share: float) -> dict[Symbol, float]:
    """Return the guess after the fraction `share` of the duration, moved inside the bounds as in optimisers."""
    values = _constants(model)
    at = {**values, model.time: share * (rounded_at(model.duration, values) or 0.0)}
    guess = dict(model.guess)
    lines = dict(zip(model.coordinates, guessed(model, model.coordinates, model.duration), strict=True))
    if model.form == "lagrangian":
        lines |= {v: sympy.diff(lines[q], model.time) for q, v in zip(model.coordinates, model.rates, strict=True)}
    # Without a value at an end or an author's guess, a quantity is left out: it may have a guess elsewhere.
    fixed = known_values(model, model.start, model.start_conditions)
    fixed |= known_values(model, model.end, model.end_conditions)
    coordinate = dict(zip(model.rates, model.coordinates, strict=False)) if model.form == "lagrangian" else {}
    lines = {s: value for s, value in lines.items() if {s, coordinate.get(s, s)} & {*fixed, *guess}}
    lines |= {u: guess.get(u, sympy.S.Zero) for u in model.controls}
    numbers = {s: rounded_at(guess.get(s, value), at) for s, value in lines.items()}
    point = {s: number for s, number in numbers.items() if number is not None}
    for bound in model.bounds:
        if bound.symbol in point:
            number = point[bound.symbol]
            lower, upper = (None if limit is None else rounded_at(limit, at) for limit in (bound.lower, bound.upper))
            push = _PUSH * max(1.0, abs(number))
            if lower is not None and upper is not None:
                push = min(push, _PUSH * abs(upper - lower))
            number = number if lower is None else max(number, lower + push)
            point[bound.symbol] = number if upper is None else min(number, upper - push)
    return at | point


def _singular_derivative(part: Expr, point: Mapping[Symbol, float]) -> str:
    """Return the first of value, slope, curvature that is not finite; "" if all are finite or a symbol is unknown."""
    if not part.free_symbols <= set(point):
        return ""
    argument = rounded_at(part.args[0], point)
    if argument is None:
        return ""
    x = Dummy("value", real=True)
    function = part.func(x, *part.args[1:])
    for derivative in ("value", "slope", "curvature"):
        if rounded_at(function, {**point, x: argument}) is None:
            return derivative
        function = sympy.diff(function, x)
    return ""


def jumps(expression: Expr, unknowns: Iterable[Symbol]) -> tuple[str, ...]:
    """Return the relations in the author's Piecewise at whose border an expression jumps.

    Only borders that depend on the `unknowns`, and are linear in one unknown, count: the instant at which time crosses
    a border is known. A jump of a derivative does not count, as in Piecewise((0, x < 0), (x**2, True)).
    """
    moving = set(unknowns)
    borders_with_jump: dict[str, None] = {}
    for piecewise in sorted(expression.atoms(sympy.Piecewise), key=sympy.default_sort_key):
        value = Dummy("value", real=True)
        outer = expression.xreplace({piecewise: value})
        for (before, condition), (after, _) in pairwise(piecewise.args):
            borders = condition.atoms(sympy.core.relational.Relational)
            for border in sorted(borders, key=sympy.default_sort_key):
                difference = outer.xreplace({value: before}) - outer.xreplace({value: after})
                if any(not identically_zero(difference.subs(symbol, at)) for symbol, at in _solved(border, moving)):
                    borders_with_jump[str(border)] = None
    return tuple(borders_with_jump)


def _solved(border: sympy.core.relational.Relational, moving: set[Symbol]) -> Iterator[tuple[Symbol, Expr]]:
    """Yield the first moving symbol in which the border is linear, with its value on the border."""
    distance = border.lhs - border.rhs
    for symbol in sorted(border.free_symbols & moving, key=str):
        slope = sympy.diff(distance, symbol)
        if symbol not in slope.free_symbols and not identically_zero(slope):
            yield symbol, symbol - distance / slope
            return


def kinks(expression: Expr, unknowns: Iterable[Symbol]) -> tuple[str, ...]:
    """Return the author's terms with Abs, Max or Min at whose kink the first derivative of an expression jumps.

    Only terms that depend on the `unknowns` count. u |u| and max(x, 0)^2 have continuous derivatives, and do not count.
    """
    moving = set(unknowns)
    terms: dict[str, None] = {}
    for bend in sorted(expression.atoms(sympy.Abs, sympy.Max, sympy.Min), key=sympy.default_sort_key):
        if not bend.free_symbols & moving:
            continue
        value = Dummy()
        slope = expression.xreplace({bend: value}).diff(value)
        numbers = [argument for argument in bend.args if argument.is_number] or [sympy.S.Zero]
        arguments = [argument for argument in bend.args if not argument.is_number]
        # At the kink the argument of Abs is zero, and the argument of Max or Min equals the other, numeric argument.
        if len(arguments) > 1 or slope.subs({value: numbers[0]}).subs(arguments[0], numbers[0]) != 0:
            terms[str(bend)] = None
    return tuple(terms)
