"""What a sample of measurements adds to the cost: how far the motion inside its interval is from it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from sympy import Add, Expr, Piecewise, Symbol, sqrt

from codegen.discretise import FRACTION
from codegen.model import Model
from codegen.transcribe.guesses import measured_guess
from codegen.transcribe.names import Names
from codegen.transcribe.program import SampleElement


def sample_element(model: Model, observed: Sequence[Expr], names: Names) -> SampleElement | None:
    """The share of one sample, where there are measurements; `observed` are its values by the motion."""
    if not observed:
        return None
    fraction = Symbol(names.numbered("fraction"), nonnegative=True)
    values = tuple(Symbol(names.numbered("measured"), real=True) for _ in observed)
    weights = tuple(Symbol(names.numbered("weight"), nonnegative=True) for _ in observed)
    inside = [value.xreplace({FRACTION: fraction}) for value in observed]
    errors = (w * (x - z) for w, x, z in zip(weights, inside, values, strict=True))
    loss = Add(*map(_LOSSES[model.loss], errors))
    return SampleElement(loss, tuple(inside), fraction, values, weights, measured_guess(model))


def _square(error: Expr) -> Expr:
    return error**2


def _huber(error: Expr) -> Expr:
    """Source: Huber (1964), Robust estimation of a location parameter, Annals of Mathematical Statistics 35."""
    return Piecewise((2 * error - 1, error > 1), (-2 * error - 1, error < -1), (error**2, True))


def _soft_absolute(error: Expr) -> Expr:
    """2 (sqrt(1 + e^2) - 1), of which no digits cancel."""
    return 2 * error**2 / (1 + sqrt(1 + error**2))


_LOSSES: dict[str, Callable[[Expr], Expr]] = {"squares": _square, "huber": _huber, "soft-l1": _soft_absolute}
