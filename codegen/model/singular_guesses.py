"""Functions of a problem that have no finite value, slope or curvature where the search for its motion begins."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import sympy
from sympy import Dummy, Expr, Symbol

from codegen.expressions.checks import rounded_at
from codegen.model.definitions import Model, expressions_of
from codegen.model.lines import guessed, known_values
from codegen.model.values import values_at_guess

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
