"""Figures of motions: simulations, connected particles, specimens and closed loops."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, FigureBase, SubFigure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from codegen.drawing import Scene
from codegen.show.figures import panels, shapes
from codegen.show.figures.picture import AMBER, BLUE, CRIMSON, DARK, GREY, RED, Look, letter_size, new_figure
from codegen.show.figures.quantities import angular_velocities, in_unit, label, set_title, title
from codegen.solving.loading import ConnectModule
from codegen.solving.results.result import Result

if TYPE_CHECKING:
    from matplotlib.typing import HashableList


_MOST_COORDINATES = 12
_MOST_IN_A_COLUMN = 4
_MOST_POINTS = 20_000
_MOST_DOTS = 400
_ENERGY = 2.0  # height in inches of the panel of the energy
_ROUNDING = 1e-12  # largest relative change of the energy that counts as rounding error


def simulation_figure(result: Result, drawing: Scene | None = None, unit: str = "") -> Figure:
    """Return the figure of a simulation: each coordinate over time with its phase portrait, the drawing, the energy.

    `unit` is the unit of time. Without inputs and damping the change of the energy is drawn: the error of the scheme.
    States of first-order dynamics have neither a phase portrait nor an energy. Rotations have their angular velocity in
    place of phase portraits.
    """
    names, units, momenta = result.names["q"], {"t": unit, **result.units}, result.names["p"]
    spins = angular_velocities(result) if result.background else {}
    shown = min(len(names), _MOST_COORDINATES)
    columns = 1 if shown <= _MOST_IN_A_COLUMN else 2
    rows = math.ceil(shown / columns)
    row = max(1.5, 2.7 - 0.35 * rows)
    height = rows * row + (_ENERGY if result.energy is not None else 0.0)
    # A wide drawing is placed above the curves, any other drawing at their left.
    width = 10.0 if columns == 1 else 14.0
    curves: FigureBase
    if drawing is None:
        figure = curves = new_figure(width, height + 0.8)
    else:
        room = shapes.extent([drawing])
        ratio = (room[3] - room[2]) / (room[1] - room[0])
        if ratio < 0.5:
            band = min(2.0, max(0.9, ratio * (width - 0.6))) + 0.4
            figure = new_figure(width, height + band + 0.8)
            split = figure.subfigures(2, 1, height_ratios=[band, height])
        else:
            high = max(height, 4.5)
            left = min(0.5 * width, max(0.25 * width, high / ratio))
            figure = new_figure(width + left, high + 0.8)
            split = figure.subfigures(1, 2, width_ratios=[left, width])
        part, curves = cast("tuple[SubFigure, SubFigure]", split)
        # More than two instants of a fast oscillation would suggest a slow one.
        axes = part.add_subplot()
        shapes.course(axes, drawing, room, instants=2)
        axes.set_anchor("C")
    heights = [row] * rows + ([_ENERGY] if result.energy is not None else [])
    grid = curves.add_gridspec(len(heights), 3 * columns, height_ratios=heights)
    stride = max(1, -(-result.t.size // _MOST_POINTS))
    for i in range(shown):
        column, line = divmod(i, rows)
        axes = curves.add_subplot(grid[line, 3 * column : 3 * column + (2 if momenta else 3)])
        t, q = result.t[::stride], result.q[::stride, i]
        axes.plot(t, q, color=BLUE, linewidth=1.2)
        axes.plot(t[0], q[0], "o", color=AMBER, markersize=5, label="start")
        _draw_events(axes, result, i, is_labelled=i == 0)
        axes.margins(x=0.01)
        panels.widen_if_flat(axes, q)
        axes.set_ylabel(in_unit(label(names[i]), units.get(names[i], "")))
        if i == 0:  # the legend is above the panel, away from curves
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), handletextpad=0.1, borderaxespad=0.0)
        is_lowest = line == rows - 1 or i == shown - 1
        axes.set_xlabel(in_unit("time", units["t"]) if is_lowest else "")
        axes.tick_params(labelbottom=is_lowest)
        if not momenta:
            continue
        portrait, p = curves.add_subplot(grid[line, 3 * column + 2]), result.p[::stride, i]
        if i in spins:  # a portrait of a quaternion means little
            symbol, rate = label(spins[i].name), spins[i].values[:, 0]
            portrait.plot(t, rate[::stride], color=BLUE, linewidth=1.2)
            portrait.set_ylabel(symbol)
            portrait.set_xlabel(in_unit("time", units["t"]) if is_lowest else "")
            portrait.margins(x=0.01)
            panels.widen_if_flat(portrait, rate)
            continue
        portrait.plot(q, p, color=BLUE, linewidth=0.8 if q.size <= 2000 else 0.5, alpha=0.6)
        if q.size <= _MOST_DOTS:
            portrait.plot(q, p, ".", color=BLUE, markersize=2.5)
        portrait.plot(q[0], p[0], "o", color=AMBER, markersize=5)
        portrait.set_xlabel(in_unit(label(names[i]), units.get(names[i], "")))
        portrait.set_ylabel(in_unit(label(momenta[i]), units.get(momenta[i], "")))
        portrait.margins(0.08)
        panels.say_if_conserved(portrait, p)
    if result.energy is not None:
        axes = curves.add_subplot(grid[rows, :])
        assert result.energy is not None, "a mechanical system has energies"
        energy, t = result.energy, result.t[::stride]
        is_conserved = "energy_drift" in result.summary
        axes.plot(t, (energy - energy[0] if is_conserved else energy)[::stride], color=RED, linewidth=1.2)
        axes.set_xlabel(in_unit("time", units["t"]))
        axes.set_ylabel(in_unit("change of energy" if is_conserved else "energy", units.get("energy", "")))
        axes.margins(x=0.01)
        finite = energy[np.isfinite(energy)]
        size = float(np.abs(finite).max(initial=0.0))
        drift = float(np.ptp(finite)) if finite.size else 0.0
        if is_conserved and finite.size == energy.size and drift <= _ROUNDING * size:
            if size:
                axes.set_ylim(-1e-9 * size, 1e-9 * size)
            axes.set_title(panels.conserved_to(drift), loc="right")
    more = len(names) - shown
    title(figure, result, [f"{more} further coordinates not shown"] if more > 0 else [])
    if drawing is not None:
        figure.draw_without_rendering()  # axes of equal scales need a second pass of the layout
    return figure


def _draw_events(axes: Axes, result: Result, i: int, is_labelled: bool) -> None:
    """Mark the events on the curve of coordinate number i."""
    if result.events is None or len(result.events) == 0:
        return
    events = result.events
    stride = max(1, -(-len(events) // _MOST_POINTS))
    at = events.t[::stride], events.after[::stride, i]
    axes.plot(*at, "|", color=CRIMSON, markersize=7, label="event" if is_labelled else None)


def connect_figure(module: ConnectModule, result: Result) -> Figure:
    """Return the figure of connected particles: paths in the plane of two coordinates, and the Hamiltonian's change."""
    assert result.energy is not None, "a motion has energies"
    dimension = len(module.metadata.coordinates)
    paths = result.q.reshape(result.t.size, -1, dimension)
    second = 1 if dimension > 1 else 0
    figure = new_figure(7.0, 8.6)
    axes, below = figure.subplots(2, 1, height_ratios=[5.0, 1.2])
    x, y = paths[:, :, 0], paths[:, :, second]
    axes.plot(x, y, color=BLUE, linewidth=1.1, alpha=0.9)
    axes.plot(x[0], y[0], "x", color=DARK, markersize=5, label="start")
    axes.plot(x[-1], y[-1], ".", color=AMBER, markersize=7, label="end")
    if np.isfinite(result.summary["domain_margin"]):
        axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, color=GREY, linewidth=1.0))
    axes.set_aspect("equal")
    axes.legend(loc="upper right")
    below.plot(result.t, result.energy - result.energy[0], color=RED, linewidth=1.2)
    below.set_xlabel("time")
    below.set_ylabel("change of H")
    below.margins(x=0)
    title(figure, result)
    return figure


MOST_NAMED = 80  # largest number of specimens whose names are drawn


def specimen_figure(points: NDArray[np.float64], names: Sequence[str], share: float) -> Figure:
    """Return a map of specimens at points (m, 2); `share` is the fraction of geodesic distances that it explains."""
    figure = new_figure(7.0, 6.0)
    axes = figure.add_subplot()
    axes.scatter(points[:, 0], points[:, 1], s=18, color=BLUE)
    for name, point in zip(names[: MOST_NAMED if len(names) <= MOST_NAMED else 0], points, strict=False):
        axes.annotate(name, point, xytext=(4, 3), textcoords="offset points", fontsize=letter_size(7), color=DARK)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(f"{len(names)} specimens by geodesic distance, {share:.0%} of it in two dimensions", loc="left")
    axes.set_xlabel("first direction")
    axes.set_ylabel("second direction")
    return figure


MOST_STATES, MOST_INPUTS = 12, 8  # largest numbers of panels for states and for inputs

References: TypeAlias = Mapping[str, Callable[[float], float]]
"""Reference trajectories of states or inputs by name, as functions of time."""

_MILLI = 1e3
_COLUMNS = (1, 1, 2, 3, 4, 3, 3, 4, 4)  # number of columns of panels, indexed by the number of inputs
_REFERENCE: Look = {"color": GREY, "linestyle": (0, (4, 2)), "linewidth": 1.1, "zorder": 1.8}
_CROSS: Look = {"color": CRIMSON, "marker": "x", "linestyle": "none", "markersize": 5, "zorder": 3.0}


def closed_loop_figure(loop: Any, references: References) -> Figure:
    """Return the figure of a `codegen.ClosedLoop`: states with measurements, inputs, and latencies with the deadline.

    Crosses mark missed deadlines, and inputs taken from an earlier plan.
    """
    states, inputs = loop.state_names[:MOST_STATES], loop.input_names[:MOST_INPUTS]
    columns = 2 if len(states) <= 4 else 3
    parts = math.lcm(columns, _COLUMNS[len(inputs)])
    rows = [*_rows("state", len(states), columns, parts), *_rows("input", len(inputs), _COLUMNS[len(inputs)], parts)]
    figure = new_figure(3.4 * columns + 1.0, 1.0 + 1.7 * len(rows) + 2.0)
    all_axes = figure.subplot_mosaic([*rows, ["latency"] * parts], height_ratios=[1.7] * len(rows) + [2.0])
    for i, name in enumerate(states):
        axes = all_axes[f"state {i}"]
        axes.plot(loop.times[:-1], loop.measured[:, i], ".", color=AMBER, markersize=2.5, alpha=0.7, zorder=1.5)
        axes.plot(loop.times, loop.states[:, i], color=BLUE, linewidth=1.4)
        _finish(axes, loop, name, references)
    fallbacks = np.flatnonzero(loop.fell_back)
    for i, name in enumerate(inputs):
        axes = all_axes[f"input {i}"]
        axes.stairs(loop.inputs[:, i], loop.times, baseline=None, color=RED, linewidth=1.2)
        if fallbacks.size:
            axes.plot(loop.times[fallbacks], loop.inputs[fallbacks, i], **_CROSS, label="of the plan before")
            if i == 0:
                panels.legend_above(axes, 4)
        _finish(axes, loop, name, references)
    if loop.latencies.size:  # in milliseconds on a logarithmic scale
        axes, times, latencies, late = all_axes["latency"], loop.times[:-1], _MILLI * loop.latencies, ~loop.in_time
        axes.set_yscale("log")
        axes.plot(times, latencies, ".", color=GREY, markersize=3)
        if late.any():
            axes.plot(times[late], latencies[late], **_CROSS, label="missed")
        for percent, name, colour in ((50.0, "median", BLUE), (99.9, "99.9 %", AMBER)):
            axes.axhline(float(np.percentile(latencies, percent)), color=colour, linewidth=1.2, label=name)
        if loop.deadline is not None:
            axes.axhline(_MILLI * loop.deadline, color=CRIMSON, linewidth=1.0, linestyle=(0, (5, 3)), label="deadline")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
        axes.set_xlabel("time")
        axes.set_ylabel("latency (ms)")
        axes.margins(x=0)
        panels.legend_above(axes, 4)
    shown = ((states, loop.state_names, "states"), (inputs, loop.input_names, "inputs"))
    notes = [f"{len(b) - len(a)} further {what} not shown" for a, b, what in shown if a != b]
    outcome = [f"{n} {status}" for status, n in Counter(loop.statuses.tolist()).most_common()]
    if loop.deadline is not None:
        outcome += [f"{int((~loop.in_time).sum())} of {loop.in_time.size} deadlines missed"]
    outcome += [f"ENDED EARLY: {loop.message}"] if loop.message else []
    set_title(figure, loop.title, [f"{loop.in_time.size} sampling times", *outcome, *notes], bool(loop.message))
    return figure


def _rows(kind: str, count: int, columns: int, parts: int) -> list[HashableList[str]]:
    """Return rows of panel names for `subplot_mosaic`: `columns` panels in a row of `parts` cells."""
    names = [*(f"{kind} {i}" for i in range(count)), *["."] * (-count % columns)]
    rows = [names[first : first + columns] for first in range(0, count, columns)]
    return [[name for name in row for _ in range(parts // columns)] for row in rows]


def _finish(axes: Axes, loop: Any, name: str, references: References) -> None:
    if name in references:
        fine = np.linspace(loop.times[0], loop.times[-1], max(400, 2 * loop.times.size))
        axes.plot(fine, [references[name](t) for t in fine.tolist()], **_REFERENCE)
    axes.set_ylabel(label(name))
    axes.margins(x=0)
