"""Figures that every problem has: error against steps and run time, the same colour for a scheme everywhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

from matplotlib.colors import hsv_to_rgb, to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator

from codegen.evidence.report.page import SUPERSCRIPTS
from codegen.show.figures.picture import AMBER, BLUE, DARK, GREEN, GREY, PINK, RED, SKY

_PALETTE = (
    RED, AMBER, GREEN, "#7FCDBB", BLUE, PINK, "#D6616B", SKY, "#084594", "#54278F", "#6A3D9A", DARK, "#B3A100",
    "#E7969C", "#8C6D31", "#843C39", "#637939", "#C2185B", GREY, "#31A354", "#393B79", "#7A5230", "#756BB1", "#E6550D",
)  # fmt: skip
"""Colours of schemes in the order in which the registry lists them; what follows turns around the circle of hues."""
_MARKERS = {1: "", 2: "", 4: "o", 6: "s", 8: "^"}


MANY = 12
"""More lines than this want larger axes."""
LEAST_SPAN = 10.0
"""Of an axis of steps or seconds: a narrower one would magnify nothing but the clock's noise."""


@dataclass(frozen=True)
class Line:
    """Points of a scheme, by growing number of steps; what is None or zero is left out of logarithmic axes."""

    scheme: str
    method: str
    order: int
    steps: Sequence[int]
    seconds: Sequence[float | None]
    errors: Sequence[float | None]

    @property
    def label(self) -> str:
        """What the legend says."""
        return f"{self.method} {self.scheme}"


def colour_of(scheme: str) -> str:
    """The colour that a scheme has in every figure; that of one which no list names depends on its name alone."""
    number = _numbers().get(scheme)
    if number is None:
        return _PALETTE[sum(map(ord, scheme)) % len(_PALETTE)]
    if number < len(_PALETTE):
        return _PALETTE[number]
    return to_hex(tuple(hsv_to_rgb((0.618034 * number % 1.0, 0.7, 0.6))))


@cache
def _numbers() -> dict[str, int]:
    """Schemes by name, with their numbers in the registry."""
    from codegen.discretise import schemes

    methods = ("hamiltonian", "variational", schemes.FIRST_ORDER, schemes.PARTICLES)
    names = dict.fromkeys(scheme.name for method in methods for scheme in schemes.of_method(method))
    return {name: number for number, name in enumerate(names)}


def look(line: Line) -> dict[str, Any]:
    """Keywords of a plotted line: variational schemes are dashed, higher orders have marks."""
    return {
        "color": colour_of(line.scheme),
        "linestyle": "--" if line.method == "variational" else "-",
        "marker": _MARKERS.get(line.order, "o"),
        "markersize": 3.2,
        "linewidth": 1.3,
    }


def work_precision(groups: Sequence[tuple[str, Sequence[Line]]], floor: float | None = None) -> Figure:
    """One row for every kind of error (its name, and a line for each scheme): against steps, and against seconds."""
    count = len({line.label for _, lines in groups for line in lines})
    height = (2.75 if count <= MANY else 3.9) * len(groups) + 0.2 * math.ceil(count / 3)
    figure = Figure(figsize=(9.2 if count <= MANY else 10.8, height + 0.3), layout="constrained")
    axes = figure.subplots(len(groups), 2, squeeze=False, sharey="row")
    for (name, lines), (left, right) in zip(groups, axes, strict=True):
        for line in lines:
            points = [(n, s, e) for n, s, e in zip(line.steps, line.seconds, line.errors, strict=True) if e and s]
            if not points:
                continue
            left.loglog([n for n, _, _ in points], [e for _, _, e in points], label=line.label, **look(line))
            right.loglog([s for _, s, _ in points], [e for _, _, e in points], **look(line))
        left.set_ylabel(name)
        if floor and (name, lines) == tuple(groups[0]):
            for place in (left, right):
                place.axhline(floor, color=GREY, linewidth=0.8, linestyle=":")
            left.annotate("bound of the reference's error", (0.01, floor), xycoords=("axes fraction", "data"),
                          fontsize=7.5, color=DARK, va="bottom",
                          bbox={"facecolor": "white", "edgecolor": "none", "pad": 0.5, "alpha": 0.8})  # fmt: skip
        for place in (left, right):
            place.yaxis.set_major_locator(LogLocator(numticks=8))
            place.minorticks_off()
            _plain_powers(place.xaxis, place.yaxis)
            _plain_ticks(place)
    axes[-1][0].set_xlabel("steps $N$")
    axes[-1][1].set_xlabel("seconds of one solve")
    handles: dict[str, Any] = {}
    for place in axes[:, 0]:
        found = place.get_legend_handles_labels()
        handles |= dict(zip(found[1], found[0], strict=True))
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3)
    return figure


def _plain_powers(*axes: Any) -> None:
    """Powers of ten at ticks in plain text, which is set many times as fast as formulas."""
    for axis in axes:
        axis.set_major_formatter(FuncFormatter(_power_of_ten))


def _power_of_ten(value: float, _place: int | None = None) -> str:
    return "10" + str(round(math.log10(value))).translate(SUPERSCRIPTS) if value > 0.0 else ""


def _plain_ticks(axes: Any) -> None:
    """Ticks at 1, 2 and 5 times powers of ten where an axis spans little more than a decade, which is the least."""
    low, high = axes.get_xlim()
    if high / low < LEAST_SPAN:
        middle = math.sqrt(low * high)
        low, high = middle / math.sqrt(LEAST_SPAN), middle * math.sqrt(LEAST_SPAN)
        axes.set_xlim(low, high)
    if high / low < 60.0:
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0), numticks=12))
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def times_of_drivers(rows: Sequence[tuple[str, float, bool]]) -> Figure:
    """Bars of the seconds of each driver (name, seconds, solved), on a logarithmic axis."""
    figure = Figure(figsize=(5.6, 0.36 * len(rows) + 0.7), layout="constrained")
    axes = figure.subplots()
    names = [name for name, _, _ in rows][::-1]
    for place, (_, seconds, solved) in enumerate(rows[::-1]):
        axes.barh(place, seconds, color=BLUE if solved else "#D0D0D0", height=0.55)
        text = f"{1e3 * seconds:.3g} ms" + ("" if solved else ", not solved")
        axes.annotate(text, (seconds, place), xytext=(4, 0), textcoords="offset points", va="center", fontsize=8)
    axes.set(xscale="log", yticks=range(len(names)), yticklabels=names, xlabel="seconds of one solve")
    axes.minorticks_off()
    _plain_powers(axes.xaxis)
    axes.margins(x=0.25)
    axes.grid(visible=False, axis="y")
    return figure
