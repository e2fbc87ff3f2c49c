"""Many trajectories in one panel: graded by a quantity, or as quantiles over time; and distributions of numbers.

What sensitivities of one case predict of all samples, to first order: means, and standard deviations. The case is the
one that is nearest to the mean of what varies. Its slopes times the deviations of quantities that are sampled
independently of each other add up by squares; those of a table may follow each other, so that their covariances take
part. Source: JCGM 100 (2008), Guide to the expression of uncertainty in measurement, section 5.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from codegen.plots.panels import KINDS
from codegen.plots.style import AMBER, BLUE, CRIMSON, DARK, PINK, body_map, label, statuses

if TYPE_CHECKING:
    from xarray import Dataset


NORMAL_90 = 1.6448536269514722
"""Within so many standard deviations a normal distribution has 90 % of its values."""


@dataclass(frozen=True, eq=False)
class Prediction:
    """The case `centre` whose slopes predict, the places of varied quantities among them, and how these are spread.

    `offset` (m,) is the mean of m quantities less their values in that case, `covariance` (m, m) that of their samples.
    """

    centre: int
    by: list[int]
    offset: NDArray[np.float64]
    covariance: NDArray[np.float64]

    def of(self, data: Dataset, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The mean and the standard deviation (...) of a variable (case, ...) that has derivatives."""
        centre = np.asarray(data[name].isel(case=self.centre).values, dtype=float)
        slopes = np.asarray(data[f"d_{name}"].isel(case=self.centre).values, dtype=float)[self.by]
        mean = centre + np.tensordot(self.offset, slopes, 1)
        return mean, np.sqrt(np.einsum("i...,ij,j...->...", slopes, self.covariance, slopes))


def prediction(data: Dataset, varied: list[str]) -> Prediction | None:
    """What predicts the samples of a sweep, if every quantity that varies has derivatives, and some case has them."""
    names = [str(name) for name in data["by"].values] if "d_cost" in data else []
    columns = {name: np.asarray(data[name].values, dtype=float) for name in varied if np.ptp(data[name].values) > 0.0}
    own = [name.removesuffix("_") if name not in names else name for name in columns]
    if not columns or not set(own) <= set(names):
        return None
    points = np.column_stack(list(columns.values()))
    known = (statuses(data) == "solved") & np.isfinite(data["d_cost"].values).all(axis=1)
    if not known.any():
        return None
    mean, deviations = points.mean(axis=0), points.std(axis=0)
    distances = (((points - mean) / deviations) ** 2).sum(axis=1)
    centre = int(np.argmin(np.where(known, distances, np.inf)))
    if data.attrs.get("cases") == "table":
        covariance = np.atleast_2d(np.cov(points.T, bias=True))
    else:
        covariance = np.diag(deviations**2)
    return Prediction(centre, [names.index(name) for name in own], mean - points[centre], covariance)


MOST_PANELS, MOST_LINES, MOST_CASES = 15, 60, 4000
"""Quantities, trajectories and cases for quantiles that are drawn at most."""
MOST_CONTROLS = 6
"""So many controls at most take the place of states, where there are more of both than are drawn."""
BANDS = ((0.05, 0.95, 0.18), (0.25, 0.75, 0.35))
"""Quantiles between which a fan is filled, and how strongly."""
_COLUMNS = {"q": ("coordinate", "state"), "u": ("control", "control")}


def groups_of(data: Dataset) -> tuple[list[tuple[str, str]], list[str]]:
    """The trajectories that are drawn, as (array, column), states and then controls, and the columns for which there is
    no room.
    """
    if "t" not in data:
        return [], []
    states, controls = (
        [(name, str(column)) for column in data[dim].values] if name in data else []
        for name, (dim, _) in _COLUMNS.items()
    )
    few = controls[: max(MOST_CONTROLS, MOST_PANELS - len(states))]
    drawn = [*states[: MOST_PANELS - len(few)], *few]
    return drawn, [column for name, column in (*states, *controls) if (name, column) not in drawn]


def _curves(data: Dataset, group: tuple[str, str], most: int) -> tuple[NDArray[Any], NDArray[Any], NDArray[np.intp]]:
    """Times and values (cases, times) of some cases that are solved, and which these are."""
    name, column = group
    solved = np.flatnonzero(statuses(data).ravel() == "solved")
    solved = solved[:: max(1, -(-solved.size // most))]
    dim = str(data["status"].dims[0])
    part = data[["t", name]].isel({dim: solved})
    t, values = (
        part["t"].values,
        part[name].isel({_COLUMNS[name][0]: data[_COLUMNS[name][0]].values.tolist().index(column)}),
    )
    if "stage" in values.dims:
        values = values.mean("stage")
    table = np.asarray(values.transpose(dim, ...).values, dtype=float)
    if table.shape[1] == t.shape[1] - 1:
        t = 0.5 * (t[:, 1:] + t[:, :-1])
    return t, table, solved


def graded(
    panels: Mapping[str, Any], groups: Sequence[tuple[str, str]], data: Dataset, dim: str, places: NDArray[np.float64]
) -> ScalarMappable:
    """Trajectories over time, each in the colour of its case; returns what a colour bar is made from."""
    solved = places[statuses(data).ravel() == "solved"]
    least, most = (float(solved.min()), float(solved.max())) if solved.size else (0.0, 1.0)
    shades = ScalarMappable(Normalize(least, most if most > least else least + 1.0), body_map())
    for i, group in enumerate(groups):
        axes = panels[f"g{i}"]
        t, values, cases = _curves(data, group, MOST_LINES)
        for times, row, case in zip(t, values, cases):
            axes.plot(times, row, color=shades.to_rgba(places[case]), linewidth=0.9)
        _over_time(axes, "time", group)
    return shades


def _over_time(axes: Any, what: str, group: tuple[str, str]) -> None:
    axes.set_xlabel(what)
    axes.set_ylabel(label(group[1]))
    axes.margins(x=0)


def fan(axes: Any, data: Dataset, group: tuple[str, str], linear: Prediction | None = None) -> None:
    """Quantiles of a quantity over time: the median, and bands between others; and what is predicted of the widest."""
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
    _over_time(axes, "time" if same else "time in parts of the duration", group)
    handles: list[Any] = [Patch(color=colour, alpha=a, label=f"{100 * (h - low):.0f} %") for low, h, a in BANDS]
    if linear is not None and f"d_{group[0]}" in data:
        mean, deviation = (_column(table, data, group) for table in linear.of(data, group[0]))
        for sign in (-1.0, 1.0):
            edge = mean + sign * NORMAL_90 * deviation
            axes.plot(times[seen], edge[seen], color=DARK, linestyle="--", linewidth=1.0)
        handles.append(Line2D([], [], color=DARK, linestyle="--", linewidth=1.0, label="90 %, first order"))
    axes.legend(handles=handles, loc="best", ncols=2, handlelength=1.2)


def _column(table: NDArray[np.float64], data: Dataset, group: tuple[str, str]) -> NDArray[np.float64]:
    """One column of the array of a case, (times,); the means of stages."""
    columns = data[_COLUMNS[group[0]][0]].values.tolist()
    own = table[..., columns.index(group[1])]
    return own if own.ndim == 1 else own.mean(axis=1)


def histogram(
    axes: Any,
    name: str,
    values: NDArray[np.float64],
    is_wide: bool,
    linear: tuple[float, float] = (np.nan, np.nan),
) -> None:
    """How often values occur, with the median and the quantiles of 5 and 95 %.

    `linear` are the mean and the standard deviation that are predicted to first order, beside those of the samples.
    """
    finite = values[np.isfinite(values)]
    axes.set_xlabel(name)
    axes.set_ylabel("cases")
    if not finite.size:
        axes.text(0.5, 0.5, "no case is solved", transform=axes.transAxes, ha="center", color=DARK)
        return
    number = int(np.clip(np.sqrt(finite.size), 5, 60))
    bins: Any = np.geomspace(finite.min(), finite.max(), number + 1) if is_wide else number
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
    axes.margins(y=0.3 if not linear[1] > 0.0 else 0.8)  # room for what the legend says
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
    axes.grid(visible=False, axis="x")


_MOST_MEASURES, _MOST_NAMES = 4, 12
_WIDE = 100.0
"""Positive values whose largest is so many times the smallest are drawn on a logarithmic scale."""
FAILED: dict[str, Any] = {"color": CRIMSON, "marker": "x", "linestyle": "none", "markersize": 4.5, "zorder": 3.0}
JUMP: dict[str, Any] = {
    "color": PINK, "marker": "o", "linestyle": "none", "markersize": 7, "markerfacecolor": "none", "zorder": 2.9,
    "markeredgewidth": 1.6,
}  # fmt: skip


def no_room(data: Dataset, has_curves: bool, others: Sequence[str] = ()) -> str:
    """For which trajectories, states at the end and `others` there is no room, as the end of a sentence."""
    ends = [] if _has_cost(data) else [f"{label(str(name))} at the end" for name in data["coordinate"].values]
    curves = [label(name) for name in groups_of(data)[1]] if has_curves else []
    names = [*curves, *ends[_MOST_MEASURES:], *others]
    more = f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    return f"; no room for {', '.join(names[:_MOST_NAMES])}{more}" if names else ""


def _has_cost(data: Dataset) -> bool:
    return bool(np.isfinite(data["cost"].values).any()) or "q" not in data


def measures_of(data: Dataset) -> dict[str, NDArray[np.float64]]:
    """What a case comes to by its label: the cost, or the state at the end."""
    if _has_cost(data):
        return {"cost": data["cost"].values}
    names = [str(name) for name in data["coordinate"].values][:_MOST_MEASURES]
    # The last values of q that are numbers: arrays of fewer steps end in NaN.
    q = data["q"].transpose(..., "node", "coordinate").values
    number = np.maximum(1, np.isfinite(q[..., 0]).sum(axis=-1)) - 1
    ends = np.moveaxis(np.asarray(np.take_along_axis(q, number[..., None, None], axis=-2)[..., 0, :]), -1, 0)
    return {f"{label(name)} at the end": ends[i] for i, name in enumerate(names)}


def is_failed(data: Dataset) -> NDArray[np.bool_]:
    """Which cases have no solution."""
    return np.asarray(statuses(data) != "solved")


def has_jump(data: Dataset) -> NDArray[np.bool_]:
    """Which cases have a better neighbour beyond a jump of the cost."""
    return np.asarray(data["jump"].values == 1) if "jump" in data else np.zeros(data["status"].shape, bool)


def scale(axes: Any, values: NDArray[np.float64]) -> None:
    """Draw values over a logarithmic axis where they are wide."""
    if is_wide(values):
        axes.set_yscale("log")


def is_wide(values: NDArray[np.float64]) -> bool:
    """Whether values need a logarithmic scale."""
    finite = values[np.isfinite(values)]
    return finite.size > 1 and bool(finite.min() > 0.0) and bool(finite.max() > _WIDE * finite.min())
