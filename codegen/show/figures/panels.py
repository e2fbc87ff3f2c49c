"""Panels of a figure: curves, steps, bounds and their active parts, path inequalities, and iterations."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from codegen.show.figures.picture import (
    AMBER,
    BLUE,
    DARK,
    FORBIDDEN,
    GREEN,
    GREY,
    PINK,
    RED,
    Look,
    body_colours,
    letter_size,
)
from codegen.show.figures.quantities import Inequality, Quantity, in_unit, label, relation
from codegen.solving.loading import Matrix, Vector

KINDS = {"state": BLUE, "momentum": GREEN, "spin": GREEN, "multiplier": PINK, "control": RED}
"""Colours of the kinds of quantities for a single body."""

_FLAT = 1e-3  # relative range of a constrained expression below which it is drawn as constant
_LETTERS = 52  # number of letters on a line of the title of a panel
_DOTTED = (0, (1, 1.5))
_DASHED = (0, (5, 3))
_ACTIVE: Look = {"color": AMBER, "linewidth": 5.5, "alpha": 0.75, "zorder": 1.5}
_GUESS: Look = {"color": GREY, "linestyle": _DOTTED, "linewidth": 1.3, "zorder": 1.9}
_BOUND: Look = {"color": GREY, "linestyle": _DASHED, "linewidth": 1.0, "zorder": 1.2}
SWITCH: Look = {"color": GREY, "linewidth": 0.7, "alpha": 0.6, "zorder": 1.1}
"""Look of lines at the switches between phases."""
INNER: Look = {"color": GREY, "linewidth": 0.8, "linestyle": (0, (1, 2)), "zorder": 1.1}
"""Look of lines at the times of point constraints."""


def quantity(axes: Axes, shown: Quantity, second: Quantity | None = None) -> None:
    """Draw a quantity of every body over time, with its bounds and, for a single body, its initial guess.

    A `second` quantity is drawn dashed in the same panel.
    """
    single = shown.values.shape[1] == 1
    colours = body_colours(shown.values.shape[1], KINDS[shown.kind])
    width = 1.6 if single else 1.2
    for values, colour in zip(shown.values.T, colours, strict=True):
        _line(axes, shown, values, {"color": colour, "linewidth": width})
    if second is not None:
        for values, colour in zip(second.values.T, colours, strict=True):
            _line(axes, second, values, {"color": colour, "linewidth": width, "linestyle": _DASHED})
    if shown.guess is not None and single:
        _line(axes, shown, shown.guess[:, 0], _GUESS)
    if shown.kind == "state":
        for values, colour in zip(shown.values.T, colours, strict=True):
            axes.plot(shown.t[[0, -1]], values[[0, -1]], "o", color=colour, markersize=3.5)
    _highlight(axes, shown.t, shown.values, shown.active())
    name = label(shown.name) if second is None else f"{label(shown.name)}, {label(second.name)}"
    axes.set_ylabel(in_unit(name, shown.unit))
    drawn = shown.values if second is None else np.vstack([shown.values, second.values])
    if shown.kind == "momentum" and single:
        say_if_conserved(axes, drawn)
    else:
        widen_if_flat(axes, drawn)
    _bounds(axes, shown)


def inequality(axes: Axes, shown: Sequence[Inequality]) -> None:
    """Draw an expression over time with its bounds, which are path inequalities; the sides beyond them are forbidden.

    An inequality without a known bound stands alone, and is drawn as its distance from equality.
    """
    first = shown[0]
    single = first.values.shape[1] == 1
    for one in shown:
        for values, colour in zip(one.values.T, body_colours(one.values.shape[1], BLUE), strict=True):
            axes.plot(one.t, values, color=colour, linewidth=1.5 if single else 1.2)
        _highlight(axes, one.t, one.values, one.active())
    if first.bound is None:
        highest = float(np.nanmax(first.distance, initial=0.0))
        axes.axhline(0.0, **_BOUND)
        axes.set_ylabel("distance")
        axes.set_title(relation(first.name), loc="left", fontsize=letter_size(8.5))
        if highest > 0.0:
            axes.set_ylim(-0.12 * max(highest, 1e-3), 1.1 * max(highest, 1e-3))
        axes.axhspan(axes.get_ylim()[0], 0.0, color=FORBIDDEN, linewidth=0.0, zorder=0.5)
        return
    name = label(first.expression) if first.expression.isidentifier() else relation(first.expression, 24)
    axes.set_ylabel(in_unit(name, first.unit))
    # Errors of values that stay at a bound must not fill the axis.
    finite = np.concatenate([one.values[np.isfinite(one.values)] for one in shown])
    low, high = axes.get_ylim()
    if finite.size and np.ptp(finite) < _FLAT * (size := float(np.abs(finite).max()) or 1.0):
        low, high = float(finite.mean()) - 0.25 * size, float(finite.mean()) + 0.25 * size
    margin, least, most = 0.12 * (high - low), low - 0.6 * (high - low), high + 0.6 * (high - low)
    drawn: list[tuple[Inequality, Vector]] = []
    far = []
    for one in shown:
        assert one.bound is not None, "inequalities of one expression have bounds"
        visible = one.bound[(one.bound >= least) & (one.bound <= most)]
        if not visible.size:
            far.append(relation(one.name))
            continue
        if one.is_lower:
            low = min(low, float(visible.min()) - margin)
        else:
            high = max(high, float(visible.max()) + margin)
        drawn.append((one, one.bound))
    axes.set_ylim(low, high)
    for one, bound in drawn:
        edge = low if one.is_lower else high
        if np.ptp(bound) == 0.0:
            level = float(bound[0])
            for span in one.spans or ((float(one.t[0]), float(one.t[-1])),):
                axes.hlines(level, *span, **_BOUND)
                axes.fill_between(span, edge, level, color=FORBIDDEN, linewidth=0.0, zorder=0.5)
        else:
            axes.plot(one.t, bound, **_BOUND)
            axes.fill_between(one.t, edge, np.clip(bound, low, high), color=FORBIDDEN, linewidth=0.0, zorder=0.5)
    lines = [", ".join(relation(one.name) for one, _ in drawn), f"out of view: {', '.join(far)}" if far else ""]
    wrapped = [part for line in lines for part in textwrap.wrap(line, _LETTERS)]
    axes.set_title("\n".join(wrapped), loc="left", fontsize=letter_size(8.5))


def strip(axes: Axes, shown: Sequence[Inequality]) -> None:
    """Draw a row for each path inequality, with marks where it is active for any body."""
    for row, one in enumerate(shown):
        where = one.active().any(axis=1)
        axes.plot(one.t, np.where(where, row, np.nan), **_ACTIVE | {"marker": "|", "markersize": 5.5})
    axes.set_yticks(range(len(shown)), [relation(one.name, 30) for one in shown], fontsize=letter_size(7.5))
    axes.set_ylim(len(shown) - 0.5, -0.5)
    axes.set_title("path inequalities that are active", loc="left", fontsize=letter_size(8.5))


def iterations(axes: Axes, log: Matrix) -> None:
    """Draw residual, stationarity and, if logged, the barrier parameter of every iterate (row of `log`)."""
    numbers = np.arange(len(log))
    columns: list[tuple[str, int, Look]] = [("residual", 1, {"color": BLUE}), ("stationarity", 2, {"color": RED})]
    columns += [("barrier", 5, {"color": GREY, "linestyle": _DOTTED})] if log.shape[1] > 5 else []
    for name, column, look in columns:
        values = np.where((log[:, column] > 0.0) & np.isfinite(log[:, column]), log[:, column], np.nan)
        axes.semilogy(numbers, values, marker=".", markersize=4, label=name, **look)
    axes.set_xlabel("iteration")
    axes.set_ylabel("max-norm")
    axes.xaxis.set_major_locator(MaxNLocator("auto", steps=[1, 2, 2.5, 5, 10], integer=True))
    legend_above(axes, 3, handlelength=1.5)


def legend_above(axes: Axes, columns: int, **look: float) -> None:
    """Put the legend above the panel, away from curves."""
    style: Look = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.97), "columnspacing": 1.0, **look}
    axes.legend(ncols=columns, fontsize=letter_size(8), **style)


def handles(
    quantities: Sequence[Quantity],
    inequalities: Sequence[Inequality],
    outcome: str,
    phases: int = 1,
    inner_times: str = "",
) -> list[Artist]:
    """Return the entries of the figure's legend; `outcome` is the label for the curves of a single body.

    `inner_times` is the label for the times of point constraints, or empty.
    """
    bodies = quantities[0].values.shape[1]
    bounded = any(np.isfinite(q.lower).any() or np.isfinite(q.upper).any() for q in quantities) or bool(inequalities)
    limited: list[Quantity | Inequality] = [*quantities, *inequalities]
    active = "active or violated" if any(one.is_violated() for one in limited) else "active"
    out: list[Artist] = []
    if bodies == 1 and any(q.guess is not None for q in quantities):
        out += [Line2D([], [], label=outcome, color=DARK), Line2D([], [], label="initial guess", **_GUESS)]
    elif 1 < bodies <= 7:
        colours = body_colours(bodies, BLUE)
        out += [Line2D([], [], color=colours[i], label=f"body {i}") for i in range(bodies)]
    if bounded:
        out += [Line2D([], [], label="bound", **_BOUND), Patch(color=FORBIDDEN, label="forbidden")]
    out += [Line2D([], [], label="next phase", **SWITCH)] if phases > 1 else []
    out += [Line2D([], [], label=inner_times, **INNER)] if inner_times else []
    return out + ([Line2D([], [], label=active, **_ACTIVE)] if any(one.active().any() for one in limited) else [])


def _line(axes: Axes, shown: Quantity, values: Vector, style: Look) -> None:
    """Draw lines through the nodes with gaps at jumps, or a step for every interval."""
    if shown.on_intervals:
        axes.stairs(values, shown.t, baseline=None, **style)
        return
    cuts = [node + 1 for node in shown.jumps]
    for t, part in zip(np.split(shown.t, cuts), np.split(values, cuts), strict=True):
        axes.plot(t, part, **style)


def _highlight(axes: Axes, t: Vector, values: Matrix, where: np.ndarray) -> None:
    """Draw a broad line behind the curves (columns of `values`) where the mask `where` is True."""
    for column, active in zip(values.T, where.T, strict=True):
        if not active.any():
            continue
        if column.size == t.size:
            axes.plot(t, np.where(active, column, np.nan), solid_capstyle="butt", **_ACTIVE)
            single = active & ~np.r_[False, active[:-1]] & ~np.r_[active[1:], False]
            axes.plot(t[single], column[single], "o", color=AMBER, alpha=0.75, markersize=5.5, zorder=1.5)
        else:
            axes.hlines(column[active], t[:-1][active], t[1:][active], **_ACTIVE)


def _bounds(axes: Axes, shown: Quantity) -> None:
    """Draw bounds near the curves as dashed lines with a shaded side; list distant bounds above the panel."""
    finite = shown.values[np.isfinite(shown.values)]
    if finite.size == 0:
        return
    low, high = axes.get_ylim()
    reach = 0.6 * (high - low)
    far = []
    for bounds, side, sign in ((shown.lower, -1, "≥"), (shown.upper, 1, "≤")):
        for bound in np.unique(bounds[np.isfinite(bounds)]):
            if low - reach <= bound <= high + reach:
                edge = low if side < 0 else high
                if side * (bound - edge) > -0.04 * (high - low):
                    low, high = (bound - 0.08 * (high - low), high) if side < 0 else (low, bound + 0.08 * (high - low))
                if bounds.ndim == 1:
                    axes.axhline(float(bound), **_BOUND)
                    continue
                # Draw a dashed line where at least one body has this bound.
                where = (_on_intervals(bounds, shown.t) == bound).any(axis=1)
                changes = np.flatnonzero(np.diff(where, prepend=False, append=False))
                level = np.full(changes.size // 2, float(bound))
                axes.hlines(level, shown.t[changes[::2]], shown.t[changes[1::2]], **_BOUND)
            else:
                far.append(f"{sign} {bound:.4g}")
    axes.set_ylim(low, high)
    low, high = axes.get_ylim()
    if shown.lower.ndim > 1:  # shade the region that is forbidden for all bodies
        lower, upper = (_on_intervals(bounds, shown.t) for bounds in (shown.lower, shown.upper))
        for edge, limits in ((low, lower.min(axis=1)), (high, upper.max(axis=1))):
            axes.stairs(np.clip(limits, low, high), shown.t, baseline=edge, fill=True, color=FORBIDDEN, zorder=0.5)
    else:
        least, greatest = float(shown.lower.min()), float(shown.upper.max())
        if low < least < high:
            axes.axhspan(low, least, color=FORBIDDEN, linewidth=0.0, zorder=0.5)
        if low < greatest < high:
            axes.axhspan(greatest, high, color=FORBIDDEN, linewidth=0.0, zorder=0.5)
    if far:
        axes.set_title(f"out of view: {', '.join(far[:2])}", loc="right", fontsize=letter_size(7.5), color=GREY)


def _on_intervals(bounds: Matrix, t: Vector) -> Matrix:
    """Return bounds with a row for each interval; bounds at nodes apply to the interval before the node."""
    return bounds[1:] if len(bounds) == t.size else bounds


def widen_if_flat(axes: Axes, values: np.ndarray) -> bool:
    """Widen the axis of constant values, so that rounding errors do not fill it; return True if constant."""
    finite = values[np.isfinite(values)]
    if finite.size == 0:
        return False
    middle, spread = float(np.mean(finite)), float(np.ptp(finite))
    is_flat = spread <= 1e-9 * max(1.0, abs(middle))
    if is_flat:
        axes.set_ylim(middle - 0.5 * max(1.0, abs(middle)), middle + 0.5 * max(1.0, abs(middle)))
    return is_flat


def say_if_conserved(axes: Axes, momenta: np.ndarray) -> None:
    """Write the accuracy of conservation above the panel if the momentum is conserved."""
    if widen_if_flat(axes, momenta) and np.isfinite(momenta).all():
        axes.set_title(conserved_to(float(np.ptp(momenta))), loc="right")


def conserved_to(spread: float) -> str:
    """Return the accuracy of a conserved quantity in words."""
    return f"conserved to {spread:.0e}" if spread > 0.0 else "conserved exactly"


def lengths(axes: Axes, t: Vector) -> None:
    """Draw the lengths of the intervals of the time grid `t`."""
    axes.step(t, np.append(np.diff(t), t[-1] - t[-2]), where="post", color=DARK, linewidth=1.0)
    axes.set_yscale("log")
    axes.set_ylabel("length of intervals")
