"""The figure of a Pareto front of a sweep, and the objectives by which cases are compared.

Each objective has a number for every case, which the data set contains or which follows from its arrays. A case is on
the Pareto front if no other case is better in one objective and at least as good in the other.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen.errors import ArgumentError, clause, nearest
from codegen.show.figures.picture import BLUE, CRIMSON, DARK, GREY, Look, body_map, new_figure
from codegen.show.figures.quantities import heading, in_unit, label, quantity, statuses, unit_in
from codegen.show.figures.sweep import is_wide, last_values

if TYPE_CHECKING:
    from xarray import DataArray, Dataset

Numbers = NDArray[np.float64]
SAME = 1e-6  # differences of an objective up to this fraction of its range are ignored, such as at a common bound
_COLUMNS = {"q": "coordinate", "u": "control"}
_OTHERS = {"residual", "seconds", "improvement"}  # numbers about the solve, which cannot be objectives


@dataclass(frozen=True)
class Objective:
    """A number of each case that is minimised, or maximised if `is_large`."""

    name: str
    is_large: bool

    @property
    def sign(self) -> float:
        """The factor with which smaller values are better: -1 for maximisation."""
        return -1.0 if self.is_large else 1.0


def objectives_of(text: str) -> tuple[Objective, Objective]:
    """Return the objectives of the text "A,B" (`-A` is maximised); raises ArgumentError for other texts."""
    words = [word.strip() for word in text.split(",")]
    if len(words) != 2 or not all(word.removeprefix("-") for word in words) or words[0] == words[1]:
        raise ArgumentError(clause(f"--pareto {text}: a front has two objectives"), "write --pareto cost,duration")
    one, other = (Objective(word.removeprefix("-"), word.startswith("-")) for word in words)
    return one, other


def require_objectives(objectives: tuple[Objective, ...], data: Dataset) -> None:
    """Raise ArgumentError with similar names if a data set does not have the objectives."""
    known = _known(data)
    for objective in objectives:
        if objective.name not in known:
            finding = f"--pareto {objective.name}: the sweep has no such number of each case"
            remedy = f"{nearest(objective.name, known, '', 3, 0.5)} it has {', '.join(known)}".strip()
            raise ArgumentError(clause(finding), clause(remedy))


def values_of(objective: Objective, data: Dataset) -> Numbers:
    """Return the values of an objective over the cases; NaN for failed cases, except for varied quantities."""
    return _known(data)[objective.name]()


def is_dominated(one: Numbers, other: Numbers) -> NDArray[np.bool_]:
    """Return a mask (n,) of cases that are not on the front of two minimised objectives; NaN is never dominated.

    A case is dominated if another case is better in one objective by more than SAME, and not worse in the other by more
    than SAME.
    """
    dominated = np.zeros(one.size, bool)
    (finite,) = np.nonzero(np.isfinite(one) & np.isfinite(other))
    if not finite.size:
        return dominated
    x, y = one[finite], other[finite]
    x_same, y_same = SAME * np.ptp(x), SAME * np.ptp(y)
    order = np.argsort(x, kind="stable")
    # least[k] is the smallest second objective of the k points with the smallest first objective.
    least = np.concatenate([[np.inf], np.minimum.accumulate(y[order])])
    left = least[np.searchsorted(x[order], x - x_same, side="left")]
    not_right = least[np.searchsorted(x[order], x + x_same, side="right")]
    dominated[finite] = (left <= y + y_same) | (not_right < y - y_same)
    return dominated


def _known(data: Dataset) -> dict[str, Callable[[], Numbers]]:
    """Return all objectives of a data set by name, each as a function that returns its values for the cases."""
    dims = data["status"].dims
    known: dict[str, Callable[[], Numbers]] = {}
    for name, variable in data.data_vars.items():
        if variable.dims == dims and variable.dtype.kind == "f" and name not in _OTHERS:
            known[str(name)] = lambda own=variable: np.asarray(own.values, dtype=float)  # type: ignore[misc]
    if "d_cost" in data:
        for i, by in enumerate(data["by"].values):
            known[f"d_cost.{by}"] = lambda i=i: np.asarray(data["d_cost"].isel(by=i).values)  # type: ignore[misc]
    for array, column in _COLUMNS.items():
        if array in data:
            rows = str(data[array].dims[len(dims)])
            for i, name in enumerate(data[column].values):
                own = data[array].isel({column: i})
                known |= {f"{word}.{name}": partial(_reduced, own, rows, word) for word in _WORDS}
    if "t" in data:
        known["duration"] = lambda: last_values(data["t"].values) - np.asarray(data["t"].isel(node=0).values)
    for name, coordinate in data.coords.items():
        if coordinate.dims and coordinate.dims[0] in dims and coordinate.dtype.kind in "fiub":
            known[str(name)] = lambda own=coordinate: np.array(  # type: ignore[misc]
                own.broadcast_like(data["status"]).transpose(*dims).values, dtype=float
            )
    return known


def _reduced(array: DataArray, rows: str, word: str) -> Numbers:
    """Return the start, end, max or min (`word`) of each trajectory; controls at stages are averaged per interval."""
    if "stage" in array.dims:
        array = array.mean("stage")
    if word == "end":
        return last_values(np.asarray(array.values, dtype=float))
    reduced = array.isel({rows: 0}) if word == "start" else array.max(rows) if word == "max" else array.min(rows)
    return np.asarray(reduced.values, dtype=float)


_EDGE = 0.02  # distance of failed cases from the edge of the panel, relative to the panel
_FAILED: Look = {"color": CRIMSON, "marker": "x", "linestyle": "none", "markersize": 5.5, "zorder": 3.0}
_WORDS = {"start": "at the start", "end": "at the end", "max": "at its largest", "min": "at its smallest"}


def pareto_figure(data: Dataset, objectives: tuple[Objective, Objective]) -> Figure:
    """Return the figure of two objectives for the cases of a sweep, with the data set of `codegen.sweep`.

    The front is a line through its cases; dominated cases are lighter. Failed cases are crosses at the edge if an
    objective is a varied quantity; otherwise only their number is given. The first other varied quantity gives the
    colours of the cases on the front.
    """
    figure = new_figure(8.6, 5.6)
    axes = figure.subplots()
    one, other = (values_of(objective, data).ravel() for objective in objectives)
    solved = statuses(data).ravel() == "solved"
    one_solved, other_solved = np.where(solved, one, np.nan), np.where(solved, other, np.nan)
    dominated = is_dominated(objectives[0].sign * one_solved, objectives[1].sign * other_solved)
    finite = np.isfinite(one_solved) & np.isfinite(other_solved)
    front, behind = np.flatnonzero(finite & ~dominated), np.flatnonzero(dominated)
    size = max(3.0, min(6.0, 6.0 * np.sqrt(300.0 / max(1, solved.size))))
    axes.plot(
        one[behind], other[behind], ".", color=GREY, alpha=0.35, markersize=1.6 * size, zorder=2.0, label="dominated",
        markeredgewidth=0.0, rasterized=True,
    )  # fmt: skip
    front = front[np.argsort(one[front], kind="stable")]
    axes.plot(one[front], other[front], "-", color=DARK, linewidth=1.0, zorder=2.2)
    # Find the first numeric quantity that varies among cases and is not an objective.
    chosen = {objective.name for objective in objectives}
    numeric = (
        (str(name), coordinate)
        for name, coordinate in data.coords.items()
        if coordinate.dims and coordinate.dims[0] in data["status"].dims and coordinate.dtype.kind in "fiub"
    )
    varying = (name for name, own in numeric if name not in chosen and own.size > 1 and np.ptp(own.values) > 0.0)
    name = next(varying, None)
    if name is None:
        axes.plot(one[front], other[front], "-o", color=BLUE, markersize=size, linewidth=1.0, zorder=2.5, label="front")
    else:
        varied = values_of(Objective(name, is_large=False), data).ravel()
        shades = ScalarMappable(Normalize(float(varied.min()), float(varied.max())), body_map())
        axes.plot([], [], "-o", color=DARK, markersize=size, linewidth=1.0, label="front")
        colours = shades.to_rgba(varied[front])
        axes.scatter(one[front], other[front], s=size**2, c=colours, zorder=2.5, linewidths=0.0)
        figure.colorbar(shades, ax=axes, label=quantity(name, data), aspect=30).outline.set_visible(False)
    if not solved.all():
        # Draw failed cases at the edge of the panel, along the axis of a varied objective.
        x, y = one[~solved], other[~solved]
        has_x, has_y, text = np.isfinite(x).all(), np.isfinite(y).all(), f"{x.size} failed"
        at_foot, at_side = np.full(x.size, _EDGE), np.full(y.size, _EDGE)
        if has_x and has_y:
            axes.plot(x, y, **_FAILED)
        elif has_x:
            axes.plot(x, at_foot, **_FAILED, transform=axes.get_xaxis_transform(), clip_on=False)
        elif has_y:
            axes.plot(at_side, y, **_FAILED, transform=axes.get_yaxis_transform(), clip_on=False)
        is_shown = bool(has_x or has_y)
        look = _FAILED if is_shown else {**_FAILED, "marker": ""}
        axes.plot([], [], **look, label=text if is_shown else f"{text}: no objectives")
    for objective, values, is_first in ((objectives[0], one, True), (objectives[1], other, False)):
        # Label the axis with the objective and its better direction, and choose the scale.
        word, dot, own = objective.name.partition(".")
        if word == "d_cost":
            text = f"derivative of the cost by {quantity(own)}"
        elif dot:
            text = f"{label(own)} {_WORDS[word]}"
        else:
            text = word if word in ("cost", "duration") else label(word)
        # The unit of a derivative is not in the data.
        text = text if word == "d_cost" else in_unit(text, unit_in(data, objective.name))
        text += " (larger is better)" if objective.is_large else ""
        (axes.set_xlabel if is_first else axes.set_ylabel)(text)
        if is_wide(values):
            (axes.set_xscale if is_first else axes.set_yscale)("log")
    handles, names = axes.get_legend_handles_labels()
    entries = [(handle, name) for handle, name in zip(handles, names) if name != "dominated" or behind.size]
    figure.legend(*zip(*entries), loc="outside lower center", ncols=len(entries))
    heading(figure, data)
    return figure
