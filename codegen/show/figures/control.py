"""The figure of an optimum: drawing, states, momenta, multipliers, controls, path inequalities, iterations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import MaxNLocator

from codegen.drawing import Scene
from codegen.errors import ArgumentError
from codegen.show.figures import panels, shapes
from codegen.show.figures.picture import (
    AMBER,
    BLUE,
    DARK,
    GREY,
    MOST_BODY_COLOURS,
    Look,
    body_colours,
    body_map,
    letter_size,
    new_figure,
    present_style,
)
from codegen.show.figures.quantities import (
    Inequality,
    Quantity,
    angular_velocities,
    by_expression,
    in_unit,
    inequalities_of_segments,
    label,
    quantities_of_segments,
    quantity,
    title,
)
from codegen.solving.loading import ControlModule, Matrix, Vector, time_grid
from codegen.solving.results.estimates import Fit
from codegen.solving.results.result import Result, Sensitivities
from codegen.solving.results.sensitivities import quantity_values

PART = 0.01  # relative change of each quantity for the bars of the tornado diagram
MOST = 8  # largest number of bars in the tornado diagram


def changes(sensitivities: Sensitivities, values: Mapping[str, Vector]) -> dict[str, float]:
    """Return the first-order change of the cost for one percent more of each quantity, the largest change first.

    `values` has the values (bodies,) of each quantity. Quantities that are zero or differ among bodies are left out.
    """
    if sensitivities.reason:
        return {}
    single = {name: float(own[0]) for name, own in values.items() if own[0] != 0.0 and np.all(own == own[0])}
    rates = zip(sensitivities.names, sensitivities.costs)
    every = {name: float(rate) * PART * abs(single[name]) for name, rate in rates if name in single}
    nonzero = {name: change for name, change in every.items() if change != 0.0 and np.isfinite(change)}
    return dict(sorted(nonzero.items(), key=lambda pair: -abs(pair[1])))


def tornado(axes: Axes, shown: Mapping[str, float]) -> None:
    """Draw the changes of the cost for one percent more and less of each quantity, as horizontal bars."""
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
    panels.legend_above(axes, 2, handlelength=1.2)


_POINTS: Look = {
    "linestyle": "none", "marker": "o", "markersize": 3.2, "markerfacecolor": "none", "zorder": 3,
}  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """A column of measurements: its name, the measured expression, and arrays (n,) with an entry for each row.

    `fitted` are the values of the motion at the times `t`. `errors` are divided by standard deviations if
    `is_weighted`.
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
    """Return the columns of measurements that a result was fitted to, or an empty list."""
    observations = module.metadata.observations
    if observations is None or result.unknowns is None:
        return []
    fit = Fit(module, time_grid(module, result.steps, result.grid), result.unknowns)
    columns = zip(
        observations.columns, observations.values, observations.sigmas, fit.measured.T, fit.fitted.T, fit.errors.T,
        strict=True,
    )  # fmt: skip
    return [
        Measured(name, expression, fit.bodies, fit.times, values, fitted, errors, sigma is not None)
        for name, expression, sigma, values, fitted, errors in columns
    ]


def bands(module: ControlModule, result: Result) -> dict[str, Matrix]:
    """Return the half widths (N + 1, bodies) of 95 % confidence bands by state; empty without finite estimates."""
    estimates, names = result.estimates, tuple(module.metadata.coordinates)
    if estimates is None or not np.isfinite(estimates.unknown_errors).all():
        return {}
    nodes, _ = module.views(time_grid(module, result.steps, result.grid), estimates.unknown_errors)
    return {name: estimates.quantile * nodes[:, :, i].T for i, name in enumerate(names)}


def points(axes: Axes, shown: Measured, count: int) -> None:
    """Draw measurements as points; `count` is the number of bodies."""
    for body, colour in enumerate(body_colours(count, DARK)):
        own = shown.bodies == body
        axes.plot(shown.t[own], shown.values[own], color=colour, **_POINTS)


def fit(axes: Axes, shown: Measured, count: int) -> None:
    """Draw measurements as points, and the fitted motion at their times; `count` is the number of bodies."""
    for body, colour in enumerate(body_colours(count, BLUE)):
        own = shown.bodies == body
        axes.plot(shown.t[own], shown.fitted[own], color=colour, linewidth=1.4)
    points(axes, shown, count)
    axes.set_ylabel(label(shown.name))


def residuals(axes: Axes, shown: Measured, count: int) -> None:
    """Draw the residuals (motion minus measurement) over time; `count` is the number of bodies."""
    axes.axhline(0.0, color=GREY, linewidth=0.8)
    for body, colour in enumerate(body_colours(count, BLUE)):
        own = (shown.bodies == body) & np.isfinite(shown.errors)
        axes.vlines(shown.t[own], 0.0, shown.errors[own], color=colour, linewidth=1.0)
        axes.plot(shown.t[own], shown.errors[own], color=colour, **_POINTS)
    axes.set_ylabel(f"{shown.name}, by $\\sigma$" if shown.is_weighted else shown.name)


WIDTH, WIDE = 12.0, 16.0  # width of the figure in inches; a wide figure has two coordinates with momenta in each row
_COLUMN, _MOST_IN_COLUMN = 7.0, 3
"""Width of a figure of one column of chosen panels, and the largest number of panels in it."""

_MOST_ROWS = 12
_MOST_INEQUALITIES = 4
_MANY = 6
_MOST_BESIDE, _MOST_COLUMNS_BESIDE = 4, 3
_TITLES = {
    "state": "states",
    "momentum": "momenta",
    "spin": "angular velocity",
    "multiplier": "multipliers",
    "control": "controls",
}


@dataclass(frozen=True)
class Panel:
    """A panel: its kind (a title), the function that draws it, and True if its abscissa is time."""

    kind: str
    draw: Callable[[Axes], None]
    over_time: bool = True


Row = list[Panel | None]


@dataclass(frozen=True)
class Time:
    """The time axis of panels: label, limits, switches between phases, and times of point constraints."""

    label: str
    start: float
    end: float
    switches: tuple[float, ...] = ()
    inner: tuple[float, ...] = ()


@dataclass(frozen=True)
class Drawings:
    """The drawing of a problem along the solution and along the initial guess."""

    solution: Scene
    guess: Scene


def control_figure(
    module: ControlModule,
    result: Result,
    drawings: Drawings | None = None,
    unit: str = "",
    chosen: Sequence[str] | None = None,
) -> Figure:
    """Return the figure of an optimum on one page; `unit` is the unit of time.

    Each state has a row with its momentum and multiplier. Controls, path inequalities and iterations follow, or stand
    to the right of the drawing of a single body if they fit. The drawing of several bodies shows the initial guess and
    the optimum, or the optimum alone in a style without initial guess. The panels `chosen` by names of quantities and
    conditions replace all others. Raises ArgumentError for an unknown name.
    """
    groups, conditions = quantities_of_segments(module, result), inequalities_of_segments(module, result)
    style, spins = present_style(), angular_velocities(result) if module.metadata.bodies == 1 else {}
    groups["spin"] = [*spins.values()]
    if not style.has_details:
        groups["multiplier"] = []
    if chosen is not None or not style.has_guess:
        groups = {kind: [replace(one, guess=None) for one in group] for kind, group in groups.items()}
    samples, bodies = measured(module, result), int(module.metadata.bodies)
    states = _state_rows(groups, spins, samples, bands(module, result) if samples else {})
    others = [_panel(control) for control in groups["control"][:_MOST_ROWS]]
    constrained = by_expression(conditions)
    if len(constrained) > _MOST_INEQUALITIES:
        others.append(Panel("", partial(panels.strip, shown=conditions)))
    else:
        others += [Panel("", partial(panels.inequality, shown=group)) for group in constrained]
    if result.grid is not None:
        others.append(Panel("", partial(panels.lengths, t=result.t)))
    if result.log is not None and len(result.log) > 1 and style.has_details:
        others.append(Panel("", partial(panels.iterations, log=result.log), over_time=False))
    # Add measured expressions that are not states, and the residuals of all measurements.
    names, drawn = [state.name for state in groups["state"]], samples[:_MOST_ROWS]
    others += [Panel("", partial(fit, shown=one, count=bodies)) for one in drawn if one.expression not in names]
    others += [Panel("errors", partial(residuals, shown=one, count=bodies)) for one in drawn]
    if result.sensitivity is not None and (bars := changes(result.sensitivity, quantity_values(module, result))):
        others.append(Panel("", lambda axes: tornado(axes, bars), over_time=False))
    others.sort(key=lambda panel: not panel.over_time)
    if chosen is not None:
        states, others, drawings = _chosen_rows(chosen, groups, conditions, samples), [], None
        groups = {kind: [one for one in group if one.name in chosen] for kind, group in groups.items()}
        conditions = [one for one in conditions if one.name in chosen or one.expression in chosen]
    width = WIDE if len(states[0]) > 4 else WIDTH if len(states[0]) > 1 or chosen is None else _COLUMN
    band_height, part = _drawing_size(drawings, width)
    columns = math.ceil(len(others) / _MOST_BESIDE)
    beside = 0.0 < part < 1.0 and columns <= (_MOST_COLUMNS_BESIDE if width == WIDE else 1) and not style.is_slide
    blocks = [states] if beside else [states, _in_rows(others, len(states[0]))]
    count = sum(map(len, blocks))
    height = max(1.2, 2.1 - 0.09 * count) * count + 0.6
    size = width, 0.9 + height + (0.0 if style.is_slide else band_height)
    figure = new_figure(*size, ConstrainedLayoutEngine(w_pad=0.06, h_pad=0.05))
    upper: FigureBase = figure
    lower: FigureBase = figure
    if drawings is not None:
        split = (
            figure.subfigures(1, 2, width_ratios=[0.45, 0.55])
            if style.is_slide
            else figure.subfigures(2, 1, height_ratios=[band_height, height])
        )
        upper, lower = cast("tuple[SubFigure, SubFigure]", split)
    metadata = module.metadata
    inner_name = ("waypoint" if metadata.waypoints else "inner time") if metadata.inner_times else ""
    inner = result.t[list(time_grid(module, result.steps, result.grid).inner)] if inner_name else ()
    switches = result.t[result.steps : -1 : result.steps]
    time = Time(
        in_unit("time", result.units.get("t", unit)), float(result.t[0]), float(result.t[-1]),
        tuple(map(float, switches)), tuple(map(float, inner)),
    )  # fmt: skip
    outcome = "optimum" if result.solved else "last iterate"
    if drawings is not None and beside:
        left, right = cast("tuple[SubFigure, SubFigure]", upper.subfigures(1, 2, width_ratios=[part, 1.0 - part]))
        _draw(left, drawings, outcome)
        _fill(right, [_in_rows(others, max(columns, 1))], time)
    elif drawings is not None:
        _draw(upper, drawings, outcome)
    axes = _fill(lower, blocks, time)
    shown = [quantity for group in groups.values() for quantity in group]
    handles = panels.handles(shown, conditions, outcome, int(metadata.phases), inner_name)
    if handles:
        lower.legend(handles=handles, loc="outside lower center", ncols=4 if width == _COLUMN else 12)
    if bodies > MOST_BODY_COLOURS:  # a colour bar replaces the legend
        colours = ScalarMappable(BoundaryNorm([i - 0.5 for i in range(bodies + 1)], 256), body_map())
        bar = lower.colorbar(colours, ax=axes, location="right", shrink=0.6, aspect=40, pad=0.01, label="body")
        bar.set_ticks(range(0, bodies, math.ceil(bodies / 10)))
        bar.minorticks_off()
    # Notes in the title: free parameters, and the numbers of omitted panels.
    notes = [f"{metadata.phases} phases"] if metadata.phases > 1 else []
    notes += [f"{name} = {result.summary[name]:.6g}" for name in metadata.free_parameters]
    many = {"states": len(groups["state"]), "controls": len(groups["control"])}
    notes += [f"{n - _MOST_ROWS} further {kind} not shown" for kind, n in many.items() if n > _MOST_ROWS]
    title(figure, result, notes)
    if drawings is not None:
        figure.draw_without_rendering()  # axes of equal scales need a second pass of the layout
    return figure


def _chosen_rows(
    chosen: Sequence[str],
    groups: dict[str, list[Quantity]],
    conditions: Sequence[Inequality],
    samples: Sequence[Measured],
) -> list[Row]:
    """Return the panels of quantities and conditions by name, in one column, or in two if there are many."""
    drawn: dict[str, Panel] = {}
    for kind, group in groups.items():
        for one in group:
            panel = _state_panel(one, samples, {}) if kind == "state" else _panel(one)
            drawn.setdefault(one.name, replace(panel, kind=""))
    for constrained in by_expression(conditions):
        panel = Panel("", partial(panels.inequality, shown=constrained))
        for name in (name for one in constrained for name in (one.name, one.expression) if name):
            drawn.setdefault(name, panel)
    names = [chosen] if isinstance(chosen, str) else list(chosen)
    if unknown := [name for name in names if name not in drawn] or ([] if names else ["(none)"]):
        raise ArgumentError(f"there is no panel {unknown[0]}", f"choose from {', '.join(drawn)}")
    return _in_rows([drawn[name] for name in names], 1 if len(names) <= _MOST_IN_COLUMN else 2)


def _state_rows(
    groups: dict[str, list[Quantity]],
    spins: Mapping[int, Quantity],
    samples: Sequence[Measured],
    bands: Mapping[str, Matrix],
) -> list[Row]:
    """Return a row of panels for each state with its momentum and multiplier; many states have two in a row.

    Quaternions have the angular velocity in place of momenta, which mean little.
    """
    states, momenta, multipliers = groups["state"], groups["momentum"], groups["multiplier"]
    shown = min(len(states), _MOST_ROWS)
    rows: list[Row] = []
    for i in range(shown):
        # A Hamiltonian system has two equations, and two multipliers, for each coordinate.
        pair = multipliers[i : i + 1] + multipliers[i + len(states) : i + len(states) + 1]
        rates = [spins[i]] if i in spins else momenta[i : i + 1]
        own: Row = [_state_panel(states[i], samples, bands), *map(_panel, rates)]
        if present_style().has_details:
            own.append(_panel(*pair) if pair else None)
        rows.append(own)
    if (not momenta and shown > 2) or shown > _MANY:
        rows += [[None] * len(rows[0])] * (shown % 2)
        rows = [left + right for left, right in zip(rows[::2], rows[1::2], strict=True)]
    return rows


def _panel(shown: Quantity, second: Quantity | None = None) -> Panel:
    return Panel(_TITLES[shown.kind], lambda axes: panels.quantity(axes, shown, second))


def _state_panel(shown: Quantity, samples: Sequence[Measured], bands: Mapping[str, Matrix]) -> Panel:
    """Return the panel of a state with its measurements and its confidence band."""
    own = [sample for sample in samples if sample.expression == shown.name]

    def draw(axes: Axes) -> None:
        panels.quantity(axes, shown)
        if shown.name in bands:
            count, half = shown.values.shape[1], bands[shown.name]
            for column, own_half, colour in zip(shown.values.T, half.T, body_colours(count, BLUE), strict=True):
                edges = column - own_half, column + own_half
                axes.fill_between(shown.t, *edges, color=colour, alpha=0.18, linewidth=0.0, zorder=0.8)
        for sample in own:
            points(axes, sample, shown.values.shape[1])

    return Panel(_TITLES[shown.kind], draw)


def _in_rows(others: Sequence[Panel], columns: int) -> list[Row]:
    padded: Row = [*others, *[None] * (-len(others) % columns)]
    return [padded[first : first + columns] for first in range(0, len(padded), columns)]


def _fill(figure: FigureBase, blocks: Sequence[Sequence[Row]], time: Time) -> list[Axes]:
    """Draw blocks of rows of panels below each other, and return their axes; each new kind of panel has a title."""
    rows = [row for block in blocks for row in block]
    grid = figure.add_gridspec(len(rows), len(rows[0]))
    all_axes: list[Axes] = []
    first = 0
    for block in blocks:
        for i, row in enumerate(block):
            for j, panel in enumerate(row):
                if panel is None:
                    continue
                # The last panel spans the rest of its row.
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
                    for t in time.switches:
                        axes.axvline(t, **panels.SWITCH)
                    for t in time.inner:
                        axes.axvline(t, **panels.INNER)
                all_axes.append(axes)
        first += len(block)
    return all_axes


def _drawing_size(drawings: Drawings | None, width: float) -> tuple[float, float]:
    """Return the height of the drawing in inches, and the fraction of the figure's width that the drawing needs."""
    if drawings is None:
        return 0.0, 0.0
    if _has_two_scenes(drawings):
        left, right, bottom, top = shapes.extent([drawings.solution, drawings.guess])
        return min(5.6, max(2.4, (top - bottom) / (right - left) * (width / 2 - 0.6))) + 0.8, 1.0
    left, right, bottom, top = shapes.extent([drawings.solution])
    ratio = (top - bottom) / (right - left)
    if ratio < 0.5:
        return max(2.4, ratio * (width - 0.6)) + 0.8, 1.0
    height = min(5.2, max(4.0, 0.62 * width * ratio))
    return height + 0.8, min(0.66, max(0.4 * WIDTH / width, (height / ratio + 0.6) / width))


def _draw(figure: FigureBase, drawings: Drawings, outcome: str) -> None:
    """Draw the solution, and the initial guess if `_has_two_scenes`. `outcome` is the solution's title."""
    if not _has_two_scenes(drawings):
        axes = figure.add_subplot()
        shapes.course(axes, drawings.solution, shapes.extent([drawings.solution]))
        if present_style().is_slide:
            axes.set_anchor("C")
        return
    room = shapes.extent([drawings.guess, drawings.solution])
    scenes = {"initial guess": drawings.guess, outcome: drawings.solution}
    for axes, (name, scene) in zip(figure.subplots(1, 2), scenes.items(), strict=True):
        shapes.course(axes, scene, room)
        axes.set_title(name, fontsize=letter_size(11))


def _has_two_scenes(drawings: Drawings) -> bool:
    """Return True if the initial guess is drawn next to the solution, as for several bodies."""
    return shapes.bodies_of(drawings.solution) > 1 and present_style().has_guess
