"""The page of a report: its parts, the format of numbers, figures for all problems, and the HTML file.

The HTML file needs no other file. A scheme has the same colour in every figure.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.colors import hsv_to_rgb, to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from codegen.files import rendered
from codegen.show.figures.picture import AMBER, BLUE, DARK, GREEN, GREY, PINK, RED, SKY, STYLE

SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
"""The table for str.translate that turns digits into superscripts."""


@dataclass(frozen=True)
class Table:
    """A table: caption, column headings, rows of cells; `kind` is "words" if the cells are sentences."""

    caption: str
    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    kind: str = "numbers"

    def without_empty_columns(self) -> Table:
        """Return the table without the columns whose cells are all empty."""
        kept = [i for i, _ in enumerate(self.head) if any(row[i] for row in self.rows)]
        rows = tuple(tuple(row[i] for i in kept) for row in self.rows)
        return replace(self, head=tuple(self.head[i] for i in kept), rows=rows)


@dataclass(frozen=True)
class Picture:
    """A figure as SVG text, and its caption."""

    caption: str
    svg: str


@dataclass(frozen=True)
class Section:
    """A part of the page: title, paragraphs, tables and figures."""

    title: str
    texts: tuple[str, ...] = ()
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


def page(title: str, introduction: str, sections: Sequence[Section], environment: Mapping[str, object]) -> str:
    """Return the text of a self-contained HTML file; the footer shows the `environment`, values by name."""
    named: list[tuple[str, object]] = []
    for name, value in environment.items():
        if isinstance(value, Mapping):
            named += [(f"{name}, {inner}", entry) for inner, entry in value.items()]
        else:
            named.append((name, value))
    template = Path(__file__).parent / "templates/page.html.j2"
    return rendered(template, title=title, introduction=introduction, sections=sections, environment=named)


def number(value: float | None, digits: int = 3) -> str:
    """Return a number as text with `digits` significant digits; a dash for None, NaN and infinity."""
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
    """Return a time in seconds as text in milliseconds or seconds; a dash for None."""
    if value is None or not math.isfinite(value):
        return "–"
    if value < 1.0:
        return f"{number(1e3 * value)}\N{NO-BREAK SPACE}ms"
    return f"{number(value)}\N{NO-BREAK SPACE}s"


def listed(names: Sequence[str]) -> str:
    """Return the names joined by commas and a final "and"; "none" for an empty sequence."""
    if not names:
        return "none"
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]


def slope(x: Sequence[float], y: Sequence[float]) -> float:
    """Return the exponent a of y ~ x^a by least squares of the logarithms; NaN for fewer than three points."""
    if len(x) < 3:
        return math.nan
    return float(np.polyfit(np.log(x), np.log(np.maximum(y, 1e-300)), 1)[0])


def svg(draw: Callable[..., Figure], *arguments: object) -> str:
    """Return the figure of draw(*arguments) as SVG text that can be part of an HTML page."""
    with matplotlib.rc_context({**STYLE, "savefig.transparent": True}):
        figure, text = draw(*arguments), io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


_PALETTE = (
    RED, AMBER, GREEN, "#7FCDBB", BLUE, PINK, "#D6616B", SKY, "#084594", "#54278F", "#6A3D9A", DARK, "#B3A100",
    "#E7969C", "#8C6D31", "#843C39", "#637939", "#C2185B", GREY, "#31A354", "#393B79", "#7A5230", "#756BB1", "#E6550D",
)  # fmt: skip
"""The colours of schemes in the order of the registry; the hues of further schemes follow the golden ratio."""


@cache
def colour_of(scheme: str) -> str:
    """Return the colour of a scheme in all figures; without a registry entry, the colour depends on the name alone."""
    from codegen.discretise import schemes

    methods = ("hamiltonian", "variational", schemes.FIRST_ORDER, schemes.PARTICLES)
    names = list(dict.fromkeys(entry.name for method in methods for entry in schemes.of_method(method)))
    if scheme not in names:
        return _PALETTE[sum(map(ord, scheme)) % len(_PALETTE)]
    index = names.index(scheme)
    if index < len(_PALETTE):
        return _PALETTE[index]
    return to_hex(tuple(hsv_to_rgb((0.618034 * index % 1.0, 0.7, 0.6))))


def power_of_ten(value: float, _position: int | None = None) -> str:
    """Return a tick label in plain text, which matplotlib draws many times faster than a formula."""
    return "10" + str(round(math.log10(value))).translate(SUPERSCRIPTS) if value > 0.0 else ""


def times_of_drivers(rows: Sequence[tuple[str, float, bool]]) -> Figure:
    """Draw the seconds of drivers as bars on a logarithmic axis; a row is (name, seconds, True if solved)."""
    figure = Figure(figsize=(5.6, 0.36 * len(rows) + 0.7), layout="constrained")
    axes = figure.subplots()
    for height, (_, time, solved) in enumerate(rows[::-1]):
        axes.barh(height, time, color=BLUE if solved else "#D0D0D0", height=0.55)
        text = f"{1e3 * time:.3g} ms" + ("" if solved else ", not solved")
        axes.annotate(text, (time, height), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    names = [name for name, _, _ in rows][::-1]
    axes.set(xscale="log", yticks=range(len(names)), yticklabels=names, xlabel="seconds of one solve")
    axes.minorticks_off()
    axes.xaxis.set_major_formatter(FuncFormatter(power_of_ten))
    axes.margins(x=0.25)
    axes.grid(visible=False, axis="y")
    return figure
