"""Trial points, and functions of a problem that are not smooth.

Trial points lie where the expressions of a problem should have a value: near the expected motion, and at random.
Three kinds of functions make Newton's method fail. Functions may have no finite value or derivative at the initial
guess. A Piecewise may jump where a motion crosses a border: derivatives do not contain the jump, and the optimum is
wrong. The first derivative of a cost may jump at a kink, where the minimum then often lies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise

import sympy
from sympy import Dummy, Expr, Symbol

from codegen.discretise.model.definitions import Model, expressions_of, prescribed
from codegen.discretise.model.guesses import guessed, known_values
from codegen.discretise.model.values import values_at_guess
from codegen.symbolic import checks as expressions
from codegen.symbolic.checks import rounded_at
from codegen.symbolic.zeros import identically_zero

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
