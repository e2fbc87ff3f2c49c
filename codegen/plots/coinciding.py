"""Lines that coincide, as those over a quantity on which nothing depends: drawn in turn, so that each is seen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SAME, _MOST = 0.004, 0.5
"""How close lines coincide, in parts of all that is drawn; in which part of their places at least."""
_DASH = 8.0
"""The length of a dash, in widths of the line."""


def groups(rows: NDArray[np.float64], is_log: bool = False) -> list[list[int]]:
    """Which of the lines (lines, n) coincide, each with those it does, in their order; NaN is nowhere."""
    with np.errstate(invalid="ignore", divide="ignore"):
        heights = np.log(rows) if is_log else rows
    finite = heights[np.isfinite(heights)]
    close = _SAME * float(np.ptp(finite)) if finite.size else 0.0
    found: list[list[int]] = []
    for line in range(len(rows)):
        own = next((group for group in found if _coincide(heights[line], heights[group[0]], close)), None)
        if own is None:
            found.append([line])
        else:
            own.append(line)
    return found


def _coincide(one: NDArray[np.float64], other: NDArray[np.float64], close: float) -> bool:
    both = np.isfinite(one) & np.isfinite(other)
    number = int(both.sum())
    return number > 1 and int((np.abs(one[both] - other[both]) <= close).sum()) >= _MOST * number


def looks(groups: Sequence[Sequence[int]]) -> dict[int, dict[str, Any]]:
    """How each line is drawn: as it is where it stands alone, else in dashes and marks that take turns."""
    found: dict[int, dict[str, Any]] = {}
    for group in groups:
        number = len(group)
        for turn, line in enumerate(group):
            # The pattern begins with its dash: that of a later turn begins so many dashes before its end.
            begin = (_DASH * (number - turn)) % (_DASH * number)
            dashes = (begin, (_DASH, _DASH * (number - 1)))
            found[line] = {"linestyle": dashes, "markevery": (turn, number)} if number > 1 else {}
    return found


def legend(axes: Any) -> None:
    """A legend in which lines are whole that are drawn in dashes."""
    for handle in axes.legend(loc="best").get_lines():
        if handle.get_linestyle() not in ("None", "none", " ", ""):
            handle.set_linestyle("-")
