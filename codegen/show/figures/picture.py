"""Pictures as notebooks show them and as files: a figure of matplotlib, and a film.

What all pictures share: colours, symbols as mathematics, titles.
"""

from __future__ import annotations

import base64
import io
import json
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch
from numpy.typing import NDArray

from codegen.errors import ArgumentError
from codegen.files import replacing
from codegen.solving.results.result import Result
from codegen.symbolic import latex

if TYPE_CHECKING:
    from xarray import Dataset

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


_MOST_PANELS = 16


def words_of(figure: Figure) -> str:
    """The title of a figure, and what each of its panels shows, from where to where."""
    title = _plain(str(figure.get_label()) or " ".join(figure.get_suptitle().split()))
    panels = list(dict.fromkeys(text for axes in figure.axes if (text := _panel(axes))))
    shown = "; ".join(panels[:_MOST_PANELS])
    more = f"; and {len(panels) - _MOST_PANELS} more" if len(panels) > _MOST_PANELS else ""
    return ". ".join(part for part in (title, f"Shown: {shown}{more}" if shown else "") if part) + "."


def _panel(axes: Any) -> str:
    """A panel's quantity with its range and what it is drawn over; a drawing by its title and legend."""
    name, over = _plain(axes.get_ylabel()), _plain(axes.get_xlabel())
    titles = [_plain(axes.get_title(loc=side)) for side in ("left", "center", "right")]
    if not name and not over:
        what = ", ".join([*filter(None, titles), *_entries(axes)])
        return f"a drawing of the system{f' ({what})' if what else ''}" if axes.has_data() or axes.artists else what
    # The least and the greatest value of all curves of a panel that have more than two points.
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


def _entries(axes: Any) -> list[str]:
    legend = axes.get_legend() or next(iter(axes.figure.legends), None)
    return [_plain(text.get_text()) for text in legend.get_texts()] if legend is not None else []


def _plain(text: str) -> str:
    r"""Words for mathematics: $\dot{\theta}_{1}$ is `rate of theta_1`."""
    text = re.sub(r"\\dot\{((?:[^{}]|\{[^{}]*\})*)\}", r"rate of \1", text)
    text = re.sub(r"\\mathrm\{([^{}]*)\}", r"\1", text)
    text = re.sub(r"\\var(?=phi|epsilon)", "", text)
    return re.sub(r"[${}\\]", "", text).strip()


_DPI = 110
_TOLD = {".png": "Description", ".pdf": "Subject", ".svg": "Description"}
"""Kinds of pictures, and what their formats call the text that says what is shown."""


def write(figure: Figure, path: Path, style: str = "page") -> None:
    """Write a figure, with the text of what it shows, into a file whose ending matplotlib knows."""
    kind = path.suffix.lower()
    metadata: dict[str, Any] = {_TOLD[kind]: words_of(figure)} if kind in _TOLD else {}
    with using(style):
        figure.savefig(path, metadata=metadata | ({"Date": None} if kind == ".svg" else {}))


def image(data: bytes, kind: str, text: str) -> str:
    """A picture as an element of a page, with the text that stands for it."""
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    return f'<img alt="{escape(text)}" src="{source}" style="max-width:100%">'


@dataclass(frozen=True, eq=False)
class Picture:
    """A `figure` of matplotlib in its style, which a notebook shows; `save` writes it to a file."""

    figure: Figure
    style: str = "page"

    @property
    def text(self) -> str:
        """What the figure shows, in words: every panel with its quantity and its range; files have it as well."""
        return words_of(self.figure)

    def save(self, path: Path | str) -> None:
        """Write the figure to a file, .png, .pdf or .svg; ArgumentError for another ending."""
        if Path(path).suffix.lower() not in _TOLD:
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
    """A film of a motion: `data` are the bytes of a GIF, which a notebook shows; `save` writes it to a file."""

    data: bytes = field(repr=False)  # hundreds of kilobytes, which notebooks keep as text beside the picture
    title: str
    _written: Callable[[Path], None] = field(repr=False)

    def save(self, path: Path | str) -> None:
        """Write the film, .gif or .mp4; ArgumentError for another ending, or where ffmpeg is missing or fails."""
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
"""Colours that remain distinct for colour-blind readers: Okabe and Ito (2008), Color universal design."""
GREY, DARK = "#707070", "#303030"
CRIMSON = "#BE1E2D"
"""Arrows."""
FORBIDDEN = "#F6DFD3"
"""The side of a bound that must not be entered."""

MOST_BODY_COLOURS = 7
"""As many bodies have colours of their own; more are graded."""

_SIGNS = (("**", "^"), ("<=", "≤"), (">=", "≥"), ("*", "·"))


def body_colours(bodies: int, single: str) -> list[Any]:
    """A colour for every body; that of a `single` one is given."""
    if bodies == 1:
        return [single]
    if bodies <= MOST_BODY_COLOURS:
        return [BLUE, GREEN, PINK, AMBER, SKY, DARK, GREY][:bodies]
    return [body_map()(index / (bodies - 1)) for index in range(bodies)]


def body_map() -> Any:
    """The colour map along which many bodies are graded; its palest end is left out."""
    whole = matplotlib.colormaps["viridis"]
    return matplotlib.colors.ListedColormap(whole([0.92 * i / 255 for i in range(256)]))


def label(name: str) -> str:
    """A symbol's name as mathematics: phi1 becomes a Greek letter with an index."""
    parts = re.sub(r"(?<=[A-Za-z])(\d+)$", r"_\1", name).split("_")
    letters = [_letter(part) for part in parts if part] or [latex.word(name)]
    return "$" + letters[0] + ("_{" + ",".join(letters[1:]) + "}" if len(letters) > 1 else "") + "$"


def _letter(name: str) -> str:
    rest = name[1:]
    if name.startswith("d") and rest and not rest.isdigit() and not latex.word(rest).startswith(r"\mathrm"):
        return rf"\dot{{{latex.word(rest)}}}"
    return latex.word(name)


def relation(text: str, longest: int = 46) -> str:
    """A relation as its author wrote it, with the signs of mathematics, no longer than that many characters."""
    for sign, better in _SIGNS:
        text = text.replace(sign, better)
    return text if len(text) <= longest else text[: longest - 1] + "…"


def title(figure: Figure, result: Result, notes: Sequence[str] = ()) -> None:
    """What was solved, how, and with what outcome; `notes` come last."""
    outcome = [f"{result.method}, {result.scheme}, {result.intervals}"]
    outcome += [f"cost {result.cost:.6g}"] if result.cost is not None else []
    outcome += [] if result.solved else [f"NOT SOLVED: {result.status}"]
    letters = letters_across(figure)
    texts = result.title.rstrip("."), ", ".join([*outcome, *notes])
    figure.set_label(". ".join(texts))
    figure.suptitle(
        "\n".join(line for text in texts for line in textwrap.wrap(text, letters)), fontsize=letter_size(11)
    )


def quantity(name: str, data: Dataset | None = None) -> str:
    """What a varied quantity is called; prescribed values have the end and the name, as in `start.r`.

    The units of a sweep's `data` stand behind it, where its author gave them.
    """
    end, dot, own = name.partition(".")
    text = f"{label(own)} at the {end}" if dot else label(name)
    unit = json.loads(data.attrs.get("units", "{}")).get(own or name, "") if data is not None else ""
    return f"{text} ({unit})" if unit else text


def statuses(data: Dataset) -> NDArray[np.str_]:
    """The status of each case of a sweep, of whatever type of words a file has them."""
    values = data["status"].values
    return np.array(values.ravel().tolist(), dtype=np.str_).reshape(values.shape)


def heading(figure: Figure, data: Dataset, where: str = "") -> None:
    """What a sweep has solved, how, how many of its cases failed, and `where` those lie that are drawn."""
    own = data.attrs
    steps = [f"{own['steps']} steps"] if "steps" in own else []
    status = statuses(data)
    failed = int((status != "solved").sum())
    outcome = f"{status.size} cases" + (f", {failed} FAILED" if failed else "")
    letters = letters_across(figure)
    texts = str(own["title"]).rstrip("."), ", ".join([own["formulation"], own["scheme"], *steps, outcome]) + where
    figure.set_label(". ".join(texts))
    figure.suptitle(
        "\n".join(line for text in texts for line in textwrap.wrap(text, letters)), fontsize=letter_size(11)
    )


@dataclass(frozen=True)
class Units:
    """Units by names of quantities, as texts; `t` is the time, `energy` the energy. What is missing has none."""

    by_name: Mapping[str, str]

    @classmethod
    def of(cls, result: Result, time: str = "") -> Units:
        """Those of a result; `time` is what else is known of the unit of the time."""
        return cls({**({"t": time} if time else {}), **result.units})

    @property
    def time(self) -> str:
        """The label of an axis of time."""
        return self.named("time", "t")

    def label(self, name: str) -> str:
        """The label of an axis of a quantity."""
        return self.named(label(name), name)

    def named(self, text: str, name: str) -> str:
        """A text for a quantity, with its unit."""
        unit = self.by_name.get(name, "")
        return f"{text} ({unit})" if unit else text
