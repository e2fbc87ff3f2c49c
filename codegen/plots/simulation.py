"""The figure of a simulation: drawing, phase portraits, and the error of the energy over time."""

from __future__ import annotations

from typing import Any

from matplotlib.figure import Figure

from codegen.drawing import Scene
from codegen.plots import shapes
from codegen.plots.style import AMBER, BLUE, RED, label, title
from codegen.solutions.result import Result

_MOST_PANELS = 12
_MOST_POINTS = 20_000


def simulation_figure(result: Result, drawing: Scene | None = None, unit: str = "") -> Figure:
    """Phase portrait of every coordinate, the drawing, and the error of the energy; `unit` stands behind the time."""
    assert result.energy is not None, "a simulation has energies"
    shown = min(len(result.names["q"]), _MOST_PANELS)
    names = [*(f"phase{i}" for i in range(shown)), *(["drawing"] if drawing is not None else [])]
    columns = min(len(names), 4 if len(names) > 6 else 3)
    padded = [*names, *["."] * (-len(names) % columns)]
    rows: list[Any] = [padded[first : first + columns] for first in range(0, len(padded), columns)]
    size = max(6.5, 4.0 * columns), 1.2 + 3.4 * len(rows) + 2.1
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplot_mosaic([*rows, ["energy"] * columns], height_ratios=[3.4] * len(rows) + [2.0])
    stride = max(1, -(-result.t.size // _MOST_POINTS))
    for i in range(shown):
        _phase_portrait(panels[f"phase{i}"], result, i, stride)
    if drawing is not None:
        # Instants of an oscillation, taken at long intervals, would show another one.
        shapes.course(panels["drawing"], drawing, shapes.extent([drawing]), instants=2)
    axes = panels["energy"]
    axes.plot(result.t[::stride], (result.energy - result.energy[0])[::stride], color=RED, linewidth=1.2)
    axes.set_xlabel(f"time ({unit})" if unit else "time")
    axes.set_ylabel("change of energy")
    axes.margins(x=0)
    more = len(result.names["q"]) - shown
    title(figure, result, [f"{more} further coordinates not shown"] if more > 0 else [])
    return figure


def _phase_portrait(axes: Any, result: Result, i: int, stride: int) -> None:
    q, p = result.q[::stride, i], result.p[::stride, i]
    few = q.size <= 2000
    axes.plot(q, p, color=BLUE, linewidth=0.8 if few else 0.5, alpha=0.6)
    if few:
        axes.plot(q, p, ".", color=BLUE, markersize=3)
    axes.plot(q[0], p[0], "o", color=AMBER, markersize=6, label="start")
    axes.set_xlabel(label(result.names["q"][i]))
    axes.set_ylabel(label(result.names["p"][i]))
    axes.margins(0.08)
    axes.legend(loc="upper right", handletextpad=0.2)
