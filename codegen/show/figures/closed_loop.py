"""The figure of a closed loop: states and inputs over time, and how long each sampling time's solve took."""

from __future__ import annotations

import math
import textwrap
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any, Protocol, TypeAlias

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from codegen.show.figures.picture import letter_size, letters_across, new_figure
from codegen.show.figures.style import AMBER, BLUE, CRIMSON, GREY, RED, label
from codegen.solving.loading import Matrix, Vector

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
