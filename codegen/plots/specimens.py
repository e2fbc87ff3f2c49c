"""The figure of specimens: their places in two dimensions, by the distances between them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from matplotlib.figure import Figure

from codegen.plots.picture import letter_size, new_figure
from codegen.plots.style import BLUE, DARK

MOST_NAMED = 80
"""Of more specimens, names would cover each other."""


def specimen_figure(points: Any, names: Sequence[str], share: float) -> Figure:
    """Points, shape (m, 2), with names; both axes have one scale, that of geodesic distance."""
    figure = new_figure(7.0, 6.0)
    axes = figure.add_subplot()
    axes.scatter(points[:, 0], points[:, 1], s=18, color=BLUE)
    for name, point in zip(names[: MOST_NAMED if len(names) <= MOST_NAMED else 0], points, strict=False):
        axes.annotate(name, point, xytext=(4, 3), textcoords="offset points", fontsize=letter_size(7), color=DARK)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_title(f"{len(names)} specimens by geodesic distance, {share:.0%} of it in two dimensions", loc="left")
    axes.set_xlabel("first direction")
    axes.set_ylabel("second direction")
    return figure
