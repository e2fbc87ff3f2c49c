"""Measured orders of convergence, and the choice of a scheme: errors against run time, and figures with few curves.

Between numbers of steps N_i with errors e_i the local order is log(e_i/e_i+1)/log(N_i+1/N_i). It tends to the order of
the scheme until rounding errors dominate. An order is reported if local orders agree with each other over a range of N,
whatever their value. Without such a range, no order is reported and the verdict is "not asymptotic".

A grid reaches an error if its own error and those of all finer grids are not larger, up to the grid with the least
error. Between two grids the time and the number of steps are interpolated on logarithmic axes. The choice then does not
depend on the measured grids.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator
from scipy.stats import linregress

from codegen.evidence.report.page import Picture, Table, number, power_of_ten, seconds, slope, svg
from codegen.evidence.report.store import Values
from codegen.show.figures.picture import AMBER, BLUE, DARK, GREEN, GREY, PINK, RED, SKY

TARGETS = (1e-3, 1e-6, 1e-9)
MOST_CURVES = 8
CLEAR = 3.0  # the least ratio of an error to the error of the reference; smaller errors are not told from zero
CHEAPEST = (
    "The cheapest schemes. Times and numbers of steps are interpolated between grids, so that finer grids have no "
    "larger error, up to where rounding or the tolerance of the solver prevails."
)
_COLOURS = (BLUE, RED, GREEN, AMBER, PINK, SKY, "#54278F", DARK)
_WIDTH, _LEFT, _GUTTER, _WIDEST, _HEIGHT = 11.3, 0.62, 1.65, 3.6, 3.1
"""Sizes in inches: width of figures, room for the labels of an axis and of curves, width and height of panels."""
_GAP = 0.055  # the least distance of labels as a fraction of the height of a panel


@dataclass(frozen=True)
class Ladder:
    """The errors of a scheme on ever finer grids, by quantity, with the processor seconds of a solve.

    Errors and times are None where a solve failed. `order` is the order of the scheme. A peer is another program.
    """

    label: str
    order: int
    steps: Sequence[int]
    seconds: Sequence[float | None]
    errors: Mapping[str, Sequence[float | None]]
    is_peer: bool = False

    @property
    def short(self) -> str:
        """Return the label in figures."""
        words = {"variational ": "var. ", "hamiltonian ": "ham. ", "one-step ": "", ", controls at stages": ", stages",
                 ", linear controls": ", linear", "symplectic": "sympl.", "adjoint": "adj."}  # fmt: skip
        text = self.label
        for word, abbreviation in words.items():
            text = text.replace(word, abbreviation)
        return text

    def points(self, quantity: str) -> list[tuple[int, float, float]]:
        """Return the triples (steps, seconds, error) of all grids up to the one with the least error.

        Finer grids show rounding, or the tolerance of the solver.
        """
        rows = zip(self.steps, self.seconds, self.errors.get(quantity, ()), strict=False)
        points = [(n, time, error) for n, time, error in rows if time and error is not None]
        return points[: 1 + min(range(len(points)), key=lambda i: points[i][2])] if points else []

    def useful(self, quantity: str) -> list[tuple[float, float]]:
        """Return the pairs (seconds, error) of the grids that no other grid beats in both time and error."""
        best, kept = math.inf, []
        for time, error in sorted((time, error) for _, time, error in self.points(quantity)):
            if 0.0 < error < best:
                best = error
                kept.append((time, error))
        return kept

    def reach(self, quantity: str, target: float) -> tuple[float, float] | None:
        """Return the seconds and the number of steps from which on the error is at most `target`, or None."""
        points = self.points(quantity)
        first = len(points)
        while first > 0 and points[first - 1][2] <= target:
            first -= 1
        if first == len(points):
            return None
        steps, time, error = points[first]
        if first == 0 or error <= 0.0:
            return time, float(steps)
        fewer, shorter, larger = points[first - 1]
        part = math.log(larger / target) / math.log(larger / error)
        return shorter * (time / shorter) ** part, fewer * (steps / fewer) ** part


def ranking(ladders: Sequence[Ladder], quantity: str, target: float) -> list[tuple[Ladder, float, float]]:
    """Return the schemes that reach an error, with seconds and numbers of steps; the fastest comes first, no peers."""
    own = [ladder for ladder in ladders if not ladder.is_peer]
    reached = [(ladder, *result) for ladder in own if (result := ladder.reach(quantity, target)) is not None]
    return sorted(reached, key=lambda row: row[1])


def speed(ladder: Ladder, quantity: str) -> tuple[float, ...]:
    """Return the seconds to 1e-6, 1e-3 and 1e-9, by which tables are sorted; infinity for an error without a grid."""
    reached = (ladder.reach(quantity, target) for target in (TARGETS[1], TARGETS[0], TARGETS[2]))
    return tuple(math.inf if result is None else result[0] for result in reached)


def choice(ladders: Sequence[Ladder], quantities: Mapping[str, float]) -> tuple[list[str], Table]:
    """Return sentences on the fastest schemes, and their table; `quantities` have the errors of their references.

    The first ladder is the default scheme.
    """
    sentences, rows, default = [], [], ladders[0]
    for quantity, uncertainty in quantities.items():
        parts = []
        for target in TARGETS:
            name = power_of_ten(target)
            if target < CLEAR * uncertainty:
                rows.append((quantity, name, "the reference is not accurate enough", *["–"] * 4))
                continue
            reached = ranking(ladders, quantity, target)
            if not reached:
                rows.append((quantity, name, "no scheme on these grids", *["–"] * 4))
                continue
            best, time, steps = reached[0]
            parts.append(f"{name}: {best.label}, in {seconds(time)}")
            second = next((f"{other.label}, × {number(t / time, 2)}" for other, t, _ in reached[1:]), "–")
            usual = default.reach(quantity, target)
            comparison = "–" if usual is None else f"{seconds(usual[0])}, × {number(usual[0] / time, 2)}"
            rows.append((quantity, name, best.label, f"{steps:.0f}", seconds(time), second, comparison))
        if parts:
            sentences.append(f"Fastest to an error of {quantity} of {'; '.join(parts)}.")
    head = ("error of", "at most", "fastest scheme", "steps", "processor time", "next", f"default ({default.label})")
    return sentences, Table(CHEAPEST, head, tuple(rows), "words")


def reach_columns(ladder: Ladder, quantities: Sequence[str]) -> tuple[str, ...]:
    """Return the cells with the seconds of a scheme to 1e-3, 1e-6 and 1e-9 for each quantity."""
    reached = [ladder.reach(quantity, target) for quantity in quantities for target in TARGETS]
    return tuple("–" if result is None else seconds(result[0]) for result in reached)


def figures(ladders: Sequence[Ladder], quantities: Mapping[str, float], deciding: str) -> list[Picture]:
    """Return a figure of the schemes to choose from, and figures of all others with the default scheme in grey.

    The first figure has peers, the fastest scheme for each quantity and error, and the next schemes by the quantity
    `deciding`. `quantities` have the errors of their references.
    """
    default = ladders[0]
    fastest = [rows[0][0] for q in quantities for target in TARGETS if (rows := ranking(ladders, q, target))]
    following = [row[0] for target in (TARGETS[1], *TARGETS) for row in ranking(ladders, deciding, target)]
    peers = [ladder for ladder in ladders if ladder.is_peer]
    by_label = {ladder.label: ladder for ladder in (default, *peers, *fastest, *following, *ladders)}
    chosen = list(by_label.values())[:MOST_CURVES]
    others = sorted((ladder for ladder in ladders if ladder not in chosen), key=lambda ladder: ladder.order)
    caption = (
        "Error against processor time of one solve: the fastest schemes for each error in the table, and the default. "
        "Grids that a faster grid of the same scheme beats are left out. Dotted: error of the reference."
    )
    pictures = [Picture(caption, svg(_panels, chosen, quantities, None))]
    for first in range(0, len(others), MOST_CURVES - 1):
        part = others[first : first + MOST_CURVES - 1]
        orders = sorted({ladder.order for ladder in part})
        text = f"order {orders[0]}" if len(orders) == 1 else f"orders {orders[0]} to {orders[-1]}"
        caption = f"Other schemes, {text}; grey: the default, {default.label}."
        pictures.append(Picture(caption, svg(_panels, part, quantities, default)))
    return pictures


def _panels(ladders: Sequence[Ladder], quantities: Mapping[str, float], grey: Ladder | None) -> Figure:
    """Draw a panel for each quantity, with curves that are labelled at the right of the panel."""
    panel = min(_WIDEST, (_WIDTH - _LEFT) / len(quantities) - _GUTTER)
    height = _HEIGHT + 0.85
    figure = Figure(figsize=(_WIDTH, height))
    shown = [*ladders, *([] if grey is None else [grey])]
    points = [point for ladder in shown for quantity in quantities for point in ladder.useful(quantity)]
    times, errors = ([point[i] for point in points] for i in range(2))
    for index, (quantity, floor) in enumerate(quantities.items()):
        left = (_LEFT + index * (panel + _GUTTER)) / _WIDTH
        axes = figure.add_axes((left, 0.5 / height, panel / _WIDTH, _HEIGHT / height))
        axes.set(xscale="log", yscale="log", title=f"error of {quantity}", xlabel="milliseconds of one solve")
        if times and errors:
            axes.set_xlim(0.8 * min(times), 1.25 * max(times))
            axes.set_ylim(max(0.5 * min(errors), 1e-16), min(2.0 * max(errors), 30.0))
        ends = []
        for number_of_curve, ladder in enumerate(shown):
            if points := ladder.useful(quantity):
                colour = GREY if ladder is grey else _COLOURS[number_of_curve % len(_COLOURS)]
                axes.plot(*zip(*points, strict=True), color=colour, marker=".", markersize=4, linewidth=1.2)
                ends.append((points[-1], ladder.short, colour))
        if floor > 1e-15:
            axes.axhline(floor, color=GREY, linewidth=0.8, linestyle=":")
        _label(axes, ends)
        low, high = axes.get_xlim()
        axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 3.0) if high < 100.0 * low else (1.0,), numticks=6))
        bottom, top = axes.get_ylim()
        axes.yaxis.set_major_locator(
            LogLocator(1000.0 if top > 1e8 * bottom else 10.0, numticks=8)
        )  # errors of TARGETS
        axes.minorticks_off()
        axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: number(value * 1e3, 1)))
        axes.yaxis.set_major_formatter(FuncFormatter(power_of_ten))
        if index:
            axes.set_yticklabels([])
    return figure


def _label(axes: Axes, ends: Sequence[tuple[tuple[float, float], str, str]]) -> None:
    """Write labels at the right of the panel in the order of the ends of curves, each with a line to its end."""
    low, high = (math.log10(limit) for limit in axes.get_ylim())
    ordered = sorted(ends, key=lambda end: (end[0][1], end[0][0]))
    heights = [min(max((math.log10(error) - low) / (high - low), 0.0), 1.0) for (_, error), _, _ in ordered]
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + _GAP)
    top = 1.0
    for i in reversed(range(len(heights))):
        heights[i] = min(heights[i], top)
        top = heights[i] - _GAP
    for (end, text, colour), height in zip(ordered, heights, strict=True):
        axes.annotate(
            text, end, (1.06, height), xycoords="data", textcoords="axes fraction", color=colour, fontsize=7.5,
            va="center", annotation_clip=False,
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "linestyle": "-", "shrinkA": 1,
                        "shrinkB": 2, "relpos": (0.0, 0.5), "alpha": 0.6},
        )  # fmt: skip


# Measured orders

LEAST_POINTS, LEAST_RANGE = 3, 2.0
"""The least number of successive points in a least-squares fit, and the least ratio of its last to its first N."""
ABOVE, ABOVE_REFERENCE = 100.0, 30.0
"""A point counts if its error exceeds the plateau of rounding and the reference's error by these factors."""
LEAST_FIT, ABOVE_REFERENCE_FIT = 8, 5.0
"""The least number of grids in a fit to irregular errors, and their least ratio to the reference's error."""
SHRINKING = 0.75  # rounding errors dominate if an error exceeds this multiple of the error with half as many steps
SMALL = 1e-6  # the relative error above which rounding errors cannot dominate
LARGE = 0.5  # the relative error from which on a motion is unlike the exact motion and shows no order
SETTLED, SETTLED_HIGH, HIGH = 0.03, 0.15, 5.0
"""Local orders have settled if they differ by at most the first value, or by the second if they are above HIGH."""
TOLERANCE, TOLERANCE_HIGH = 0.1, 0.3
"""The largest accepted difference between measured and expected order, below order 6 and from order 6 on."""


@dataclass(frozen=True)
class Order:
    """A measured order, the largest difference of its local orders, and the least and the largest number of steps.

    For a fit to irregular errors, `spread` is the range of residuals, `uncertainty` twice the slope's standard error.
    """

    value: float
    spread: float
    coarsest: int
    finest: int
    uncertainty: float | None = None

    @property
    def range(self) -> str:
        """Return the range of numbers of steps as text."""
        return f"{self.coarsest}\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}{self.finest}"


@dataclass(frozen=True)
class Measured:
    """The solves of a scheme by increasing number of steps, their errors, and the order with its verdict.

    A mesh sequence has unknowns with `switching` bounds, the finest number of steps with its error, and a remark.
    """

    rows: list[Values]
    errors: list[float | None]
    order: Order | None
    expected: int
    verdict: str
    switching: tuple[str, ...] = ()
    finest: int | None = None
    finest_error: float | None = None
    remark: str = ""


def measured_order(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> Order | None:
    """Return the exponent a of errors ~ N^-a over the finest range of N where local orders have settled, or None.

    `floor` is the error of the reference with which `errors` were computed. The plateau of rounding follows from the
    errors themselves: it begins where they are small and no longer decrease.
    """
    points = [(n, error) for n, error in above_plateau(steps, errors, floor) if error < LARGE]
    for last in range(len(points) - 1, -1, -1):
        starts = range(last - LEAST_POINTS + 1, -1, -1)
        first = next((k for k in starts if points[last][0] >= LEAST_RANGE * points[k][0]), None)
        if first is None:
            continue
        chosen = points[first : last + 1]
        local = [math.log(e / f) / math.log(m / n) for (n, e), (m, f) in pairwise(chosen)]
        value = -slope([n for n, _ in chosen], [e for _, e in chosen])
        spread = max(local) - min(local)
        if spread <= (SETTLED_HIGH if value > HIGH else SETTLED):
            return Order(value, spread, chosen[0][0], chosen[-1][0])
    return None


def fitted_order(steps: Sequence[int], errors: Sequence[float], floor: float = 0.0) -> Order | None:
    """Return the exponent by least squares over all errors above the reference's error; None for too few grids.

    The fit serves irregular errors, which vary with the position of a switching time in its interval.
    """
    kept = [(n, error) for n, error in zip(steps, errors, strict=True) if error > ABOVE_REFERENCE_FIT * floor]
    if len(kept) < LEAST_FIT:
        return None
    x, y = np.log(kept).T
    fit = linregress(x, y)
    residuals = y - fit.slope * x - fit.intercept
    return Order(-float(fit.slope), float(np.ptp(residuals)), kept[0][0], kept[-1][0], 2.0 * float(fit.stderr))


def verdict(order: Order | None, expected: int) -> str:
    """Return the verdict on a measured order as text, which is empty if the order is as expected."""
    if order is None:
        return "not asymptotic"
    tolerance = max(TOLERANCE_HIGH if expected >= 6 else TOLERANCE, order.uncertainty or 0.0)
    if abs(order.value - expected) <= tolerance:
        return ""
    return "superconvergent" if order.value > expected else "below the expected order"


def order_text(order: Order | None, remark: str) -> str:
    """Return the measured order with a remark as text, or the remark alone without an order."""
    if order is None:
        return remark
    value = number(order.value) if order.uncertainty is None else f"{order.value:.2f} ± {order.uncertainty:.2f}"
    return f"{value}, {remark}" if remark else value


def is_exhausted(steps: Sequence[int], errors: Sequence[float | None]) -> bool:
    """Return True if the last errors lie on the plateau of rounding, so that more steps add no information."""
    finite = [error for error in errors if error is not None and math.isfinite(error)]
    return len(finite) >= LEAST_POINTS + 2 and len(above_plateau(steps, errors)) <= len(finite) - 3


def above_plateau(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> list[tuple[int, float]]:
    """Return pairs (steps, error) by increasing steps, up to where rounding or the reference ends convergence."""
    rows = sorted((n, e) for n, e in zip(steps, errors, strict=True) if e is not None and math.isfinite(e))
    kept: list[tuple[int, float]] = []
    for n, error in rows:
        if error <= max(ABOVE_REFERENCE * floor, 1e-300):
            break
        if error < SMALL and any(error > SHRINKING * e for k, e in kept if 2 * k <= n):
            plateau = min(e for _, e in rows)
            return [(k, e) for k, e in kept if e > ABOVE * plateau]
        kept.append((n, error))
    return kept
