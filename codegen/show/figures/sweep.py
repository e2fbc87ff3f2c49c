"""The figure of a sweep: lines over one varied quantity, maps over two, histograms and quantiles for samples.

Many trajectories in a panel are coloured by a varied quantity, or shown as quantiles over time (a fan).

With sensitivities, mean and standard deviation of the samples are compared with first-order predictions. Predictions
use the derivatives of the case that is nearest to the mean of the varied quantities. Variances of independent samples
add up; covariances of the columns of a table are included. Source: JCGM 100 (2008), Guide to the expression of
uncertainty in measurement, section 5.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, TypeVar

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import QuadMesh
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import AbstractPathEffect, withStroke
from matplotlib.ticker import Locator, LogLocator, MaxNLocator
from numpy.typing import NDArray

from codegen.show.figures.panels import KINDS
from codegen.show.figures.picture import (
    AMBER,
    BLUE,
    CRIMSON,
    DARK,
    GREY,
    PINK,
    Look,
    body_colours,
    body_map,
    letter_size,
    new_figure,
)
from codegen.show.figures.quantities import heading, in_unit, label, quantity, statuses, unit_in

if TYPE_CHECKING:
    from matplotlib.typing import HashableList
    from xarray import Dataset

Numbers: TypeAlias = NDArray[np.float64]
Scalar = TypeVar("Scalar", bound=np.generic)
Places: TypeAlias = tuple[Numbers, NDArray[np.intp], list[str]]
"""An axis: sorted positions of the values of a dimension, their order, and their names if they are words."""
NORMAL_90 = 1.6448536269514722
"""Half width of the interval with the central 90 % of a normal distribution, in standard deviations."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """A first-order prediction of the distribution of results, from the derivatives of the case `centre`.

    `by` are the indices of the m varied quantities among the derivatives. `offset` (m,) is the mean of these quantities
    minus their values in the case. `covariance` (m, m) is the covariance of their samples.
    """

    centre: int
    by: list[int]
    offset: Numbers
    covariance: Numbers

    def of(self, data: Dataset, name: str) -> tuple[Numbers, Numbers]:
        """Return the predicted mean and standard deviation, both (...), of the variable `name` (case, ...)."""
        centre = np.asarray(data[name].isel(case=self.centre).values, dtype=float)
        slopes = np.asarray(data[f"d_{name}"].isel(case=self.centre).values, dtype=float)[self.by]
        mean = centre + np.tensordot(self.offset, slopes, 1)
        return mean, np.sqrt(np.einsum("i...,ij,j...->...", slopes, self.covariance, slopes))


def prediction(data: Dataset, varied: list[str]) -> Prediction | None:
    """Return the prediction for a sweep, or None if no solved case has derivatives for all varied quantities."""
    names = [str(name) for name in data["by"].values] if "d_cost" in data else []
    columns = {name: np.asarray(data[name].values, dtype=float) for name in varied if np.ptp(data[name].values) > 0.0}
    own = [name.removesuffix("_") if name not in names else name for name in columns]
    if not columns or not set(own) <= set(names):
        return None
    points = np.column_stack(list(columns.values()))
    has_rates = (statuses(data) == "solved") & np.isfinite(data["d_cost"].values).all(axis=1)
    if not has_rates.any():
        return None
    mean, deviations = points.mean(axis=0), points.std(axis=0)
    distances = (((points - mean) / deviations) ** 2).sum(axis=1)
    centre = int(np.argmin(np.where(has_rates, distances, np.inf)))
    if data.attrs.get("cases") == "table":
        covariance = np.atleast_2d(np.cov(points.T, bias=True))
    else:
        covariance = np.diag(deviations**2)
    return Prediction(centre, [names.index(name) for name in own], mean - points[centre], covariance)


MOST_PANELS, MOST_TRAJECTORIES, MOST_CASES = 15, 60, 4000
"""Largest numbers of panels, of trajectories in a panel, and of cases for quantiles."""
MOST_CONTROLS = 6  # number of controls that are drawn even if the states alone would fill all panels
BANDS = ((0.05, 0.95, 0.18), (0.25, 0.75, 0.35))  # lower quantile, upper quantile and opacity of each band of a fan
_COLUMNS = {"q": ("coordinate", "state"), "u": ("control", "control")}


def groups_of(data: Dataset) -> tuple[list[tuple[str, str]], list[str]]:
    """Return the trajectories to draw as (array, column), states before controls, and the columns that are left out."""
    if "t" not in data:
        return [], []
    states, controls = (
        [(name, str(column)) for column in data[dim].values] if name in data else []
        for name, (dim, _) in _COLUMNS.items()
    )
    few = controls[: max(MOST_CONTROLS, MOST_PANELS - len(states))]
    drawn = [*states[: MOST_PANELS - len(few)], *few]
    return drawn, [column for name, column in (*states, *controls) if (name, column) not in drawn]


def _curves(data: Dataset, group: tuple[str, str], most: int) -> tuple[Numbers, Numbers, NDArray[np.intp]]:
    """Return times and values (cases, times) of a trajectory in at most `most` solved cases, and their indices."""
    name, column = group
    solved = np.flatnonzero(statuses(data).ravel() == "solved")
    solved = solved[:: max(1, -(-solved.size // most))]
    dim = str(data["status"].dims[0])
    part = data[["t", name]].isel({dim: solved})
    columns = data[_COLUMNS[name][0]].values.tolist()
    t, values = part["t"].values, part[name].isel({_COLUMNS[name][0]: columns.index(column)})
    if "stage" in values.dims:
        values = values.mean("stage")
    table = np.asarray(values.transpose(dim, ...).values, dtype=float)
    if table.shape[1] == t.shape[1] - 1:
        t = 0.5 * (t[:, 1:] + t[:, :-1])
    return t, table, solved


def graded(
    panels: Mapping[str, Axes], groups: Sequence[tuple[str, str]], data: Dataset, places: Numbers
) -> ScalarMappable:
    """Draw trajectories over time, coloured by `places` (cases,); return the mappable for the colour bar."""
    solved = places[statuses(data).ravel() == "solved"]
    least, most = (float(solved.min()), float(solved.max())) if solved.size else (0.0, 1.0)
    shades = ScalarMappable(Normalize(least, most if most > least else least + 1.0), body_map())
    for i, group in enumerate(groups):
        axes = panels[f"g{i}"]
        t, values, cases = _curves(data, group, MOST_TRAJECTORIES)
        for times, row, case in zip(t, values, cases):
            axes.plot(times, row, color=shades.to_rgba(places[case]), linewidth=0.9)
        _over_time(axes, in_unit("time", unit_in(data, "t")), group, data)
    return shades


def _over_time(axes: Axes, what: str, group: tuple[str, str], data: Dataset) -> None:
    axes.set_xlabel(what)
    axes.set_ylabel(quantity(group[1], data))
    axes.margins(x=0)


def fan(axes: Axes, data: Dataset, group: tuple[str, str], linear: Prediction | None = None) -> None:
    """Draw the median and bands of quantiles of a trajectory over time, and the predicted band of 90 %."""
    t, values, _ = _curves(data, group, MOST_CASES)
    colour = KINDS[_COLUMNS[group[0]][1]]
    if not t.size:
        axes.set_visible(False)
        return
    ends = np.nanmax(t, axis=1)
    same = bool(np.allclose(t, t[0], rtol=1e-9, equal_nan=True))
    times = t[0] if same else np.nanmedian(t / ends[:, None], axis=0)
    seen = np.isfinite(times)
    for low, high, strength in BANDS:
        edges = np.nanquantile(values[:, seen], (low, high), axis=0)
        axes.fill_between(times[seen], *edges, color=colour, alpha=strength, linewidth=0)
    axes.plot(times[seen], np.nanmedian(values[:, seen], axis=0), color=colour)
    what = in_unit("time", unit_in(data, "t")) if same else "time divided by the duration"
    _over_time(axes, what, group, data)
    handles: list[Artist] = [Patch(color=colour, alpha=a, label=f"{100 * (h - low):.0f} %") for low, h, a in BANDS]
    if linear is not None and f"d_{group[0]}" in data:
        index = data[_COLUMNS[group[0]][0]].values.tolist().index(group[1])
        columns = (table[..., index] for table in linear.of(data, group[0]))
        # Average over stages.
        mean, deviation = (own if own.ndim == 1 else own.mean(axis=1) for own in columns)
        for sign in (-1.0, 1.0):
            edge = mean + sign * NORMAL_90 * deviation
            axes.plot(times[seen], edge[seen], color=DARK, linestyle="--", linewidth=1.0)
        handles.append(Line2D([], [], color=DARK, linestyle="--", linewidth=1.0, label="90 %, first order"))
    axes.legend(handles=handles, loc="best", ncols=2, handlelength=1.2)


def histogram(
    axes: Axes, name: str, values: Numbers, is_wide: bool, linear: tuple[float, float] = (np.nan, np.nan)
) -> None:
    """Draw a histogram of values (cases,) with the median and the quantiles of 5 and 95 %.

    `is_wide` chooses a logarithmic axis. `linear` is the predicted mean and standard deviation, NaN without one.
    """
    finite = values[np.isfinite(values)]
    axes.set_xlabel(name)
    axes.set_ylabel("cases")
    if not finite.size:
        axes.text(0.5, 0.5, "no case is solved", transform=axes.transAxes, ha="center", color=DARK)
        return
    number = int(np.clip(np.sqrt(finite.size), 5, 60))
    bins = np.geomspace(finite.min(), finite.max(), number + 1).tolist() if is_wide else number
    axes.hist(finite, bins, color=BLUE, alpha=0.45)
    if is_wide:
        axes.set_xscale("log")
    for share, style in ((0.05, ":"), (0.5, "-"), (0.95, "--")):
        value = float(np.quantile(finite, share))
        words = "median" if share == 0.5 else f"{100 * share:.0f} %"
        axes.axvline(value, color=DARK, linestyle=style, linewidth=1.1, label=f"{words}: {value:.4g}")
    if linear[1] > 0.0:
        mean, deviation = linear
        if not is_wide:
            low, high = axes.get_xlim()
            x = np.linspace(low, high, 200)
            height = finite.size * np.ptp(finite) / number / (deviation * np.sqrt(2.0 * np.pi))
            axes.plot(x, height * np.exp(-0.5 * ((x - mean) / deviation) ** 2), color=AMBER)
        axes.plot([], [], color=AMBER, label=f"first order: {mean:.4g} ± {deviation:.2g}")
        axes.plot([], [], " ", label=f"samples: {finite.mean():.4g} ± {finite.std():.2g}")
    axes.legend(loc="upper right", handlelength=1.6, frameon=True, framealpha=0.85, edgecolor="none")
    axes.margins(y=0.3 if not linear[1] > 0.0 else 0.8)  # make room for the legend
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=False, axis="x")


_MOST_MEASURES, _MOST_NAMES = 4, 12
_WIDE = 100.0  # ratio of the largest to the smallest positive value above which an axis is logarithmic
FAILED: Look = {"color": CRIMSON, "marker": "x", "linestyle": "none", "markersize": 4.5, "zorder": 3.0}
JUMP: Look = {
    "color": PINK, "marker": "o", "linestyle": "none", "markersize": 7, "markerfacecolor": "none", "zorder": 2.9,
    "markeredgewidth": 1.6,
}  # fmt: skip


def no_room(data: Dataset, has_curves: bool, others: Sequence[str] = ()) -> str:
    """Return the end of a title: the trajectories, final states and `others` that are not drawn for lack of room."""
    ends = [] if _has_cost(data) else [f"{label(str(name))} at the end" for name in data["coordinate"].values]
    curves = [label(name) for name in groups_of(data)[1]] if has_curves else []
    names = [*curves, *ends[_MOST_MEASURES:], *others]
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"; no room for {', '.join(names[:_MOST_NAMES])}{more}" if names else ""


def _has_cost(data: Dataset) -> bool:
    return bool(np.isfinite(data["cost"].values).any()) or "q" not in data


def measures_of(data: Dataset) -> dict[str, Numbers]:
    """Return the number of each case to draw, by its label: the cost, or without a cost the final states."""
    if _has_cost(data):
        return {in_unit("cost", unit_in(data, "cost")): data["cost"].values}
    names = [str(name) for name in data["coordinate"].values][:_MOST_MEASURES]
    q = data["q"].transpose("coordinate", ..., "node").values
    return {quantity(f"end.{name}", data): last_values(q[i]) for i, name in enumerate(names)}


def last_values(values: Numbers) -> Numbers:
    """Return the last finite value of each trajectory (..., times); trajectories with fewer steps end in NaN."""
    number = np.maximum(1, np.isfinite(values).sum(axis=-1)) - 1
    return np.asarray(np.take_along_axis(values, number[..., None], axis=-1)[..., 0])


def is_failed(data: Dataset) -> NDArray[np.bool_]:
    """Return a mask of the cases without a solution."""
    return np.asarray(statuses(data) != "solved")


def has_jump(data: Dataset) -> NDArray[np.bool_]:
    """Return a mask of the cases with a jump of the cost to a better neighbouring case."""
    return np.asarray(data["jump"].values == 1) if "jump" in data else np.zeros(data["status"].shape, bool)


def is_wide(values: Numbers) -> bool:
    """Return True if values need a logarithmic axis."""
    finite = values[np.isfinite(values)]
    return finite.size > 1 and bool(finite.min() > 0.0) and bool(finite.max() > _WIDE * finite.min())


_SAME, _MOST = 0.004, 0.5
"""Largest distance of coinciding lines relative to the range, and least fraction of points that must coincide."""
_DASH = 8.0  # length of a dash in line widths


def legend(axes: Axes) -> None:
    """Add a legend that shows dashed lines as solid lines."""
    for handle in axes.legend(loc="best").get_lines():
        if handle.get_linestyle() not in ("None", "none", " ", ""):
            handle.set_linestyle("-")


_APART, _LONG, _LETTERS = 1.4, 6.0, 7.5
"""Least distance of a label from other lines and least length of its line, in letter heights; letter size."""


def contours(axes: Axes, x: Numbers, y: Numbers, shown: Numbers, norm: Normalize) -> None:
    """Draw contours of `shown` (y, x) at round values, with labels where other lines leave room."""
    least, most = float(norm.vmin or 0.0), float(norm.vmax or 0.0)
    if min(shown.shape) <= 2 or not np.isfinite(shown).any() or not least < most:
        return
    factors = (1.0,) if most > 1e3 * least else (1.0, 2.0, 5.0)
    locator: Locator = LogLocator(subs=factors) if isinstance(norm, LogNorm) else MaxNLocator(8)
    levels = np.asarray(locator.tick_values(least, most), dtype=float)
    levels = levels[(levels > least) & (levels < most)]
    if not levels.size:
        return
    halo: list[AbstractPathEffect] = [withStroke(linewidth=2.0, foreground="#ffffffa0")]
    lines = axes.contour(x, y, np.ma.masked_invalid(shown), levels, colors=DARK, linewidths=0.7)
    lines.set_path_effects(halo)
    positions = list(_label_positions(axes, lines.allsegs))
    if positions:
        for text in axes.clabel(lines, fontsize=letter_size(_LETTERS), fmt="%.4g", manual=positions):
            text.set_path_effects(halo)


def _label_positions(axes: Axes, segments: Sequence[Sequence[Numbers]]) -> Iterator[tuple[float, float]]:
    """Yield the position (x, y) of the label of each contour level whose lines have enough free space.

    `segments` are the lines of each level as points (n, 2). The size of the panel before the final layout is accurate
    enough.
    """
    letter = letter_size(_LETTERS) * axes.figure.dpi / 72.0

    def dense(line: Numbers) -> Numbers:
        """Return points (n, 2) along a line, half a letter apart."""
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        distances = np.linspace(0.0, along[-1], max(2, int(2.0 * along[-1] / letter)))
        return np.column_stack([np.interp(distances, along, column) for column in line.T])

    on_page = [[dense(axes.transData.transform(line)) for line in lines if len(line) > 1] for lines in segments]
    box = axes.bbox
    frame = [(box.x0, box.y0), (box.x1, box.y0), (box.x1, box.y1), (box.x0, box.y1), (box.x0, box.y0)]
    occupied: list[Numbers] = [dense(np.array(frame))]
    for level, lines in enumerate(on_page):
        others = np.concatenate([*occupied, *(line for k, rest in enumerate(on_page) if k != level for line in rest)])
        # Leave out both ends of a line, where half of a label would have no line.
        inner = [line[2:-2] for line in lines if len(line) >= 2 * _LONG]
        if not inner:
            continue
        points = np.concatenate(inner)
        room = np.array([np.sqrt(((others - point) ** 2).sum(axis=1).min()) for point in points])
        best = int(np.argmax(room))
        if room[best] > _APART * letter:
            occupied.append(points[[best]])
            x, y = axes.transData.inverted().transform(points[best])
            yield float(x), float(y)


MOST_LINES = 7  # largest number of values of a second quantity that are drawn as lines; more values give a map
_MOST_MAPS, _MOST_SCATTERS, _MOST_POINTS = 6, 4, 20_000
_FOOT = 0.035  # height of a row of crosses for failed cases, relative to the panel


def sweep_figure(data: Dataset) -> Figure:
    """Return the figure of a sweep's data set; crosses are failed cases, rings are jumps of the cost.

    Problems without a cost are shown by their final state. In a grid of more than two quantities, the axes have the two
    with the most values. The third has several values, and the others have their middle values.
    """
    dims = tuple(str(dim) for dim in data["status"].dims)
    if dims == ("case",):
        return _samples(data)
    long = sorted(dims, key=lambda dim: -data.sizes[dim])
    second = data.sizes[long[1]] if len(long) > 1 else 1
    drawn, whole = long[: 3 if second > MOST_LINES else 2], data
    middle = {dim: data.sizes[dim] // 2 for dim in dims if dim not in drawn and data.sizes[dim] > 1}
    data = data.isel({dim: 0 for dim in dims if dim not in drawn} | middle)
    figure = _lines(data, drawn) if second <= MOST_LINES else _maps(data, drawn)
    at = ", ".join(_equation(whole, dim, k) for dim, k in middle.items())
    heading(figure, whole, (f"; drawn are those at {at}" if at else "") + no_room(data, second == 1))
    return figure


def _axis_places(data: Dataset, dim: str) -> tuple[Numbers, NDArray[np.intp], list[str]]:
    """Return the sorted positions of the values of a dimension, their order, and their names if they are words."""
    values = data[dim].values if dim in data.coords else np.arange(data.sizes[dim])
    if np.asarray(values).dtype.kind not in "fiub":
        return np.arange(len(values), dtype=float), np.arange(len(values)), [str(value) for value in values]
    order = np.argsort(values, kind="stable")
    return np.asarray(values, dtype=float)[order], order, []


def _lines(data: Dataset, dims: Sequence[str]) -> Figure:
    """Draw measures over dims[0], with a line for each value of dims[1], or one line and all trajectories."""
    x, order, words = _axis_places(data, dims[0])
    by = dims[1] if len(dims) > 1 else None
    measures, (groups, _) = measures_of(data), groups_of(data)
    columns = _columns(len(groups))
    rows: list[HashableList[str]] = [[f"m{i}"] * columns for i in range(len(measures))]
    names: HashableList[str] = [f"g{i}" for i in range(len(groups))] if by is None or data.sizes[by] == 1 else []
    names += ["."] * (-len(names) % columns)
    rows += [names[first : first + columns] for first in range(0, len(names), columns)]
    figure = new_figure(max(7.0, 3.6 * columns), 1.1 + 2.9 * len(rows))
    panels = figure.subplot_mosaic(rows)
    failed, jumps = (_rows(table, data, dims)[:, order] for table in (is_failed(data), has_jump(data)))
    for i, (name, values) in enumerate(measures.items()):
        _measure(panels[f"m{i}"], x, _rows(values, data, dims)[:, order], failed, jumps, data, by, bool(words))
        panels[f"m{i}"].set_ylabel(name)
        panels[f"m{i}"].set_xlabel(quantity(dims[0], data))
        if words:
            panels[f"m{i}"].set_xticks(x, words)
    if any(name != "." for name in names):
        flat = data if by is None else data.isel({by: 0})
        shades = graded(panels, groups, flat.isel({dims[0]: order}), x)
        bar = figure.colorbar(
            shades, ax=[panels[f"g{i}"] for i in range(len(groups))], label=quantity(dims[0], data), aspect=30
        )
        bar.outline.set_visible(False)
        if words:
            bar.set_ticks(x.tolist(), labels=words)
    return figure


def _rows(table: NDArray[Scalar], data: Dataset, dims: Sequence[str]) -> NDArray[Scalar]:
    """Return a table over the cases with shape (values of all other dimensions, values of dims[0])."""
    own = [str(dim) for dim in data["status"].dims]
    kept = np.moveaxis(table, own.index(dims[0]), -1)
    return kept.reshape(-1, kept.shape[-1])


def _measure(
    axes: Axes,
    x: Numbers,
    rows: Numbers,
    failed: NDArray[np.bool_],
    jumps: NDArray[np.bool_],
    data: Dataset,
    by: str | None,
    is_of_words: bool,
) -> None:
    """Draw one measure `rows` (lines, n) over x, with a row of crosses for the failed cases of each line, and jumps."""
    if is_wide(rows):
        axes.set_yscale("log")
    marker = "o" if is_of_words else "." if x.size <= 60 else ""
    # Find groups of coinciding lines.
    is_log = axes.get_yscale() == "log"
    with np.errstate(invalid="ignore", divide="ignore"):
        heights = np.log(rows) if is_log else rows
    finite = heights[np.isfinite(heights)]
    close = _SAME * float(np.ptp(finite)) if finite.size else 0.0
    same: list[list[int]] = []
    for line in range(len(rows)):
        for group in same:
            both = np.isfinite(heights[line]) & np.isfinite(heights[group[0]])
            distances = np.abs(heights[line][both] - heights[group[0]][both])
            if distances.size > 1 and int((distances <= close).sum()) >= _MOST * distances.size:
                group.append(line)
                break
        else:
            same.append([line])
    # Coinciding lines alternate dashes and marks. A pattern starts with its dash, so a later line starts near the end
    # of its pattern.
    looks: dict[int, Look] = {}
    for group in same:
        number = len(group)
        for turn, line in enumerate(group):
            dashes = (_DASH * (number - turn)) % (_DASH * number), (_DASH, _DASH * (number - 1))
            looks[line] = {"linestyle": dashes, "markevery": (turn, number)} if number > 1 else {}
    for i, (row, colour) in enumerate(zip(rows, body_colours(len(rows), BLUE))):
        name = _equation(data, by, i) if by is not None and len(rows) > 1 else None
        look = {**looks[i], **({"linestyle": "none"} if is_of_words else {})}
        axes.plot(x, row, marker, **{"linestyle": "-", **look}, color=colour, markersize=5, label=name)
    if len(same) < len(rows):
        axes.plot([], [], " ", label="in turn where they coincide")
    if jumps.any():
        places = np.nonzero(jumps)
        axes.plot(x[places[1]], rows[places], **JUMP, label="jump")
    for i, (row, colour) in enumerate(zip(failed, body_colours(len(rows), CRIMSON))):
        if row.any():
            foot, look = np.full(int(row.sum()), 0.03 + _FOOT * i), {**FAILED, "color": colour}
            (marks,) = axes.plot(x[row], foot, **look, transform=axes.get_xaxis_transform(), clip_on=False)
            marks.set_label("failed" if len(rows) == 1 else "")
    if failed.any() and len(rows) > 1:
        axes.plot([], [], **FAILED, label="failed")
    if len(rows) > 1 or failed.any() or jumps.any():
        legend(axes)
    axes.margins(x=0.02, y=0.05 + _FOOT * len(failed) * failed.any())


def _equation(data: Dataset, dim: str, index: int) -> str:
    """Return a varied quantity with one of its values, such as `m = 2 kg`."""
    places, order, words = _axis_places(data, dim)
    value = words[index] if words else f"{places[np.argsort(order)][index]:.6g}"
    return f"{quantity(dim)} = {value} {unit_in(data, dim)}".rstrip()


def _maps(data: Dataset, dims: Sequence[str]) -> Figure:
    """Draw heat maps with contours over dims[0] and dims[1], for each measure and several values of dims[2]."""
    x, y = _axis_places(data, dims[0]), _axis_places(data, dims[1])
    chosen: list[int | None] = [None]
    if len(dims) > 2:
        number = data.sizes[dims[2]]
        chosen = sorted({round(i) for i in np.linspace(0, number - 1, min(number, _MOST_MAPS))})
    panels = [(data if k is None else data.isel({dims[2]: k}), k) for k in chosen]
    shown = [(part, k, name, values) for part, k in panels for name, values in measures_of(part).items()]
    columns = _columns(len(shown))
    size = max(6.4, 4.3 * columns), 1.2 + 3.7 * math.ceil(len(shown) / columns)
    figure = new_figure(*size)
    grid = figure.subplots(math.ceil(len(shown) / columns), columns, squeeze=False)
    for axes in grid.ravel()[len(shown) :]:
        axes.set_visible(False)
    drawn: dict[str, tuple[QuadMesh, list[Axes]]] = {}
    for axes, (part, k, name, values) in zip(grid.ravel(), shown):
        every = np.concatenate([other[3].ravel() for other in shown if other[2] == name])
        finite = every[np.isfinite(every)]
        limits = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        norm = LogNorm(*limits) if is_wide(every) else Normalize(*limits)
        shades = _map(axes, part, dims, (x, y), values, norm)
        drawn.setdefault(name, (shades, []))[1].append(axes)
        if k is not None:
            axes.set_title(_equation(data, dims[2], k))
    for name, (shades, panels_of) in drawn.items():
        figure.colorbar(shades, ax=panels_of, label=name).outline.set_visible(False)
    marks = {name: mark for axes in grid.ravel() for mark, name in zip(*axes.get_legend_handles_labels())}
    if marks:
        figure.legend(list(marks.values()), list(marks), loc="outside lower center", ncols=2)
    return figure


def _columns(panels: int) -> int:
    return {0: 1, 4: 2}.get(panels, min(panels, 3))


def _map(
    axes: Axes, data: Dataset, dims: Sequence[str], places: tuple[Places, Places], values: Numbers, norm: Normalize
) -> QuadMesh:
    """Draw one map of `values` over the axes `places`; return the mappable for the colour bar."""
    (x, columns, x_words), (y, rows, y_words) = places
    own = [str(dim) for dim in data["status"].dims]
    turned = own.index(dims[1]) > own.index(dims[0])

    def laid(table: NDArray[Scalar]) -> NDArray[Scalar]:
        return np.asarray((table.T if turned else table)[np.ix_(rows, columns)])

    shown = laid(values)
    shades = axes.pcolormesh(x, y, shown, shading="nearest", cmap=body_map(), norm=norm, rasterized=True)
    contours(axes, x, y, shown, norm)
    for table, look, name in ((laid(is_failed(data)), FAILED, "failed"), (laid(has_jump(data)), JUMP, "jump")):
        if table.any():
            i, j = np.nonzero(table)
            axes.plot(
                x[j], y[i], **{**look, "markersize": max(1.5, look["markersize"] * _crowd(table.size))}, label=name
            )
    axes.grid(visible=False)
    axes.set_xlabel(quantity(dims[0], data))
    axes.set_ylabel(quantity(dims[1], data))
    for words, at, put in ((x_words, x, axes.set_xticks), (y_words, y, axes.set_yticks)):
        if words:
            put(at, words)
    return shades


def _crowd(cells: int) -> float:
    return min(1.0, math.sqrt(900.0 / cells))


def _samples(data: Dataset) -> Figure:
    """Draw the histogram of each measure, the measure over varied quantities, and fans of trajectories.

    With sensitivities, draw first-order predictions too.
    """
    stride = max(1, -(-data.sizes["case"] // _MOST_POINTS))
    data = data.isel(case=slice(None, None, stride))
    measures, (groups, _) = measures_of(data), groups_of(data)
    own = {"status", "message", *map(str, data.sizes)}
    varied = [str(name) for name, values in data.coords.items() if values.dims == ("case",) and str(name) not in own]
    varied = [name for name in varied if data[name].dtype.kind in "fiub"]
    every, varied = varied, varied[:_MOST_SCATTERS]
    columns = max(3 if len(groups) > 6 else 2, min(4, 1 + len(varied)))
    blocks = [[f"m{i}", *(f"s{i},{j}" for j in range(len(varied)))] for i in range(len(measures))]
    blocks.append([f"g{i}" for i in range(len(groups))])
    rows: list[HashableList[str]] = [
        [*block[first : first + columns], *["."] * (columns - len(block[first : first + columns]))]
        for block in blocks for first in range(0, len(block), columns)
    ]  # fmt: skip
    figure = new_figure(3.6 * columns, 1.0 + 2.9 * len(rows))
    panels = figure.subplot_mosaic(rows)
    failed, jumps, linear = is_failed(data), has_jump(data), prediction(data, every)
    for i, (name, values) in enumerate(measures.items()):
        mean, deviation = linear.of(data, "cost") if linear is not None else (np.nan, np.nan)
        histogram(panels[f"m{i}"], name, values, is_wide(values), (float(mean), float(deviation)))
        for j, varied_one in enumerate(varied):
            axes, x = panels[f"s{i},{j}"], data[varied_one].values
            if is_wide(values):
                axes.set_yscale("log")
            size = max(1.0, 5.0 * _crowd(x.size))
            axes.plot(x, values, ".", color=BLUE, markersize=size, alpha=0.5, rasterized=True)
            if jumps.any():
                axes.plot(x[jumps], values[jumps], **JUMP, label="jump")
            if count := int(failed.sum()):
                look = {**FAILED, "transform": axes.get_xaxis_transform(), "clip_on": False}
                axes.plot(x[failed], np.full(count, 0.03), **look, label=f"{count} failed")
            if count or jumps.any():
                axes.legend(loc="best", labelcolor=GREY)
            axes.set_xlabel(quantity(varied_one, data))
            axes.set_ylabel(name)
    for i, group in enumerate(groups):
        fan(panels[f"g{i}"], data, group, linear)
    heading(figure, data, no_room(data, True, [f"the cost over {quantity(name)}" for name in every[_MOST_SCATTERS:]]))
    return figure
