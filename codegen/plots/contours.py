"""Contours of a map, with labels where they can be read: none where lines are close, as where a cost is steep."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm, Normalize
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from codegen.plots.purposes import letter_size
from codegen.plots.style import DARK

_APART, _LONG, _LETTERS = 1.4, 6.0, 7.5
"""How far a label is from other lines and how long its own is, at least, in heights of letters; their size."""


def contours(axes: Any, x: NDArray[np.float64], y: NDArray[np.float64], shown: NDArray[Any], norm: Normalize) -> None:
    """Lines of round values of a table (y, x), with a label each where there is room for it."""
    levels = _levels(norm)
    if min(shown.shape) <= 2 or not np.isfinite(shown).any() or not levels.size:
        return
    halo = [withStroke(linewidth=2.0, foreground="#ffffffa0")]
    lines = axes.contour(x, y, np.ma.masked_invalid(shown), levels, colors=DARK, linewidths=0.7)
    lines.set_path_effects(halo)
    places = list(_places(axes, lines.allsegs))
    if places:
        for text in axes.clabel(lines, fontsize=letter_size(_LETTERS), fmt="%.4g", manual=places):
            text.set_path_effects(halo)


def _places(axes: Any, segments: Sequence[Sequence[NDArray[np.float64]]]) -> Iterator[tuple[float, float]]:
    """Where labels stand, in data: on each level where there is most room about it, if there is enough.

    `segments` are the lines of each level as points (n, 2). Sizes are those of the panel before its surroundings are
    laid out, which is near enough.
    """
    letter = letter_size(_LETTERS) * axes.figure.dpi / 72.0
    on_page = [
        [_dense(axes.transData.transform(line), letter) for line in lines if len(line) > 1] for lines in segments
    ]
    placed: list[NDArray[np.float64]] = [_frame(axes.bbox, letter)]
    for level, lines in enumerate(on_page):
        others = np.concatenate([*placed, *(line for k, rest in enumerate(on_page) if k != level for line in rest)])
        # Both ends of a label need room as well as its middle.
        inner = [line[2:-2] for line in lines if len(line) >= 2 * _LONG]
        if not inner:
            continue
        points = np.concatenate(inner)
        room = np.array([np.sqrt(((others - point) ** 2).sum(axis=1).min()) for point in points])
        best = int(np.argmax(room))
        if room[best] > _APART * letter:
            placed.append(points[[best]])
            x, y = axes.transData.inverted().transform(points[best])
            yield float(x), float(y)


def _dense(line: NDArray[np.float64], letter: float) -> NDArray[np.float64]:
    """Points (n, 2) along a line, half a letter apart."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.linspace(0.0, along[-1], max(2, int(2.0 * along[-1] / letter)))
    return np.column_stack([np.interp(places, along, column) for column in line.T])


def _frame(box: Any, letter: float) -> NDArray[np.float64]:
    """The edges of a panel as a closed line of points."""
    corners = np.array([(box.x0, box.y0), (box.x1, box.y0), (box.x1, box.y1), (box.x0, box.y1), (box.x0, box.y0)])
    return _dense(corners, letter)


def _levels(norm: Normalize) -> NDArray[np.float64]:
    """Round values between the least and the largest, for contours."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    least, most = float(norm.vmin or 0.0), float(norm.vmax or 0.0)
    if not least < most:
        return np.zeros(0)
    few = (1.0,) if most > 1e3 * least else (1.0, 2.0, 5.0)
    locator: Any = LogLocator(subs=few) if isinstance(norm, LogNorm) else MaxNLocator(8)
    found = np.asarray(locator.tick_values(least, most), dtype=float)
    return found[(found > least) & (found < most)]
