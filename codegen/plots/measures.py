"""What a case of a sweep comes to in a figure: numbers, their scale, marks of failures and jumps, what has no room."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from codegen.plots import fans
from codegen.plots.style import CRIMSON, PINK, label, statuses

if TYPE_CHECKING:
    from xarray import Dataset

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
    curves = [label(name) for name in fans.groups_of(data)[1]] if has_curves else []
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
    ends = np.moveaxis(_at_end(data), -1, 0)
    return {f"{label(name)} at the end": ends[i] for i, name in enumerate(names)}


def _at_end(data: Dataset) -> NDArray[np.float64]:
    """The last values of q that are numbers: arrays of fewer steps end in NaN."""
    q = data["q"].transpose(..., "node", "coordinate").values
    number = np.maximum(1, np.isfinite(q[..., 0]).sum(axis=-1)) - 1
    return np.asarray(np.take_along_axis(q, number[..., None, None], axis=-2)[..., 0, :])


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
