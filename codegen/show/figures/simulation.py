"""The figure of a simulation: drawing, coordinates over time with their phase portraits, and the energy.

The figure of specimens: their places in two dimensions, by the distances between them.

The figure of a closed loop: states and inputs over time, and how long each sampling time's solve took.
"""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol, TypeAlias, cast

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from codegen.drawing import Scene
from codegen.show.figures import panels, shapes
from codegen.show.figures.picture import (
    AMBER,
    BLUE,
    CRIMSON,
    DARK,
    GREY,
    RED,
    Units,
    label,
    letter_size,
    letters_across,
    new_figure,
    title,
)
from codegen.solving.interfaces import ConnectModule, Matrix, Vector
from codegen.solving.results.result import Result

_MOST_COORDINATES = 12
_MOST_IN_A_COLUMN = 4
_MOST_POINTS = 20_000
_MOST_DOTS = 400
_ENERGY = 2.0
"""Inches of the panel of the energy."""

_ROUNDING = 1e-12
"""Changes of the energy below this part of it are rounding."""


def simulation_figure(result: Result, drawing: Scene | None = None, unit: str = "") -> Figure:
    """Every coordinate over time, with its phase portrait, the drawing, and the energy; `unit` stands behind the time.

    Where nothing drives or damps the motion, the energy is shown as its change, which is the scheme's error.
    """
    assert result.energy is not None, "a simulation has energies"
    names, units = result.names["q"], Units.of(result, unit)
    shown = min(len(names), _MOST_COORDINATES)
    columns = 1 if shown <= _MOST_IN_A_COLUMN else 2
    rows = math.ceil(shown / columns)
    row = max(1.5, 2.7 - 0.35 * rows)
    height = rows * row + _ENERGY
    figure, curves = _parts(drawing, 10.0 if columns == 1 else 14.0, height)
    grid = curves.add_gridspec(rows + 1, 3 * columns, height_ratios=[row] * rows + [_ENERGY])
    stride = max(1, -(-result.t.size // _MOST_POINTS))
    for i in range(shown):
        column, place = divmod(i, rows)
        axes = curves.add_subplot(grid[place, 3 * column : 3 * column + 2])
        _over_time(axes, result.t[::stride], result.q[::stride, i], BLUE)
        axes.set_ylabel(units.label(names[i]))
        if i == 0:
            # Above the panel, where no curve can be.
            axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), handletextpad=0.1, borderaxespad=0.0)
        is_lowest = place == rows - 1 or i == shown - 1
        axes.set_xlabel(units.time if is_lowest else "")
        axes.tick_params(labelbottom=is_lowest)
        _phase_portrait(curves.add_subplot(grid[place, 3 * column + 2]), result, i, stride, units)
    _energy(curves.add_subplot(grid[rows, :]), result, stride, units)
    more = len(names) - shown
    title(figure, result, [f"{more} further coordinates not shown"] if more > 0 else [])
    if drawing is not None:
        # Axes of equal scales find their final place in the second pass of the layout.
        figure.draw_without_rendering()
    return figure


def _parts(drawing: Scene | None, width: float, height: float) -> tuple[Figure, Any]:
    """The figure, with the drawing above the curves where it is wide, else at their left, and the place of curves."""
    if drawing is None:
        figure = new_figure(width, height + 0.8)
        return figure, figure
    room = shapes.extent([drawing])
    ratio = (room[3] - room[2]) / (room[1] - room[0])
    if ratio < 0.5:
        band = min(2.0, max(0.9, ratio * (width - 0.6))) + 0.4
        figure = new_figure(width, height + band + 0.8)
        above, curves = cast("Any", figure.subfigures(2, 1, height_ratios=[band, height]))
    else:
        # As high as the curves, which keep most of the width.
        high = max(height, 4.5)
        left = min(0.5 * width, max(0.25 * width, high / ratio))
        figure = new_figure(width + left, high + 0.8)
        above, curves = cast("Any", figure.subfigures(1, 2, width_ratios=[left, width]))
    # Instants of an oscillation, taken at long intervals, would show another one.
    axes = above.add_subplot()
    shapes.course(axes, drawing, room, instants=2)
    axes.set_anchor("C")
    return figure, curves


def _over_time(axes: Any, t: Vector, values: Vector, colour: str) -> None:
    axes.plot(t, values, color=colour, linewidth=1.2)
    axes.plot(t[0], values[0], "o", color=AMBER, markersize=5, label="start")
    axes.margins(x=0.01)
    panels.widen_if_flat(axes, values)


def _phase_portrait(axes: Any, result: Result, i: int, stride: int, units: Units) -> None:
    q, p = result.q[::stride, i], result.p[::stride, i]
    axes.plot(q, p, color=BLUE, linewidth=0.8 if q.size <= 2000 else 0.5, alpha=0.6)
    if q.size <= _MOST_DOTS:
        axes.plot(q, p, ".", color=BLUE, markersize=2.5)
    axes.plot(q[0], p[0], "o", color=AMBER, markersize=5)
    axes.set_xlabel(units.label(result.names["q"][i]))
    axes.set_ylabel(units.label(result.names["p"][i]))
    axes.margins(0.08)
    panels.say_if_conserved(axes, p)


def _energy(axes: Any, result: Result, stride: int, units: Units) -> None:
    """The change of an energy that should stay, and an energy that may change as it is."""
    assert result.energy is not None
    energy, t = result.energy, result.t[::stride]
    is_kept = "energy_drift" in result.summary
    axes.plot(t, (energy - energy[0] if is_kept else energy)[::stride], color=RED, linewidth=1.2)
    axes.set_xlabel(units.time)
    axes.set_ylabel(units.named("change of energy" if is_kept else "energy", "energy"))
    axes.margins(x=0.01)
    finite = energy[np.isfinite(energy)]
    size = float(np.abs(finite).max(initial=0.0))
    drift = float(np.ptp(finite)) if finite.size else 0.0
    if is_kept and finite.size == energy.size and drift <= _ROUNDING * size:
        axes.set_ylim(-1e-9 * size, 1e-9 * size) if size else None
        axes.set_title(panels.conserved_to(drift), loc="right")


def connect_figure(module: ConnectModule, result: Result) -> Figure:
    """Paths in the plane of the first two coordinates, and the change of H, which the exact motion keeps."""
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


MOST_NAMED = 80
"""Of more specimens, names would cover each other."""


def specimen_figure(points: Any, names: Sequence[str], share: float) -> Figure:
    """Points, shape (m, 2), with names; both axes have one scale, that of geodesic distance."""
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


MOST_STATES, MOST_INPUTS = 12, 8
"""Panels of each kind at most."""

References: TypeAlias = Mapping[str, Callable[[float], float]]
"""What states or inputs were to follow, by name, as functions of time."""

_MILLI = 1e3
_COLUMNS = (1, 1, 2, 3, 4, 3, 3, 4, 4)
"""For so many inputs."""
_WANTED: dict[str, Any] = {"color": GREY, "linestyle": (0, (4, 2)), "linewidth": 1.1, "zorder": 1.8}
_FALLEN: dict[str, Any] = {"color": CRIMSON, "marker": "x", "linestyle": "none", "markersize": 5, "zorder": 3.0}


class ClosedLoopData(Protocol):
    """What is drawn of a closed loop, as `codegen.close_loop` returns it."""

    @property
    def title(self) -> str:
        """What the problem is about."""

    @property
    def names(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Those of states and of inputs."""

    @property
    def deadline(self) -> float | None:
        """In seconds."""

    @property
    def message(self) -> str:
        """Why the loop ended early, if it did."""

    @property
    def times(self) -> Vector:
        """(M + 1,)."""

    @property
    def states(self) -> Matrix:
        """(M + 1, states)."""

    @property
    def measured(self) -> Matrix:
        """(M, states)."""

    @property
    def inputs(self) -> Matrix:
        """(M, controls)."""

    @property
    def statuses(self) -> NDArray[np.str_]:
        """(M,)."""

    @property
    def latencies(self) -> Vector:
        """(M,), in seconds."""

    @property
    def in_time(self) -> NDArray[np.bool_]:
        """(M,), whether the deadline was kept."""

    @property
    def fell_back(self) -> NDArray[np.bool_]:
        """(M,), whether the start of the search was applied, as a rule the plan before."""


def closed_loop_figure(loop: ClosedLoopData, references: References) -> Figure:
    """States with what was measured of them, inputs, and latencies with the deadline.

    Sampling times at which the plan before was applied, and deadlines that were missed, are crosses.
    """
    states, inputs = loop.names[0][:MOST_STATES], loop.names[1][:MOST_INPUTS]
    columns = 2 if len(states) <= 4 else 3
    parts = math.lcm(columns, _COLUMNS[len(inputs)])
    rows = [*_rows("state", len(states), columns, parts), *_rows("input", len(inputs), _COLUMNS[len(inputs)], parts)]
    figure = new_figure(3.4 * columns + 1.0, 1.0 + 1.7 * len(rows) + 2.0)
    panels = figure.subplot_mosaic([*rows, ["latency"] * parts], height_ratios=[1.7] * len(rows) + [2.0])
    for i, name in enumerate(states):
        axes = panels[f"state {i}"]
        axes.plot(loop.times[:-1], loop.measured[:, i], ".", color=AMBER, markersize=2.5, alpha=0.7, zorder=1.5)
        axes.plot(loop.times, loop.states[:, i], color=BLUE, linewidth=1.4)
        _finish(panels[f"state {i}"], loop, name, references)
    for i, name in enumerate(inputs):
        _input(panels[f"input {i}"], loop, i)
        _finish(panels[f"input {i}"], loop, name, references)
    if loop.latencies.size:
        _latencies(panels["latency"], loop)
    shown = zip((states, inputs), loop.names, ("states", "inputs"), strict=True)
    # What was controlled, and how its sampling times ended.
    notes = [f"{len(b) - len(a)} further {what} not shown" for a, b, what in shown if a != b]
    outcome = [f"{n} {status}" for status, n in Counter(loop.statuses.tolist()).most_common()]
    if loop.deadline is not None:
        outcome += [f"{int((~loop.in_time).sum())} of {loop.in_time.size} deadlines missed"]
    outcome += [f"ENDED EARLY: {loop.message}"] if loop.message else []
    letters = letters_across(figure)
    texts = loop.title.rstrip("."), ", ".join([f"{loop.in_time.size} sampling times", *outcome, *notes])
    figure.suptitle(
        "\n".join(line for text in texts for line in textwrap.wrap(text, letters)), fontsize=letter_size(11)
    )
    return figure


def _rows(kind: str, count: int, columns: int, parts: int) -> list[Any]:
    """The places of panels in rows of so many columns, each of which takes some of the parts of the figure's width."""
    names = [*(f"{kind} {i}" for i in range(count)), *["."] * (-count % columns)]
    rows = [names[first : first + columns] for first in range(0, count, columns)]
    return [[name for name in row for _ in range(parts // columns)] for row in rows]


def _input(axes: Any, loop: ClosedLoopData, i: int) -> None:
    axes.stairs(loop.inputs[:, i], loop.times, baseline=None, color=RED, linewidth=1.2)
    where = np.flatnonzero(loop.fell_back)
    if where.size:
        axes.plot(loop.times[where], loop.inputs[where, i], **_FALLEN, label="of the plan before")
        if i == 0:
            _legend_above(axes)


def _finish(axes: Any, loop: ClosedLoopData, name: str, references: References) -> None:
    if name in references:
        fine = np.linspace(loop.times[0], loop.times[-1], max(400, 2 * loop.times.size))
        axes.plot(fine, [references[name](t) for t in fine.tolist()], **_WANTED)
    axes.set_ylabel(label(name))
    axes.margins(x=0)


def _latencies(axes: Any, loop: ClosedLoopData) -> None:
    """Latencies in milliseconds on a logarithmic scale."""
    times, latencies, late = loop.times[:-1], _MILLI * loop.latencies, ~loop.in_time
    axes.set_yscale("log")
    axes.plot(times, latencies, ".", color=GREY, markersize=3)
    if late.any():
        axes.plot(times[late], latencies[late], **_FALLEN, label="missed")
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
    _legend_above(axes)


def _legend_above(axes: Any) -> None:
    """Above the panel, where no point can be."""
    axes.legend(loc="lower right", bbox_to_anchor=(1.0, 0.97), ncols=4, fontsize=letter_size(8), columnspacing=1.0)
