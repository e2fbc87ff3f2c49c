"""The figure of an optimum: drawing, states, momenta, multipliers, controls, path inequalities, iterations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from codegen.drawing import Scene
from codegen.show.figures import panels, shapes
from codegen.show.figures.picture import (
    AMBER,
    BLUE,
    DARK,
    GREY,
    MOST_BODY_COLOURS,
    Units,
    body_colours,
    body_map,
    label,
    letter_size,
    new_figure,
    quantity,
    title,
)
from codegen.show.figures.quantities import Inequality, Quantity, inequalities_of_segments, quantities_of_segments
from codegen.solving.interfaces import ControlModule, Matrix, Vector, time_grid
from codegen.solving.results.estimates import Fit
from codegen.solving.results.result import Result, Sensitivities
from codegen.solving.results.sensitivities import quantity_values

PART = 0.01
"""By what part of its value each quantity grows and shrinks."""
MOST = 8
"""Quantities with a bar."""


def changes(found: Sensitivities, values: Mapping[str, Vector]) -> dict[str, float]:
    """By how much the cost changes, to first order, as each quantity grows by one percent; the largest changes first.

    `values` (bodies,) are those of quantities. What is zero has no percent, and what differs from body to body has
    several: both are left out.
    """
    if found.reason:
        return {}
    single = {name: float(own[0]) for name, own in values.items() if own[0] != 0.0 and np.all(own == own[0])}
    every = {
        name: float(cost) * PART * abs(single[name]) for name, cost in zip(found.names, found.costs) if name in single
    }
    moving = {name: change for name, change in every.items() if change != 0.0 and np.isfinite(change)}
    return dict(sorted(moving.items(), key=lambda pair: -abs(pair[1])))


def tornado(axes: Any, shown: Mapping[str, float]) -> None:
    """Bars of the changes to both sides, where quantities grow and where they shrink by one percent."""
    names = list(shown)[:MOST]
    places = np.arange(len(names))
    sizes = np.array([shown[name] for name in names])
    for sign, colour, word in ((1.0, BLUE, "1 % more"), (-1.0, AMBER, "1 % less")):
        axes.barh(places, sign * sizes, 0.72, color=colour, alpha=0.85, label=word)
    axes.axvline(0.0, color=DARK, linewidth=0.8)
    axes.set_yticks(places, [quantity(name) for name in names])
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_locator(MaxNLocator(5, symmetric=True))
    axes.margins(x=0.08)
    rest = len(shown) - len(names)
    axes.set_xlabel("change of the cost" + (f"; {rest} smaller not shown" if rest else ""))
    # Above the panel, where no bar can be.
    axes.legend(
        loc="lower right",
        bbox_to_anchor=(1.0, 0.97),
        ncols=2,
        fontsize=letter_size(8),
        columnspacing=1.0,
        handlelength=1.2,
    )


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


WIDTH, WIDE = 12.0, 16.0
"""Of the figure, in inches; that of many coordinates with momenta is wide, and has two of them in each row."""

_MOST_ROWS = 12
_MOST_INEQUALITIES = 4
_MANY = 6
_MOST_BESIDE, _MOST_COLUMNS_BESIDE = 4, 3
_TITLES = {"state": "states", "momentum": "momenta", "multiplier": "multipliers", "control": "controls"}


@dataclass(frozen=True)
class Panel:
    """What a panel shows, the function that draws it, and whether its abscissa is the time."""

    kind: str
    draw: Callable[[Any], None]
    over_time: bool = True


Row = list[Panel | None]


@dataclass(frozen=True)
class Time:
    """The abscissa of all panels over time: its label, its ends, where phases follow each other, and inner times."""

    label: str
    start: float
    end: float
    switches: tuple[float, ...] = ()
    inner: tuple[float, ...] = ()


@dataclass(frozen=True)
class Drawings:
    """The problem's drawing along the solution and along the first guess."""

    solution: Scene
    guess: Scene


def control_figure(module: ControlModule, result: Result, drawings: Drawings | None = None, unit: str = "") -> Figure:
    """Everything about an optimum on one page; `unit` is written behind the time.

    A row for every state, with its momentum and multiplier; then controls, path inequalities and the iterations, which
    stand beside the drawing of a single body where it leaves room. Of several bodies the drawing shows both the first
    guess and the optimum.
    """
    groups, conditions = quantities_of_segments(module, result), inequalities_of_segments(module, result)
    samples, bodies = measured(module, result), int(module.metadata.bodies)
    states = _state_rows(groups, samples, bands(module, result) if samples else {})
    others = [*_others(groups["control"], conditions, result), *_of_measurements(groups["state"], samples, bodies)]
    others += _of_sensitivities(module, result)
    others.sort(key=lambda panel: not panel.over_time)
    width = WIDE if len(states[0]) > 4 else WIDTH
    shape = _shape(drawings, width)
    columns = math.ceil(len(others) / _MOST_BESIDE)
    beside = 0.0 < shape.left < 1.0 and columns <= (_MOST_COLUMNS_BESIDE if width == WIDE else 1)
    blocks = [states] if beside else [states, _in_rows(others, len(states[0]))]
    count = sum(map(len, blocks))
    height = max(1.2, 2.1 - 0.09 * count) * count + 0.6
    figure = new_figure(width, 0.9 + shape.height + height, ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.05))
    upper, lower = _halves(figure, shape.height, height) if drawings is not None else (None, figure)
    phases = int(module.metadata.phases)
    label, switches = Units.of(result, unit).time, result.t[result.steps : -1 : result.steps]
    inner = result.t[list(time_grid(module, result.steps, result.grid).inner)] if _inner_times(module) else ()
    time = Time(label, float(result.t[0]), float(result.t[-1]), tuple(map(float, switches)), tuple(map(float, inner)))
    outcome = "optimum" if result.solved else "last iterate"
    if drawings is not None and beside:
        left, right = _halves(upper, shape.left, 1.0 - shape.left, vertically=False)
        _draw(left, drawings, outcome)
        _fill(right, [_in_rows(others, max(columns, 1))], time)
    elif drawings is not None:
        _draw(upper, drawings, outcome)
    axes = _fill(lower, blocks, time)
    shown = [quantity for group in groups.values() for quantity in group]
    handles = panels.handles(shown, conditions, outcome, phases, _inner_times(module))
    if handles:
        lower.legend(handles=handles, loc="outside lower center", ncols=12)
    _body_bar(lower, axes, bodies)
    title(figure, result, _notes(result, module, groups))
    if drawings is not None:
        # Axes of equal scales find their final place in the second pass of the layout.
        figure.draw_without_rendering()
    return figure


def _inner_times(module: ControlModule) -> str:
    """What times between start and end at which conditions hold are called; nothing where there are none."""
    if not module.metadata.inner_times:
        return ""
    return "waypoint" if module.metadata.waypoints else "inner time"


def _state_rows(
    groups: dict[str, list[Quantity]], samples: Sequence[Measured], bands: Mapping[str, Matrix]
) -> list[Row]:
    """A row for each state with its momentum and multiplier, or for two where there are no momenta, or many states."""
    states, momenta, multipliers = groups["state"], groups["momentum"], groups["multiplier"]
    shown = min(len(states), _MOST_ROWS)
    rows: list[Row] = []
    for i in range(shown):
        # A Hamiltonian system has two equations, and two multipliers, for each coordinate.
        pair = multipliers[i : i + 1] + multipliers[i + len(states) : i + len(states) + 1]
        own: Row = [_state_panel(states[i], samples, bands), *map(_panel, momenta[i : i + 1])]
        rows.append([*own, _panel(*pair) if pair else None])
    if (not momenta and shown > 2) or shown > _MANY:
        rows += [[None] * len(rows[0])] * (shown % 2)
        rows = [left + right for left, right in zip(rows[::2], rows[1::2], strict=True)]
    return rows


def _panel(shown: Quantity, second: Quantity | None = None) -> Panel:
    return Panel(_TITLES[shown.kind], lambda axes: panels.quantity(axes, shown, second))


def _state_panel(shown: Quantity, samples: Sequence[Measured], bands: Mapping[str, Matrix]) -> Panel:
    """A state with the measurements of it, and the band in which it is."""
    own = [sample for sample in samples if sample.expression == shown.name]

    def draw(axes: Any) -> None:
        panels.quantity(axes, shown)
        if shown.name in bands:
            band(axes, shown.t, shown.values, bands[shown.name])
        for sample in own:
            points(axes, sample, shown.values.shape[1])

    return Panel(_TITLES[shown.kind], draw)


def _of_measurements(states: Sequence[Quantity], samples: Sequence[Measured], bodies: int) -> list[Panel]:
    """What was measured of expressions that are no states, and the errors of all that was."""
    shown, names = samples[:_MOST_ROWS], [state.name for state in states]
    beside = [sample for sample in shown if sample.expression not in names]
    panels_of = [Panel("", lambda axes, one=one: fit(axes, one, bodies)) for one in beside]  # type: ignore[misc]
    return panels_of + [
        Panel("errors", lambda axes, one=one: residuals(axes, one, bodies))  # type: ignore[misc]
        for one in shown
    ]


def _others(controls: Sequence[Quantity], conditions: Sequence[Inequality], result: Result) -> list[Panel]:
    """What belongs to no state."""
    found = [_panel(control) for control in controls[:_MOST_ROWS]]
    if len(conditions) > _MOST_INEQUALITIES:
        found.append(Panel("", lambda axes: panels.strip(axes, conditions)))
    else:
        found += [Panel("", lambda axes, one=one: panels.inequality(axes, one)) for one in conditions]  # type: ignore[misc]
    if result.grid is not None:
        t = result.t
        found.append(Panel("", lambda axes: panels.lengths(axes, t)))
    if result.log is not None and len(result.log) > 1:
        log = result.log
        found.append(Panel("", lambda axes: panels.iterations(axes, log), over_time=False))
    return found


def _of_sensitivities(module: ControlModule, result: Result) -> list[Panel]:
    """By how much the cost follows quantities, where there are sensitivities."""
    found = result.sensitivity
    shown = changes(found, quantity_values(module, result)) if found is not None else {}
    return [Panel("", lambda axes: tornado(axes, shown), over_time=False)] if shown else []


def _in_rows(found: Sequence[Panel], columns: int) -> list[Row]:
    padded: Row = [*found, *[None] * (-len(found) % columns)]
    return [padded[first : first + columns] for first in range(0, len(padded), columns)]


def _fill(figure: Any, blocks: Sequence[Sequence[Row]], time: Time) -> list[Any]:
    """Draw blocks of rows below each other; titles stand where the kind changes, times below each block."""
    rows = [row for block in blocks for row in block]
    grid = figure.add_gridspec(len(rows), len(rows[0]))
    made, first = [], 0
    for block in blocks:
        for i, row in enumerate(block):
            for j, panel in enumerate(row):
                if panel is None:
                    continue
                # What comes last takes the room that is left.
                is_last = block is blocks[-1] and i == len(block) - 1 and not any(row[j + 1 :]) and not panel.over_time
                axes = figure.add_subplot(grid[first + i, j:] if is_last else grid[first + i, j])
                panel.draw(axes)
                neighbours = [block[i - 1][j] if i else None, row[j - 1] if j and panel.kind == "controls" else None]
                if panel.kind and not any(other is not None and other.kind == panel.kind for other in neighbours):
                    axes.set_title(panel.kind, loc="left")
                if panel.over_time:
                    below = block[i + 1][j] if i + 1 < len(block) else None
                    ends = below is None or not below.over_time
                    axes.set_xlabel(time.label if ends else "")
                    axes.set_xlim(
                        time.start - 0.02 * (time.end - time.start), time.end + 0.02 * (time.end - time.start)
                    )
                    axes.tick_params(labelbottom=ends)
                    panels.switches(axes, time.switches)
                    panels.inner_times(axes, time.inner)
                made.append(axes)
        first += len(block)
    return made


def _body_bar(figure: Any, axes: Sequence[Any], bodies: int) -> None:
    """The colours of bodies, where they are too many for a legend."""
    if bodies <= MOST_BODY_COLOURS:
        return
    colours = ScalarMappable(BoundaryNorm([i - 0.5 for i in range(bodies + 1)], 256), body_map())
    bar = figure.colorbar(colours, ax=list(axes), location="right", shrink=0.6, aspect=40, pad=0.01, label="body")
    bar.set_ticks(range(0, bodies, math.ceil(bodies / 10)))
    bar.minorticks_off()


@dataclass(frozen=True)
class _Shape:
    """Height of the drawing's band in inches, and which part of its width the drawing needs."""

    height: float
    left: float


def _shape(drawings: Drawings | None, width: float) -> _Shape:
    if drawings is None:
        return _Shape(0.0, 0.0)
    if shapes.bodies_of(drawings.solution) > 1:
        left, right, bottom, top = shapes.extent([drawings.solution, drawings.guess])
        return _Shape(min(5.6, max(2.4, (top - bottom) / (right - left) * (width / 2 - 0.6))) + 0.8, 1.0)
    left, right, bottom, top = shapes.extent([drawings.solution])
    ratio = (top - bottom) / (right - left)
    if ratio < 0.5:
        return _Shape(max(2.4, ratio * (width - 0.6)) + 0.8, 1.0)
    height = min(5.2, max(4.0, 0.62 * width * ratio))
    return _Shape(height + 0.8, min(0.66, max(0.4 * WIDTH / width, (height / ratio + 0.6) / width)))


def _halves(figure: Any, first: float, second: float, vertically: bool = True) -> tuple[Any, Any]:
    """Two parts of a figure, above each other or side by side."""
    ratios = {"height_ratios": [first, second]} if vertically else {"width_ratios": [first, second]}
    one, other = figure.subfigures(2 if vertically else 1, 1 if vertically else 2, **ratios)
    return one, other


def _draw(figure: Any, drawings: Drawings, outcome: str) -> None:
    """The drawing; of several bodies the first guess beside the optimum."""
    if shapes.bodies_of(drawings.solution) == 1:
        shapes.course(figure.add_subplot(), drawings.solution, shapes.extent([drawings.solution]))
        return
    room = shapes.extent([drawings.guess, drawings.solution])
    scenes = {"initial guess": drawings.guess, outcome: drawings.solution}
    for axes, (name, scene) in zip(figure.subplots(1, 2), scenes.items(), strict=True):
        shapes.course(axes, scene, room)
        axes.set_title(name, fontsize=letter_size(11))


def _notes(result: Result, module: ControlModule, groups: dict[str, list[Quantity]]) -> list[str]:
    """Further words of the title: free parameters, and what the figure has no room for."""
    free = [f"{name} = {result.summary[name]:.6g}" for name in module.metadata.free_parameters]
    many = {"states": len(groups["state"]), "controls": len(groups["control"])}
    phases = [f"{module.metadata.phases} phases"] if module.metadata.phases > 1 else []
    return phases + free + [f"{n - _MOST_ROWS} further {kind} not shown" for kind, n in many.items() if n > _MOST_ROWS]
