"""Many trajectories in one panel: graded by a quantity, or as quantiles over time; and distributions of numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from codegen.plots.first_order import NORMAL_90, Prediction
from codegen.plots.panels import KINDS
from codegen.plots.style import AMBER, BLUE, DARK, body_map, label, statuses

if TYPE_CHECKING:
    from xarray import Dataset

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
