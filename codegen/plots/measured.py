"""Measurements in the figure of an optimum: points beside what was measured, and what is left of the errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.interfaces import ControlModule, Matrix, Vector, time_grid
from codegen.plots.style import BLUE, DARK, GREY, body_colours, label
from codegen.solutions.fit import Fit
from codegen.solutions.result import Result

_POINTS: dict[str, Any] = {
    "linestyle": "none",
    "marker": "o",
    "markersize": 3.2,
    "markerfacecolor": "none",
    "zorder": 3,
}


@dataclass(frozen=True)
class Measured:
    """A column of measurements: its name and what it measures, values and errors (n,) at times (n,), of which body.

    Errors are in parts of standard deviations where `is_weighted`.
    """

    name: str
    expression: str
    bodies: Vector
    t: Vector
    values: Vector
    fitted: Vector
    errors: Vector
    is_weighted: bool


def measured(module: ControlModule, result: Result) -> list[Measured]:
    """All columns of measurements, where there are any, beside a result."""
    observations = module.metadata.observations
    if observations is None or result.unknowns is None:
        return []
    fit = Fit(module, time_grid(module, result.steps, result.grid), result.unknowns)
    columns = zip(
        observations.columns,
        observations.values,
        observations.sigmas,
        fit.measured.T,
        fit.fitted.T,
        fit.errors.T,
        strict=True,
    )
    return [
        Measured(name, expression, fit.bodies, fit.times, values, fitted, errors, sigma is not None)
        for name, expression, sigma, values, fitted, errors in columns
    ]


def bands(module: ControlModule, result: Result) -> dict[str, Matrix]:
    """How far 95 % intervals of the motion extend at the nodes, (N + 1, bodies) of every state, if estimates tell."""
    found, names = result.estimates, tuple(module.metadata.coordinates)
    if found is None or not np.isfinite(found.unknown_errors).all():
        return {}
    nodes, _ = module.views(time_grid(module, result.steps, result.grid), found.unknown_errors)
    return {name: found.quantile * nodes[:, :, i].T for i, name in enumerate(names)}


def points(axes: Any, shown: Measured, count: int) -> None:
    """What was measured, as points in a panel of what it measures; `count` is the number of bodies."""
    for body, colour in enumerate(body_colours(count, DARK)):
        own = shown.bodies == body
        axes.plot(shown.t[own], shown.values[own], color=colour, **_POINTS)


def band(axes: Any, t: Vector, values: Matrix, extent: Matrix) -> None:
    """The band in which the motion is with 95 % confidence, of every body."""
    for column, half, colour in zip(values.T, extent.T, body_colours(values.shape[1], BLUE), strict=True):
        axes.fill_between(t, column - half, column + half, color=colour, alpha=0.18, linewidth=0.0, zorder=0.8)


def fit(axes: Any, shown: Measured, count: int) -> None:
    """What was measured, as points, beside what the motion has at these times."""
    for body, colour in enumerate(body_colours(count, BLUE)):
        own = shown.bodies == body
        axes.plot(shown.t[own], shown.fitted[own], color=colour, linewidth=1.4)
    points(axes, shown, count)
    axes.set_ylabel(label(shown.name))


def residuals(axes: Any, shown: Measured, count: int) -> None:
    """The motion less what was measured over time."""
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for body, colour in enumerate(body_colours(count, BLUE)):
        own = (shown.bodies == body) & np.isfinite(shown.errors)
        axes.vlines(shown.t[own], 0.0, shown.errors[own], color=colour, linewidth=1.0)
        axes.plot(shown.t[own], shown.errors[own], color=colour, **_POINTS)
    axes.set_ylabel(f"{shown.name}, by $\\sigma$" if shown.is_weighted else shown.name)
