"""The Pareto front of a sweep: two numbers of each case, and the cases than which no other one is better in both.

Numbers of each case by which cases are compared, by name: what a data set records, or what follows from its arrays. A
Pareto front is the cases of which no other one is better in one objective and at least as good in the other.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen.errors import ArgumentError, clause
from codegen.show.figures.picture import (
    BLUE,
    CRIMSON,
    DARK,
    GREY,
    body_map,
    heading,
    label,
    new_figure,
    quantity,
    statuses,
)

if TYPE_CHECKING:
    from xarray import Dataset


Numbers = NDArray[np.float64]
SAME = 1e-6
"""Parts of the range of an objective that make no difference, as values at the same bound."""
_COLUMNS = {"q": "coordinate", "u": "control"}
_OTHERS = {"residual", "seconds", "improvement"}
"""Numbers that say how a case was solved, and nothing of its solution."""


@dataclass(frozen=True)
class Objective:
    """A number of each case by its name, that is to be small, or large where a minus stands before it."""

    name: str
    is_large: bool

    @property
    def sign(self) -> float:
        """What values are multiplied by to be small."""
        return -1.0 if self.is_large else 1.0


def objectives_of(text: str) -> tuple[Objective, Objective]:
    """The two objectives of `--pareto A,B`; ArgumentError for anything else."""
    words = [word.strip() for word in text.split(",")]
    if len(words) != 2 or not all(word.removeprefix("-") for word in words) or words[0] == words[1]:
        raise ArgumentError(clause(f"--pareto {text}: a front has two objectives"), "write --pareto cost,duration")
    one, other = (Objective(word.removeprefix("-"), word.startswith("-")) for word in words)
    return one, other


def require_objectives(objectives: tuple[Objective, ...], data: Dataset) -> None:
    """Refuse names that mean nothing for a data set; ArgumentError lists those that do."""
    known = _known(data)
    for objective in objectives:
        if objective.name not in known:
            close = difflib.get_close_matches(objective.name, known, 3, 0.5)
            nearest = f"did you mean {' or '.join(close)}? " if close else ""
            finding = f"--pareto {objective.name}: the sweep has no such number of each case"
            raise ArgumentError(clause(finding), clause(f"{nearest}it has {', '.join(known)}"))


def values_of(objective: Objective, data: Dataset) -> Numbers:
    """The values of an objective, an array over the cases; NaN for what is not solved, unless they vary."""
    return _known(data)[objective.name]()


def is_dominated(one: Numbers, other: Numbers) -> NDArray[np.bool_]:
    """Which of n points (n,) are no part of the front where both are to be small; NaN is nowhere.

    Another point is better in one objective by more than SAME, and in the other at most by this worse.
    """
    dominated = np.zeros(one.size, bool)
    (there,) = np.nonzero(np.isfinite(one) & np.isfinite(other))
    if not there.size:
        return dominated
    x, y = one[there], other[there]
    x_same, y_same = SAME * np.ptp(x), SAME * np.ptp(y)
    order = np.argsort(x, kind="stable")
    # The least of the other objective among the first points in the order of the one.
    least = np.concatenate([[np.inf], np.minimum.accumulate(y[order])])
    left = least[np.searchsorted(x[order], x - x_same, side="left")]
    not_right = least[np.searchsorted(x[order], x + x_same, side="right")]
    dominated[there] = (left <= y + y_same) | (not_right < y - y_same)
    return dominated


def _known(data: Dataset) -> dict[str, Callable[[], Numbers]]:
    """What gives the values of each objective by its name."""
    dims = data["status"].dims
    found: dict[str, Callable[[], Numbers]] = {}
    for name, variable in data.data_vars.items():
        if variable.dims == dims and variable.dtype.kind == "f" and name not in _OTHERS:
            found[str(name)] = lambda own=variable: np.asarray(own.values, dtype=float)  # type: ignore[misc]
    if "d_cost" in data:
        for i, by in enumerate(data["by"].values):
            found[f"d_cost.{by}"] = lambda i=i: np.asarray(data["d_cost"].isel(by=i).values)  # type: ignore[misc]
    for array, column in _COLUMNS.items():
        if array in data:
            rows = str(data[array].dims[len(dims)])
            for i, name in enumerate(data[column].values):
                own = data[array].isel({column: i})
                found |= {f"{word}.{name}": _reduced(own, rows, word) for word in ("start", "end", "max", "min")}
    if "t" in data:
        found["duration"] = lambda: _last(data["t"]) - np.asarray(data["t"].isel(node=0).values)
    for name, coordinate in data.coords.items():
        if coordinate.dims and coordinate.dims[0] in dims and coordinate.dtype.kind in "fiub":
            found[str(name)] = lambda own=coordinate: _over_cases(own, data)  # type: ignore[misc]
    return found


def _over_cases(coordinate: Any, data: Dataset) -> Numbers:
    return np.array(coordinate.broadcast_like(data["status"]).transpose(*data["status"].dims).values, dtype=float)


def _reduced(array: Any, rows: str, word: str) -> Callable[[], Numbers]:
    """What a trajectory comes to."""
    ways: Mapping[str, Callable[[], Any]] = {
        "start": lambda: _flat(array).isel({rows: 0}).values,
        "end": lambda: _last(_flat(array)),
        "max": lambda: _flat(array).max(rows).values,
        "min": lambda: _flat(array).min(rows).values,
    }
    return lambda: np.asarray(ways[word](), dtype=float)


def _flat(array: Any) -> Any:
    """Controls at stages by their means on intervals."""
    return array.mean("stage") if "stage" in array.dims else array


def _last(array: Any) -> Numbers:
    """The last values that are numbers: arrays of fewer steps end in NaN."""
    values = np.asarray(array.values, dtype=float)
    number = np.maximum(1, np.isfinite(values).sum(axis=-1)) - 1
    return np.asarray(np.take_along_axis(values, number[..., None], axis=-1)[..., 0])


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
