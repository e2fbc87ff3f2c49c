"""Points at which the expressions of a problem may be expected to have a value."""

from __future__ import annotations

from collections.abc import Mapping

import sympy

from codegen.expressions import checks as expressions
from codegen.model.definitions import Model, prescribed
from codegen.model.values import values_at_guess


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
