"""Points at which the expressions of a problem may be expected to have a value.

Functions of a problem that have no finite value, slope or curvature where the search for its motion begins.

Jumps of a Piecewise where a motion may cross them: derivatives do not see them, and no optimum is right there.

Kinks of a cost: where its slope jumps, which is where a minimum is drawn to and Newton's method cannot follow.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
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


def sample_points(
    model: Model, elsewhere: Mapping[sympy.Symbol, float] | None = None
) -> list[dict[sympy.Symbol, float]]:
    """States, controls, end values and times: where the author expects the motion, and drawn at random.

    `elsewhere` has values of what the problem leaves open, from the phases before it. All points have parameters at
    their defaults, and they are the same in every run.
    """
    fixed = _constants(model)
    others = [*(value.symbol for value in model.end_values), *(delay.symbol for delay in model.delays)]
    symbols = [*model.coordinates, *model.rates, *model.controls, *others, model.time]
    first, *others = [{**(elsewhere or {}), **expected_values(model, share)} for share in (0.0, 0.5, 1.0)]
    likely, *drawn = expressions.sample_points(symbols, fixed, first)
    return [likely, *({**drawn[0], **point, **fixed} for point in others), *drawn]


def expected_values(model: Model, share: float) -> dict[sympy.Symbol, float]:
    """States, controls and time after a share of the duration, as far as the author says where they are.

    That is the guess, else what lies between the values at the ends, or the only one, else the middle of the bounds.
    """
    constants = _constants(model)
    duration = expressions.rounded_at(model.duration, constants)
    at = {**constants, model.time: share * (duration or 0.0)}
    guessed = {**_middles(model), **_between_ends(model, share), **dict(model.guess)}
    guessed |= {delay.symbol: guessed.get(delay.quantity, delay.history) for delay in model.delays}
    numbers = {symbol: expressions.rounded_at(value, at) for symbol, value in guessed.items()}
    return {model.time: at[model.time]} | {symbol: number for symbol, number in numbers.items() if number is not None}


def _constants(model: Model) -> dict[sympy.Symbol, float]:
    return values_at_guess(model) | ({model.body: 0.0} if model.body is not None else {})


def _between_ends(model: Model, share: float) -> dict[sympy.Symbol, sympy.Expr]:
    start, end = prescribed(model, "start"), prescribed(model, "end")
    lines = {symbol: (1 - share) * value + share * end[symbol] for symbol, value in start.items() if symbol in end}
    return {**start, **end, **lines}


def _middles(model: Model) -> dict[sympy.Symbol, sympy.Expr]:
    limits = {bound.symbol: (bound.lower, bound.upper) for bound in model.bounds}
    return {s: (lower + upper) / 2 for s, (lower, upper) in limits.items() if lower is not None and upper is not None}


Singular = tuple[str, str, str]
"""A function, what of it is not finite, and where, as in sqrt(u), slope, u = 0."""
_INSIDE = 0.3137, 0.7713
"""Parts of the duration at which no scheme of a few points evaluates: what is singular there is so all along."""
_PUSH = 1e-2
"""Optimisers begin as far inside the bounds, in parts of their sizes."""
_WITH_ENDS = (sympy.log, sympy.asin, sympy.acos, sympy.acosh, sympy.atanh)
"""Functions whose domain ends somewhere, as that of powers does."""


def singular_at_guess(model: Model) -> tuple[Singular, ...]:
    """The functions inside cost, dynamics and conditions of one phase that have none all along its guess."""
    moving = {*model.coordinates, *model.rates, *model.controls}
    found = list[Singular]()
    for part, what, point in _singular_parts(model):
        at = ", ".join(f"{s} = {point[s]:g}" for s in sorted(part.free_symbols & moving, key=str))
        found.append((str(part), what, at))
    return tuple(found)


def with_regular_guesses(model: Model) -> Model:
    """The model in which controls without a guess are guessed to be one where functions of them have no value at zero.

    Such as log(u), or 1/u. A kink is left: what its author means is another formulation, not another guess.
    """
    phases = tuple(with_regular_guesses(phase) for phase in model.phases)
    if phases:
        return replace(model, phases=phases)
    if not model.controls:
        return model
    given = {symbol for symbol, _ in model.guess}
    without_value = [part for part, what, _ in _singular_parts(model) if what == "value"]
    symbols = set[Symbol]().union(*(part.free_symbols for part in without_value))
    moved = tuple((u, sympy.S.One) for u in model.controls if u in symbols - given)
    other = replace(model, guess=(*model.guess, *moved)) if moved else model
    return other if len(_singular_parts(other)) < len(_singular_parts(model)) else model


def _singular_parts(model: Model) -> list[tuple[Expr, str, dict[Symbol, float]]]:
    """Singular functions of one phase, what of them is not finite, and where."""
    points = [point_of_guess(model, share) for share in _INSIDE]
    moving = {*model.coordinates, *model.rates, *model.controls}
    found = []
    for part in dict.fromkeys(part for expression in expressions_of(model) for part in _parts(expression)):
        wrong = [_wrong(part, point) for point in points] if part.free_symbols & moving else []
        if wrong and all(wrong):
            found.append((part, wrong[0], points[0]))
    return found


def point_of_guess(model: Model, share: float) -> dict[Symbol, float]:
    """Values of the guess after a share of the duration, moved inside the bounds as optimisers do."""
    values = values_at_guess(model) | ({model.body: 0.0} if model.body is not None else {})
    duration = rounded_at(model.duration, values) or 0.0
    at = {**values, model.time: share * duration}
    given = dict(model.guess)
    lines = dict(zip(model.coordinates, guessed(model, model.coordinates, model.duration), strict=True))
    if model.form == "lagrangian":
        lines |= {v: sympy.diff(lines[q], model.time) for q, v in zip(model.coordinates, model.rates, strict=True)}
    elif model.form == "first-order":
        lines |= dict(zip(model.rates, guessed(model, model.rates, model.duration), strict=True))
    # Models that are rewritten in momenta say nothing of their ends, and what is left open may be guessed elsewhere.
    known_ends = known_values(model, model.start, model.start_conditions)
    known_ends |= known_values(model, model.end, model.end_conditions)
    owner = dict(zip(model.rates, model.coordinates, strict=False)) if model.form == "lagrangian" else {}
    lines = {s: value for s, value in lines.items() if {s, owner.get(s, s)} & {*known_ends, *given}}
    lines |= {u: given.get(u, sympy.S.Zero) for u in model.controls}
    numbers = {s: rounded_at(given.get(s, value), at) for s, value in lines.items()}
    known = {s: number for s, number in numbers.items() if number is not None}
    for bound in model.bounds:
        if bound.symbol in known:
            limits = [None if limit is None else rounded_at(limit, at) for limit in (bound.lower, bound.upper)]
            known[bound.symbol] = _inside(known[bound.symbol], *limits)
    return at | known


def _inside(number: float, lower: float | None, upper: float | None) -> float:
    push = _PUSH * max(1.0, abs(number))
    if lower is not None and upper is not None:
        push = min(push, _PUSH * abs(upper - lower))
    number = number if lower is None else max(number, lower + push)
    return number if upper is None else min(number, upper - push)


def _parts(expression: Expr) -> Iterator[Expr]:
    """Powers and functions inside an expression that may be singular, inner ones first."""
    for part in sympy.postorder_traversal(expression):
        is_power = isinstance(part, sympy.Pow) and not (part.exp.is_Integer and part.exp.is_nonnegative)
        if (is_power or isinstance(part, _WITH_ENDS)) and part.free_symbols:
            yield part


def _wrong(part: Expr, point: Mapping[Symbol, float]) -> str:
    """What of a power or function is not finite at a point; nothing where its argument is not known."""
    inner = part.args[0]
    argument = rounded_at(inner, point) if inner.free_symbols <= set(point) else None
    if argument is None or not part.free_symbols <= set(point):
        return ""
    value = Dummy("value", real=True)
    outer = part.func(value, *part.args[1:])
    for word in ("value", "slope", "curvature"):
        if rounded_at(outer, {**point, value: argument}) is None:
            return word
        outer = sympy.diff(outer, value)
    return ""


def jumps(expression: Expr, unknowns: Iterable[Symbol]) -> tuple[str, ...]:
    """Conditions of Piecewise at whose border an expression jumps, as the author wrote them.

    Only borders that depend on the `unknowns` count, and that can be solved for one of them: time passes its borders
    when everybody knows. A slope that jumps is none, as in Piecewise((0, x < 0), (x**2, True)).
    """
    moving = set(unknowns)
    found: dict[str, None] = {}
    for piecewise in sorted(expression.atoms(sympy.Piecewise), key=sympy.default_sort_key):
        value = Dummy("value", real=True)
        outer = expression.xreplace({piecewise: value})
        for (before, condition), (after, _) in pairwise(piecewise.args):
            for border in _borders(condition, moving):
                difference = outer.xreplace({value: before}) - outer.xreplace({value: after})
                if any(not identically_zero(difference.subs(symbol, at)) for symbol, at in _solved(border, moving)):
                    found[str(border)] = None
    return tuple(found)


def _borders(condition: sympy.Basic, moving: Collection[Symbol]) -> Iterator[sympy.core.relational.Relational]:
    """The inequalities in a condition that depend on what moves."""
    for border in sorted(condition.atoms(sympy.core.relational.Relational), key=sympy.default_sort_key):
        if border.free_symbols & set(moving):
            yield border


def _solved(border: sympy.core.relational.Relational, moving: Collection[Symbol]) -> Iterator[tuple[Symbol, Expr]]:
    """A moving symbol that the border is linear in, and its value there; nothing if there is none."""
    distance = border.lhs - border.rhs
    for symbol in sorted(border.free_symbols & set(moving), key=str):
        slope = sympy.diff(distance, symbol)
        if symbol not in slope.free_symbols and not identically_zero(slope):
            yield symbol, symbol - distance / slope
            return


def kinks(expression: Expr, unknowns: Iterable[Symbol]) -> tuple[str, ...]:
    """Terms with Abs, Max or Min at whose kink the slope of an expression jumps, as the author wrote them.

    Only what depends on the `unknowns` counts. u |u| has none, nor has max(x, 0)^2: their slopes are zero there.
    """
    moving = set(unknowns)
    found: dict[str, None] = {}
    for bend in sorted(expression.atoms(sympy.Abs, sympy.Max, sympy.Min), key=sympy.default_sort_key):
        if not bend.free_symbols & moving:
            continue
        value = Dummy()
        slope = expression.xreplace({bend: value}).diff(value)
        if not _vanishes(slope, value, bend):
            found[str(bend)] = None
    return tuple(found)


def _vanishes(slope: Expr, value: Symbol, bend: Expr) -> bool:
    """Whether the slope of an expression by the value of Abs, Max or Min is zero where that has its kink."""
    numbers = [argument for argument in bend.args if argument.is_number] or [sympy.S.Zero]
    others = [argument for argument in bend.args if not argument.is_number]
    if len(others) > 1:
        return False
    return bool(slope.subs({value: numbers[0]}).subs(others[0], numbers[0]) == 0)
