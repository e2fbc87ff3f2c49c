"""What a picture is for: a page, a paper or a talk, which says how large it is, its letters, and its lines."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

import matplotlib
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch

from codegen.errors import ArgumentError

STYLE: dict[Any, Any] = {
    "font.size": 9.5,
    "axes.titlesize": 9.5,
    "axes.labelsize": 10.5,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-3, 4),
    "grid.color": "#e2e2e2",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "xtick.labelsize": 8.5,
    "ytick.labelsize": 8.5,
    "svg.hashsalt": "codegen",
}
"""Settings of matplotlib, to be used in a context."""


@dataclass(frozen=True)
class Style:
    """How large a picture is beside that on a page, its letters in points, how wide its lines are, dots per inch."""

    size: float
    letters: float
    lines: float
    resolution: float = 150.0

    def settings(self) -> dict[Any, Any]:
        """Settings of matplotlib."""
        scale = self.letters / STYLE["font.size"]
        scaled = {name: scale * value for name, value in STYLE.items() if name.endswith("size")}
        return {**STYLE, **scaled, "savefig.dpi": self.resolution, "pdf.fonttype": 42}


STYLES = {
    "page": Style(1.0, 9.5, 1.0),
    "paper": Style(7.1 / 12.0, 7.5, 0.7, 300.0),
    "talk": Style(13.3 / 12.0, 15.0, 1.7),
}
"""What pictures may be for: a page on a screen; the two columns of a journal, 180 mm in all; slides."""

_used: ContextVar[Style] = ContextVar("style", default=STYLES["page"])


@contextmanager
def using(name: str) -> Iterator[None]:
    """Draw in a style; ArgumentError for one that there is not."""
    if name not in STYLES:
        raise ArgumentError(f"there is no style {name!r}", f"give one of {', '.join(STYLES)}")
    token = _used.set(STYLES[name])
    try:
        with matplotlib.rc_context(STYLES[name].settings()):
            yield
    finally:
        _used.reset(token)


def new_figure(width: float, height: float, layout: Any = "constrained") -> Figure:
    """An empty figure of so many inches on a page, in the size of the style in use."""
    size = _used.get().size
    return Figure(figsize=(size * width, size * height), layout=layout)


def finished(figure: Figure) -> Figure:
    """The figure with lines and marks as wide as the style in use has them."""
    factor = _used.get().lines
    for line in figure.findobj(Line2D) if factor != 1.0 else ():
        line.set_linewidth(factor * line.get_linewidth())
        line.set_markersize(factor * line.get_markersize())
    for step in figure.findobj(StepPatch) if factor != 1.0 else ():
        step.set_linewidth(factor * step.get_linewidth())
    return figure


def letter_size(size: float) -> float:
    """The size of letters that have so many points on a page, in the style in use."""
    return size * _used.get().letters / STYLES["page"].letters


def letters_across(figure: Figure) -> int:
    """How many letters of a title stand side by side in a figure."""
    return int(10.0 * figure.get_figwidth() * STYLES["page"].letters / _used.get().letters)
