"""The Pareto front of a sweep: two numbers of each case, and the cases than which no other one is better in both."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen.plots.objectives import Objective, is_dominated, values_of
from codegen.plots.purposes import new_figure
from codegen.plots.style import BLUE, CRIMSON, DARK, GREY, body_map, heading, label, quantity, statuses

if TYPE_CHECKING:
    from xarray import Dataset

_WIDE = 100.0
"""Positive values whose largest is so many times the smallest are drawn on a logarithmic scale."""
_EDGE = 0.02
"""Where failed cases stand, in parts of the panel."""
_FAILED: dict[str, Any] = {"color": CRIMSON, "marker": "x", "linestyle": "none", "markersize": 5.5, "zorder": 3.0}
_WORDS = {"start": "at the start", "end": "at the end", "max": "at its largest", "min": "at its smallest"}


def pareto_figure(data: Dataset, objectives: tuple[Objective, Objective]) -> Figure:
    """A page about two objectives of a sweep, as `codegen.sweep` returns it.

    The front is a line through its cases; what is dominated is lighter. Failed cases have no objectives but those that
    vary: by these they are crosses at the edge, and else told by their number alone. Cases of the front have the colour
    of the first quantity that varies beside.
    """
    figure = new_figure(8.6, 5.6)
    axes = figure.subplots()
    one, other = (values_of(objective, data).ravel() for objective in objectives)
    solved = statuses(data).ravel() == "solved"
    one_solved, other_solved = np.where(solved, one, np.nan), np.where(solved, other, np.nan)
    dominated = is_dominated(objectives[0].sign * one_solved, objectives[1].sign * other_solved)
    there = np.isfinite(one_solved) & np.isfinite(other_solved)
    front, beside = np.flatnonzero(there & ~dominated), np.flatnonzero(dominated)
    size = max(3.0, min(6.0, 6.0 * np.sqrt(300.0 / max(1, solved.size))))
    axes.plot(
        one[beside], other[beside], ".", color=GREY, alpha=0.35, markersize=1.6 * size, zorder=2.0, label="dominated",
        markeredgewidth=0.0, rasterized=True,
    )  # fmt: skip
    front = front[np.argsort(one[front], kind="stable")]
    axes.plot(one[front], other[front], "-", color=DARK, linewidth=1.0, zorder=2.2)
    _front(figure, axes, data, _first_varied(data, objectives), (one, other), front, size)
    if not solved.all():
        _failed(axes, one[~solved], other[~solved])
    for objective, values, is_first in ((objectives[0], one, True), (objectives[1], other, False)):
        # Its name, with the direction that is better, and its scale.
        named = _named(objective.name) + (" (larger is better)" if objective.is_large else "")
        (axes.set_xlabel if is_first else axes.set_ylabel)(named)
        finite = values[np.isfinite(values)]
        if finite.size > 1 and finite.min() > 0.0 and finite.max() > _WIDE * finite.min():
            (axes.set_xscale if is_first else axes.set_yscale)("log")
    handles, names = axes.get_legend_handles_labels()
    shown = [(handle, name) for handle, name in zip(handles, names) if name != "dominated" or beside.size]
    figure.legend(*zip(*shown), loc="outside lower center", ncols=len(shown))
    heading(figure, data)
    return figure


def _front(
    figure: Figure,
    axes: Any,
    data: Dataset,
    name: str | None,
    values: tuple[NDArray[np.float64], NDArray[np.float64]],
    front: NDArray[np.intp],
    size: float,
) -> None:
    """The cases of the front, in the colours of a quantity that varies, if there is one."""
    one, other = values
    if name is None:
        axes.plot(one[front], other[front], "-o", color=BLUE, markersize=size, linewidth=1.0, zorder=2.5, label="front")
        return
    places = values_of(Objective(name, is_large=False), data).ravel()
    shades = ScalarMappable(Normalize(float(places.min()), float(places.max())), body_map())
    colours = shades.to_rgba(places[front])
    axes.plot([], [], "-o", color=DARK, markersize=size, linewidth=1.0, label="front")
    axes.scatter(one[front], other[front], s=size**2, c=colours, zorder=2.5, linewidths=0.0)
    figure.colorbar(shades, ax=axes, label=quantity(name), aspect=30).outline.set_visible(False)


def _first_varied(data: Dataset, objectives: tuple[Objective, Objective]) -> str | None:
    """The first quantity of numbers along the cases that has several values, and is no objective."""
    shown = {objective.name for objective in objectives}
    for name, coordinate in data.coords.items():
        along = coordinate.dims and coordinate.dims[0] in data["status"].dims
        if (
            along
            and name not in shown
            and coordinate.dtype.kind in "fiub"
            and coordinate.size > 1
            and np.ptp(coordinate.values) > 0.0
        ):
            return str(name)
    return None


def _failed(axes: Any, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """Cases that failed: where an objective is what varies at its edge of the panel, and how many they are."""
    has_x, has_y, look = np.isfinite(x).all(), np.isfinite(y).all(), {**_FAILED}
    at_foot, at_side = np.full(x.size, _EDGE), np.full(y.size, _EDGE)
    if has_x and has_y:
        axes.plot(x, y, **look)
    elif has_x:
        axes.plot(x, at_foot, **look, transform=axes.get_xaxis_transform(), clip_on=False)
    elif has_y:
        axes.plot(at_side, y, **look, transform=axes.get_yaxis_transform(), clip_on=False)
    is_seen = bool(has_x or has_y)
    name = f"{x.size} failed" if is_seen else f"{x.size} failed: no objectives"
    axes.plot([], [], **(look if is_seen else {**look, "marker": ""}), label=name)


def _named(name: str) -> str:
    """What an objective is called."""
    word, dot, own = name.partition(".")
    if word == "d_cost":
        return f"derivative of the cost by {quantity(own)}"
    if dot:
        return f"{label(own)} {_WORDS[word]}"
    return name if name in ("cost", "duration") else label(name)
