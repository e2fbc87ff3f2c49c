"""What all pictures share: colours, fonts, symbols as mathematics, titles."""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import StepPatch
from numpy.typing import NDArray

from codegen import lettering
from codegen.errors import ArgumentError
from codegen.solutions.result import Result

if TYPE_CHECKING:
    from xarray import Dataset

BLUE, RED, GREEN, PINK, AMBER, SKY = "#0072B2", "#D55E00", "#009E73", "#B8578F", "#E69F00", "#56B4E9"
"""Colours that remain distinct for colour-blind readers: Okabe and Ito (2008), Color universal design."""
GREY, DARK = "#707070", "#303030"
CRIMSON = "#BE1E2D"
"""Arrows."""
FORBIDDEN = "#F6DFD3"
"""The side of a bound that must not be entered."""

MOST_BODY_COLOURS = 7
"""As many bodies have colours of their own; more are graded."""

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

_SIGNS = (("**", "^"), ("<=", "≤"), (">=", "≥"), ("*", "·"))


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
    letters = [_letter(part) for part in parts if part] or [lettering.word(name)]
    return "$" + letters[0] + ("_{" + ",".join(letters[1:]) + "}" if len(letters) > 1 else "") + "$"


def _letter(name: str) -> str:
    rest = name[1:]
    if name.startswith("d") and rest and not rest.isdigit() and not lettering.word(rest).startswith(r"\mathrm"):
        return rf"\dot{{{lettering.word(rest)}}}"
    return lettering.word(name)


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


def heading(figure: Figure, data: Dataset) -> None:
    """What a sweep has solved, how, and how many of its cases failed."""
    own = data.attrs
    steps = [f"{own['steps']} steps"] if "steps" in own else []
    status = statuses(data)
    failed = int((status != "solved").sum())
    outcome = f"{status.size} cases" + (f", {failed} FAILED" if failed else "")
    letters = letters_across(figure)
    texts = str(own["title"]).rstrip("."), ", ".join([own["formulation"], own["scheme"], *steps, outcome])
    figure.set_label(". ".join(texts))
    figure.suptitle(
        "\n".join(line for text in texts for line in textwrap.wrap(text, letters)), fontsize=letter_size(11)
    )
