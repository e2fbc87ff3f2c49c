"""The styles of figures, and the pictures and films that notebooks show."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, ListedColormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import LayoutEngine
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch

from codegen.errors import ArgumentError
from codegen.files import replacing

Look: TypeAlias = dict[str, Any]  # keyword arguments of matplotlib by name, such as a colour and a line width
Colour: TypeAlias = str | tuple[float, float, float, float]

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
"""Settings of matplotlib for a figure in the style of a page."""


@dataclass(frozen=True)
class Style:
    """A style: size and line width relative to a page, letters in points, dots per inch, and contents.

    Without `has_title` only figures of failed solves have a title. Without `has_details` the figure of an optimum omits
    multipliers and iterations, and without `has_guess` the initial guess. A slide has an aspect ratio of 16:9, with the
    drawing at the left.
    """

    size: float
    letters: float
    lines: float
    resolution: float = 150.0
    has_title: bool = True
    has_details: bool = True
    has_guess: bool = True
    is_slide: bool = False

    def settings(self) -> dict[Any, Any]:
        """Return the settings of matplotlib for the style."""
        scale = self.letters / STYLE["font.size"]
        scaled = {name: scale * value for name, value in STYLE.items() if name.endswith("size")}
        return {**STYLE, **scaled, "savefig.dpi": self.resolution, "pdf.fonttype": 42}


STYLES = {
    "page": Style(1.0, 9.5, 1.0),
    "paper": Style(7.1 / 12.0, 7.5, 0.7, 300.0, has_title=False, has_details=False, has_guess=False),
    "talk": Style(13.3 / 12.0, 15.0, 1.7, has_details=False, is_slide=True),
}
"""Styles by use: a page on a screen, both columns of a journal page (180 mm), and slides."""

_used: ContextVar[Style] = ContextVar("style", default=STYLES["page"])


@contextmanager
def using(name: str) -> Iterator[None]:
    """Apply a style to figures drawn in the context; raises ArgumentError for an unknown style."""
    if name not in STYLES:
        raise ArgumentError(f"there is no style {name!r}", f"give one of {', '.join(STYLES)}")
    token = _used.set(STYLES[name])
    try:
        with matplotlib.rc_context(STYLES[name].settings()):
            yield
    finally:
        _used.reset(token)


def present_style() -> Style:
    """Return the style of the surrounding `using`, or the style of a page."""
    return _used.get()


def new_figure(width: float, height: float, layout: LayoutEngine | None = None) -> Figure:
    """Return an empty figure; its size in inches is for a page and is scaled to the present style.

    A slide has an aspect ratio of 16:9, and is widened for a high figure.
    """
    style = _used.get()
    width, height = style.size * width, style.size * height
    if style.is_slide:
        width = max(width, 16.0 / 9.0 * height)
        height = 9.0 / 16.0 * width
    return Figure(figsize=(width, height), layout=layout or "constrained")


def finished(figure: Figure) -> Figure:
    """Return the figure with lines and marks scaled to the present style."""
    factor = _used.get().lines
    for line in figure.findobj(Line2D) if factor != 1.0 else ():
        line.set_linewidth(factor * line.get_linewidth())
        line.set_markersize(factor * line.get_markersize())
    for step in figure.findobj(StepPatch) if factor != 1.0 else ():
        step.set_linewidth(factor * step.get_linewidth())
    return figure


def letter_size(size: float) -> float:
    """Return a letter size, which is in points on a page, scaled to the present style."""
    return size * _used.get().letters / STYLES["page"].letters


_MOST_PANELS = 16


def words_of(figure: Figure) -> str:
    """Return a description of a figure: the title, and the quantity and range of each panel."""
    title = _plain(str(figure.get_label()) or " ".join(figure.get_suptitle().split()))
    panels = list(dict.fromkeys(text for axes in figure.axes if (text := _panel(axes))))
    shown = "; ".join(panels[:_MOST_PANELS])
    more = f"; and {len(panels) - _MOST_PANELS} more" if len(panels) > _MOST_PANELS else ""
    return ". ".join(part for part in (title, f"Shown: {shown}{more}" if shown else "") if part) + "."


def _panel(axes: Axes) -> str:
    """Return a description of a panel: quantity, range and abscissa, or the title and legend of a drawing."""
    name, over = _plain(axes.get_ylabel()), _plain(axes.get_xlabel())
    titles = [_plain(axes.get_title(loc=side)) for side in ("left", "center", "right")]
    if not name and not over:
        what = ", ".join([*filter(None, titles), *_entries(axes)])
        return f"a drawing of the system{f' ({what})' if what else ''}" if axes.has_data() or axes.artists else what
    # Find the range of all curves with more than two points.
    tables = [np.asarray(line.get_ydata(), dtype=float) for line in axes.lines if np.size(line.get_ydata()) > 2]
    tables += [np.asarray(step.get_data().values, dtype=float) for step in axes.patches if hasattr(step, "get_data")]
    values = np.concatenate([np.zeros(0), *(table.ravel() for table in tables)])
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (1.0, 0.0)
    words = [name or next(filter(None, titles), "") or ", ".join(_entries(axes))]
    words += [f"from {low:.3g} to {high:.3g}"] if low <= high and name else []
    words += [f"over {over}"] if over and not over.startswith("time") else []
    words += [f"({titles[2]})"] if titles[2] else []
    return " ".join(filter(None, words))


def _entries(axes: Axes) -> list[str]:
    legend = axes.get_legend() or next(iter(axes.figure.legends), None)
    return [_plain(text.get_text()) for text in legend.get_texts()] if legend is not None else []


def _plain(text: str) -> str:
    r"""Return a label with words for mathematics: $\dot{\theta}_{1}$ becomes `rate of theta_1`."""
    text = re.sub(r"\\dot\{((?:[^{}]|\{[^{}]*\})*)\}", r"rate of \1", text)
    text = re.sub(r"\\mathrm\{([^{}]*)\}", r"\1", text)
    text = re.sub(r"\\var(?=phi|epsilon)", "", text)
    return re.sub(r"[${}\\]", "", text).strip()


_DPI = 110
_DESCRIPTIONS = {".png": "Description", ".pdf": "Subject", ".svg": "Description"}
"""File formats of pictures, and the metadata entry of each format for a description."""


def write(figure: Figure, path: Path, style: str = "page") -> None:
    """Write a figure to a file that matplotlib supports, with a description in words as metadata."""
    kind = path.suffix.lower()
    metadata: dict[str, str | None] = {_DESCRIPTIONS[kind]: words_of(figure)} if kind in _DESCRIPTIONS else {}
    with using(style):
        figure.savefig(path, metadata=metadata | ({"Date": None} if kind == ".svg" else {}))


def image(data: bytes, kind: str, text: str) -> str:
    """Return the bytes of a picture as an HTML element; `kind` is its format, `text` the alternative text."""
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return f'<img alt="{escape(text)}" src="{source}" style="max-width:100%">'


@dataclass(frozen=True, eq=False)
class Picture:
    """A `figure` of matplotlib and its style, for display in notebooks and for files."""

    figure: Figure
    style: str = "page"

    @property
    def text(self) -> str:
        """A description of the figure in words: every panel with its quantity and range. Saved files contain it too."""
        return words_of(self.figure)

    def save(self, path: Path | str) -> None:
        """Write the figure to a file .png, .pdf or .svg.

        Parameters
        ----------
        path : path
            The file.

        Raises
        ------
        ArgumentError
            For another ending.
        FileError
            If the file system refuses.
        """
        if Path(path).suffix.lower() not in _DESCRIPTIONS:
            raise ArgumentError(f"{path}: unknown kind of picture", "let it end in .png, .pdf or .svg")
        with replacing(Path(path)) as temporary:
            write(self.figure, temporary, self.style)

    def _repr_png_(self) -> bytes:
        file = io.BytesIO()
        with using(self.style):
            self.figure.savefig(file, format="png", dpi=_DPI)
        return file.getvalue()

    def _repr_html_(self) -> str:
        return image(self._repr_png_(), "png", self.text)


@dataclass(frozen=True, eq=False)
class Film:
    """A film of a motion, for display in notebooks and for files; `data` are the bytes of a GIF."""

    data: bytes = field(repr=False)  # hundreds of kilobytes
    title: str
    _written: Callable[[Path], None] = field(repr=False)

    def save(self, path: Path | str) -> None:
        """Write the film to a file .gif or .mp4.

        Parameters
        ----------
        path : path
            The file.

        Raises
        ------
        ArgumentError
            For another ending, or if ffmpeg is missing or fails.
        FileError
            If the file system refuses.
        """
        path = Path(path)
        if path.suffix.lower() not in (".gif", ".mp4"):
            raise ArgumentError(f"{path}: unknown kind of film", "let it end in .gif or .mp4")
        with replacing(path) as temporary:
            if path.suffix.lower() == ".gif":
                temporary.write_bytes(self.data)
            else:
                self._written(temporary)

    def _repr_html_(self) -> str:
        return image(self.data, "gif", f"Film: {self.title}")


BLUE, RED, GREEN, PINK, AMBER, SKY = "#0072B2", "#D55E00", "#009E73", "#B8578F", "#E69F00", "#56B4E9"
"""Colours that colour-blind readers can distinguish. Source: Okabe and Ito (2008), Color universal design."""
GREY, DARK = "#707070", "#303030"
CRIMSON = "#BE1E2D"
"""Colour of arrows."""
FORBIDDEN = "#F6DFD3"
"""Colour of the forbidden side of a bound."""

MOST_BODY_COLOURS = 7  # largest number of bodies with distinct colours; more bodies have colours of a colour map


def body_colours(bodies: int, single: str) -> list[Colour]:
    """Return a colour for every body; a single body has the colour `single`."""
    if bodies == 1:
        return [single]
    if bodies <= MOST_BODY_COLOURS:
        named: list[Colour] = [BLUE, GREEN, PINK, AMBER, SKY, DARK, GREY]
        return named[:bodies]
    return [body_map()(index / (bodies - 1)) for index in range(bodies)]


def body_map() -> Colormap:
    """Return the colour map for many bodies or cases: viridis without its palest end."""
    return ListedColormap(matplotlib.colormaps["viridis"]([0.92 * i / 255 for i in range(256)]))
