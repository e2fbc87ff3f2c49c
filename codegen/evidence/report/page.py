"""The page of a report: its parts, the form of numbers, figures that all problems share, and the HTML file.

The HTML file needs no other file. A scheme has the same colour in every figure.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import hsv_to_rgb, to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from codegen.files import rendered
from codegen.show.figures.picture import AMBER, BLUE, DARK, GREEN, GREY, PINK, RED, SKY, STYLE

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""A table for str.translate."""


@dataclass(frozen=True)
class Table:
    """A table: caption, names of the columns, rows of texts; `kind` is "words" if the cells are sentences."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    kind: str = "numbers"

    def without_empty_columns(self) -> Table:
        """The table without the columns whose cells are all empty."""
        kept = [i for i, _ in enumerate(self.head) if any(row[i] for row in self.rows)]
        rows = tuple(tuple(row[i] for i in kept) for row in self.rows)
        return replace(self, head=tuple(self.head[i] for i in kept), rows=rows)


@dataclass(frozen=True)
class Picture:
    """A figure as SVG, and its caption."""

    caption: str
    svg: str


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    title: str
    texts: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


def page(title: str, introduction: str, sections: Sequence[Section], environment: Mapping[str, object]) -> str:
    """The text of an HTML file that needs no other file."""
    named: list[tuple[str, object]] = []
    for name, value in environment.items():
        if isinstance(value, Mapping):
            named += [(f"{name}, {inner}", entry) for inner, entry in value.items()]
        else:
            named.append((name, value))
    template = Path(__file__).parent / "templates/page.html.j2"
    return rendered(template, title=title, introduction=introduction, sections=sections, environment=named)


def number(value: float | None, digits: int = 3) -> str:
    """A number with `digits` significant digits in the usual notation; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if value == 0.0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        decimals = max(0, digits - 1 - math.floor(math.log10(abs(value))))
        return f"{value:.{decimals}f}"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    return f"{mantissa}·10{str(int(exponent)).translate(SUPERSCRIPTS)}"


def seconds(value: float | None) -> str:
    """A time in milliseconds or seconds; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if value < 1.0:
        return f"{number(1e3 * value)}\N{NO-BREAK SPACE}ms"
    return f"{number(value)}\N{NO-BREAK SPACE}s"


def listed(names: Sequence[str]) -> str:
    """Names joined by commas and a final `and`; `none` for an empty sequence."""
    if not names:
        return "none"
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """The exponent a of y ~ x^a, by least squares; NaN for fewer than three points."""
    if len(x) < 3:
        return math.nan
    return float(np.polyfit(np.log(x), np.log(np.maximum(y, 1e-300)), 1)[0])


def svg(draw: Callable[..., Figure], *arguments: object) -> str:
    """The figure that a function of these arguments draws, as text that can be part of a page."""
    with matplotlib.rc_context({**STYLE, "savefig.transparent": True}):
        figure, text = draw(*arguments), io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


_PALETTE = (
    RED, AMBER, GREEN, "#7FCDBB", BLUE, PINK, "#D6616B", SKY, "#084594", "#54278F", "#6A3D9A", DARK, "#B3A100",
    "#E7969C", "#8C6D31", "#843C39", "#637939", "#C2185B", GREY, "#31A354", "#393B79", "#7A5230", "#756BB1", "#E6550D",
)  # fmt: skip
"""Colours of schemes in the order of the registry; the hues of further schemes follow the golden section."""
_MARKERS = {1: "", 2: "", 4: "o", 6: "s", 8: "^"}
MANY = 12
"""More lines than this need larger axes."""
LEAST_SPAN = 10.0
"""The least ratio between the ends of an axis of steps or seconds; a narrower axis would magnify the clock's noise."""


@dataclass(frozen=True)
class Line:
    """Points of a scheme, by growing number of steps; logarithmic axes omit values that are None or zero."""

    scheme: str
    method: str
    order: int
    steps: Sequence[int]
    seconds: Sequence[float | None]
    errors: Sequence[float | None]

    @property
    def label(self) -> str:
        """The entry of the legend."""
        return f"{self.method} {self.scheme}"

    def style(self) -> dict[str, Any]:
        """Keywords of a plotted line: variational schemes are dashed, higher orders have markers."""
        return {
            "color": colour_of(self.scheme), "linestyle": "--" if self.method == "variational" else "-",
            "marker": _MARKERS.get(self.order, "o"), "markersize": 3.2, "linewidth": 1.3,
        }  # fmt: skip


@cache
def colour_of(scheme: str) -> str:
    """The colour of a scheme in every figure; for a scheme outside the registry it depends on the name alone."""
    from codegen.discretise import schemes

    methods = ("hamiltonian", "variational", schemes.FIRST_ORDER, schemes.PARTICLES)
    names = list(dict.fromkeys(entry.name for method in methods for entry in schemes.of_method(method)))
    if scheme not in names:
        return _PALETTE[sum(map(ord, scheme)) % len(_PALETTE)]
    index = names.index(scheme)  # in the registry
    if index < len(_PALETTE):
        return _PALETTE[index]
    return to_hex(tuple(hsv_to_rgb((0.618034 * index % 1.0, 0.7, 0.6))))


def work_precision(groups: Sequence[tuple[str, Sequence[Line]]], floor: float | None = None) -> Figure:
    """One row for every kind of error (its name, and a line for each scheme): against steps, and against seconds."""
    count = len({line.label for _, lines in groups for line in lines})
    height = (2.75 if count <= MANY else 3.9) * len(groups) + 0.2 * math.ceil(count / 3)
    figure = Figure(figsize=(9.2 if count <= MANY else 10.8, height + 0.3), layout="constrained")
    rows = figure.subplots(len(groups), 2, squeeze=False, sharey="row")
    for index, ((name, lines), (left, right)) in enumerate(zip(groups, rows, strict=True)):
        for line in lines:
            points = [(n, s, e) for n, s, e in zip(line.steps, line.seconds, line.errors, strict=True) if e and s]
            if points:
                steps, times, errors = zip(*points, strict=True)
                left.loglog(steps, errors, label=line.label, **line.style())
                right.loglog(times, errors, **line.style())
        left.set_ylabel(name)
        if floor and index == 0:
            for axes in (left, right):
                axes.axhline(floor, color=GREY, linewidth=0.8, linestyle=":")
            left.annotate("bound of the reference's error", (0.01, floor), xycoords=("axes fraction", "data"),
                          fontsize=7.5, color=DARK, va="bottom",
                          bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8})  # fmt: skip
        for axes in (left, right):
            axes.yaxis.set_major_locator(LogLocator(numticks=8))
            axes.minorticks_off()
            for axis in (axes.xaxis, axes.yaxis):
                axis.set_major_formatter(FuncFormatter(_power_of_ten))
            # The x axis spans a decade at least, with ticks at 1, 2 and 5 times powers of ten if it spans little more.
            low, high = axes.get_xlim()
            if high / low < LEAST_SPAN:
                middle = math.sqrt(low * high)
                low, high = middle / math.sqrt(LEAST_SPAN), middle * math.sqrt(LEAST_SPAN)
                axes.set_xlim(low, high)
            if high / low < 60.0:
                axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
                axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    rows[-1][0].set_xlabel("steps $N$")
    rows[-1][1].set_xlabel("seconds of one solve")
    entries: dict[str, Artist] = {}
    for axes in rows[:, 0]:
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=3)
    return figure


def _power_of_ten(value: float, _position: int | None = None) -> str:
    """A tick label in plain text, which matplotlib sets many times as fast as a formula."""
    return "10" + str(round(math.log10(value))).translate(SUPERSCRIPTS) if value > 0.0 else ""


def times_of_drivers(rows: Sequence[tuple[str, float, bool]]) -> Figure:
    """Bars of the seconds of each driver (name, seconds, True if solved), on a logarithmic axis."""
    figure = Figure(figsize=(5.6, 0.36 * len(rows) + 0.7), layout="constrained")
    axes = figure.subplots()
    for height, (_, time, solved) in enumerate(rows[::-1]):
        axes.barh(height, time, color=BLUE if solved else "#D0D0D0", height=0.55)
        text = f"{1e3 * time:.3g} ms" + ("" if solved else ", not solved")
        axes.annotate(text, (time, height), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    names = [name for name, _, _ in rows][::-1]
    axes.set(xscale="log", yticks=range(len(names)), yticklabels=names, xlabel="seconds of one solve")
    axes.minorticks_off()
    axes.xaxis.set_major_formatter(FuncFormatter(_power_of_ten))
    axes.margins(x=0.25)
    axes.grid(visible=False, axis="y")
    return figure
