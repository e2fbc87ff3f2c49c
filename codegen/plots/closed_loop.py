"""The figure of a closed loop: states and inputs over time, and how long each sampling time's solve took."""

from __future__ import annotations

import textwrap
from collections import Counter
from typing import Any, Protocol

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen.loading import Matrix, Vector
from codegen.plots.style import AMBER, BLUE, CRIMSON, GREY, RED, label

MOST_STATES, MOST_INPUTS = 12, 6
"""Panels of each kind at most."""
_MILLI = 1e3


class ClosedLoopData(Protocol):
    """What is drawn of a closed loop, as `codegen.close_loop` returns it."""

    title: str
    state_names: tuple[str, ...]
    input_names: tuple[str, ...]
    deadline: float | None
    message: str
    times: Vector
    states: Matrix
    measured: Matrix
    inputs: Matrix
    statuses: NDArray[np.str_]
    latencies: Vector
    in_time: NDArray[np.bool_]
    fell_back: NDArray[np.bool_]

    def latency(self, percent: float) -> float:
        """A percentile of the latencies."""


def closed_loop_figure(loop: ClosedLoopData) -> Figure:
    """States with what was measured of them, inputs, and latencies with the deadline.

    Sampling times at which the plan before was applied are marked, and deadlines that were missed.
    """
    states, inputs = loop.state_names[:MOST_STATES], loop.input_names[:MOST_INPUTS]
    columns = 3 if len(states) > 4 else 2
    names = [*(f"state {i}" for i in range(len(states))), *(f"input {i}" for i in range(len(inputs)))]
    padded = [*names, *["."] * (-len(names) % columns)]
    rows: list[Any] = [padded[first : first + columns] for first in range(0, len(padded), columns)]
    figure = Figure(figsize=(4.0 * columns, 1.2 + 1.7 * len(rows) + 2.0), layout="constrained")
    panels = figure.subplot_mosaic([*rows, ["latency"] * columns], height_ratios=[1.7] * len(rows) + [2.0])
    for i, name in enumerate(states):
        _state(panels[f"state {i}"], loop, i, name)
    for i, name in enumerate(inputs):
        _input(panels[f"input {i}"], loop, i, name)
    _latencies(panels["latency"], loop)
    for name in names[:-columns]:
        panels[name].tick_params(labelbottom=False)
    hidden = len(loop.state_names) - len(states), len(loop.input_names) - len(inputs)
    _title(figure, loop, [f"{n} further {what} not shown" for n, what in zip(hidden, ("states", "inputs")) if n])
    return figure


def _state(axes: Any, loop: ClosedLoopData, i: int, name: str) -> None:
    axes.plot(loop.times[:-1], loop.measured[:, i], ".", color=AMBER, markersize=3, alpha=0.7, zorder=1.5)
    axes.plot(loop.times, loop.states[:, i], color=BLUE, linewidth=1.4)
    axes.set_ylabel(label(name))
    axes.margins(x=0)


def _input(axes: Any, loop: ClosedLoopData, i: int, name: str) -> None:
    axes.stairs(loop.inputs[:, i], loop.times, baseline=None, color=RED, linewidth=1.2)
    where = np.flatnonzero(loop.fell_back)
    axes.plot(loop.times[where], loop.inputs[where, i], "x", color=CRIMSON, markersize=4)
    axes.set_ylabel(label(name))
    axes.margins(x=0)


def _latencies(axes: Any, loop: ClosedLoopData) -> None:
    """Latencies in milliseconds on a logarithmic scale."""
    times, latencies = loop.times[:-1], _MILLI * loop.latencies
    axes.semilogy(times, latencies, ".", color=GREY, markersize=3)
    late = ~loop.in_time
    axes.semilogy(times[late], latencies[late], "x", color=CRIMSON, markersize=5, label="missed")
    axes.axhline(_MILLI * loop.latency(50.0), color=BLUE, linewidth=1.0, label="median")
    axes.axhline(_MILLI * loop.latency(99.9), color=AMBER, linewidth=1.0, label="99.9 %")
    if loop.deadline is not None:
        axes.axhline(_MILLI * loop.deadline, color=CRIMSON, linewidth=1.0, linestyle=(0, (5, 3)), label="deadline")
    axes.set_xlabel("time")
    axes.set_ylabel("latency (ms)")
    axes.margins(x=0)
    axes.legend(loc="upper right", ncols=4)


def _title(figure: Figure, loop: ClosedLoopData, notes: list[str]) -> None:
    counts = Counter(loop.statuses.tolist())
    outcome = [f"{n} {status}" for status, n in counts.most_common()]
    missed = int((~loop.in_time).sum())
    outcome += [f"{missed} of {loop.in_time.size} deadlines missed"] if loop.deadline is not None else []
    outcome += [f"ENDED EARLY: {loop.message}"] if loop.message else []
    letters = int(10.0 * figure.get_figwidth())
    texts = loop.title.rstrip("."), ", ".join([f"{loop.in_time.size} sampling times", *outcome, *notes])
    figure.suptitle("\n".join(line for text in texts for line in textwrap.wrap(text, letters)), fontsize=11)
