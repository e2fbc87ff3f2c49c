"""The figures of the study of landmark registration, and the selections of measured values that they show.

The first part repeats the figures of chapter 5 of the thesis: landmarks, cost and time of every route, paths, adaptive
codes. The second part belongs to the open questions of chapter 6.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from codegen.evidence.report import landmark_cases
from codegen.evidence.report.page import colour_of
from codegen.evidence.report.store import Settings, Store, Values, few_landmarks
from codegen.show.figures.picture import AMBER, BLUE, DARK, GREEN, GREY, PINK, RED, SKY
from codegen.solving.drivers import DRIVERS
from codegen.solving.loading import Vector

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = {
    "stepping, newton": BLUE,
    "stepping, fsolve": SKY,
    "stepping, fmin": AMBER,
    "full, newton": GREEN,
    "full, fsolve": PINK,
    "action, newton": DARK,
    "action, trust-constr": "#7A5230",
    "action, slsqp": RED,
}
STEPPING = "stepping, newton"
"""The label of the stepping route, which solves for the initial momenta by the generated Newton's method."""

Rows = list[tuple[int, Values]]  # numbers of steps or of landmarks, each with the measured values


def reference_cost(store: Store, count: int) -> float | None:
    """Return the cost of the reference for a set of landmarks, or None if it was not measured."""
    return (store.get(landmark_cases.REFERENCES, f"nc {count}") or {}).get("cost")


def by_route(settings: Settings, store: Store, scheme: str, route: str, count: int) -> Rows:
    """Return the solves of a scheme by a route for `count` landmarks."""
    names = ((n, landmark_cases.case_name(scheme, route, count, n)) for n in settings.steps)
    rows = ((n, store.get(landmark_cases.ROUTES_SECTION, name)) for n, name in names)
    return [(n, values) for n, values in rows if values is not None and values["seconds"] is not None]


def _panels(counts: Sequence[int], size: tuple[float, float], *labels: str) -> tuple[Figure, NDArray[np.object_]]:
    """Return a figure and its axes against N: a row for each label, a column for each number of landmarks."""
    figure = Figure(figsize=size, layout="constrained")
    rows = figure.subplots(len(labels), len(counts), squeeze=False)
    for row, label in zip(rows, labels, strict=True):
        row[0].set_ylabel(label)
    for axes, count in zip(rows[0], counts, strict=True):
        axes.set_title(f"$n_c = {count}$")
    for axes in rows[-1]:
        axes.set_xlabel("steps $N$")
    return figure, rows


def _columns(figure: Figure) -> int:
    """Return the number of columns of a legend that is not wider than the figure."""
    return min(4, max(1, int(figure.get_figwidth() / 1.7)))


# ---- Chapter 5 ----


def landmarks(settings: Settings) -> Figure:
    """Draw Figure 5.1: initial and final landmarks, and the curved paths of the initial guess."""
    figure = Figure(figsize=(3.1 * len(settings.counts), 3.2), layout="constrained")
    panels = figure.subplots(1, len(settings.counts), squeeze=False)[0]
    for axes, count in zip(panels, settings.counts, strict=True):
        points, module = few_landmarks(count), settings.module("explicit-euler")
        case = module.make_case(points.start, points.target, 40)
        _draw_paths(axes, module.guessed_path(case, 40)[:, 0], f"$n_c = {count}$")
    return figure


def _draw_paths(axes: Axes, path: Vector | Sequence[object], title: str) -> None:
    """Draw paths of points in the unit disc; `path` has shape (N + 1, n, 2)."""
    path = np.asarray(path, dtype=float)
    axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, color=GREY, linewidth=0.8))
    axes.plot(path[:, :, 0], path[:, :, 1], color=BLUE, linewidth=1.0)
    axes.plot(*path[0].T, "x", color=DARK, markersize=4.5)
    axes.plot(*path[-1].T, "o", color=AMBER, markersize=3.5)
    axes.set(aspect="equal", xlim=(-1.04, 1.04), ylim=(-1.04, 1.04), xticks=[], yticks=[], title=title)
    axes.grid(False)
    for side in axes.spines.values():
        side.set_visible(False)


def routes(settings: Settings, store: Store, scheme: str) -> Figure:
    """Draw Figures 5.2 to 5.4 or 5.8 to 5.10: error of the cost, and seconds, against N for every route."""
    counts = settings.counts
    figure, (above, below) = _panels(counts, (3.3 * len(counts) + 0.2, 5.6), "|cost − exact|", "seconds")
    for cost_axes, time_axes, count in zip(above, below, counts, strict=True):
        exact = reference_cost(store, count)
        for route in landmark_cases.ROUTES:
            rows = by_route(settings, store, scheme, route.label, count)
            solved = [(n, v) for n, v in rows if v["status"] == "solved"]
            failed = [(n, v) for n, v in rows if v["status"] != "solved"]
            colour, width = COLOURS[route.label], 2.6 if route.label == STEPPING else 1.2
            look = {"linestyle": "-" if DRIVERS[route.driver].generated else "--", "color": colour, "linewidth": width}
            steps = [n for n, _ in solved]
            if exact is not None:
                cost_axes.semilogy(steps, [abs(v["cost"] - exact) for _, v in solved], alpha=0.9, **look)
            time_axes.semilogy(steps, [v["seconds"] for _, v in solved], label=route.label, **look)
            if failed and not solved:
                time_axes.plot([], [], "x", color=colour, label=route.label)
            steps, times = [n for n, _ in failed], [v["seconds"] for _, v in failed]
            time_axes.semilogy(steps, times, "x", color=colour, markersize=4)
    handles, labels = below[0].get_legend_handles_labels()
    last = dict(zip(labels, handles, strict=True))  # a route that always failed has a second, empty line
    figure.legend(last.values(), last.keys(), loc="outside lower center", ncols=_columns(figure))
    return figure


def route_paths(settings: Settings, store: Store, scheme: str) -> Figure:
    """Draw Figures 5.5 to 5.7 or 5.11 to 5.13: the paths by every route."""
    counts, paths = settings.counts, {}
    for route in landmark_cases.routes_of(scheme):
        for count in counts:
            name = landmark_cases.case_name(scheme, route.label, count, landmark_cases.DRAWN)
            paths[count, route.label] = (store.get(landmark_cases.ROUTES_SECTION, name) or {}).get("path")
    names = list(dict.fromkeys(name for (_, name), path in paths.items() if path))
    figure = Figure(figsize=(1.6 * max(len(names), 1), 1.75 * len(counts)), layout="constrained")
    if not names:
        return figure
    rows = figure.subplots(len(counts), len(names), squeeze=False)
    for row, count in zip(rows, counts, strict=True):
        for axes, name in zip(row, names, strict=True):
            if path := paths[count, name]:
                _draw_paths(axes, path, name if count == counts[0] else "")
            else:
                axes.axis("off")
                axes.text(0.5, 0.5, "not measured", ha="center", va="center", fontsize=8, color=GREY,
                          transform=axes.transAxes)  # fmt: skip
        row[0].text(-0.06, 0.5, f"$n_c = {count}$", transform=row[0].transAxes, rotation=90, va="center", ha="right")
    return figure


def best_of_each(settings: Settings, store: Store) -> Figure:
    """Draw Figures 5.14 to 5.16: stepping by explicit Euler, by the midpoint rule, and by an adaptive code."""
    counts = settings.counts
    figure, (above, below) = _panels(counts, (3.3 * len(counts) + 0.2, 5.2), "cost", "seconds")
    for cost_axes, time_axes, count in zip(above, below, counts, strict=True):
        for scheme, colour in (("explicit-euler", BLUE), ("midpoint", GREEN)):
            rows = by_route(settings, store, scheme, STEPPING, count)
            cost_axes.plot([n for n, _ in rows], [v["cost"] for _, v in rows], color=colour, label=scheme)
            time_axes.semilogy([n for n, _ in rows], [v["seconds"] for _, v in rows], color=colour)
        row = store.get(landmark_cases.TABLE, f"lsoda 1e-06; nc {count}")
        if row is not None:
            look = {"color": RED, "linestyle": "--", "linewidth": 1.1}
            cost_axes.axhline(row["cost"], label="lsoda, tolerance $10^{-6}$", **look)
            time_axes.axhline(row["seconds"], **look)
    figure.legend(*above[0].get_legend_handles_labels(), loc="outside lower center", ncols=_columns(figure))
    return figure


def eulers(settings: Settings, store: Store) -> Figure:
    """Draw the cost errors of the Euler methods, of which the thesis shows one, and of the midpoint rule."""
    counts = settings.counts
    figure, (panels,) = _panels(counts, (3.3 * len(counts) + 0.2, 3.1), "|cost − exact|")
    colours = {"explicit-euler": BLUE, "implicit-euler": RED, "symplectic-euler": GREEN, "midpoint": DARK}
    for axes, count in zip(panels, counts, strict=True):
        exact = reference_cost(store, count)
        for scheme, colour in colours.items():
            rows = by_route(settings, store, scheme, STEPPING, count)
            if exact is not None:
                errors = [abs(v["cost"] - exact) for _, v in rows]
                axes.loglog([n for n, _ in rows], errors, color=colour, label=scheme)
        ticks = [10, 20, 50, 100]
        axes.set(xticks=ticks, xticklabels=[str(n) for n in ticks])
        axes.xaxis.minorticks_off()
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=_columns(figure))
    return figure


def tolerance_sweep(store: Store) -> Figure:
    """Draw Figure 5.17: error in cost and seconds against the tolerance of the adaptive codes."""
    exact = reference_cost(store, 40)
    figure = Figure(figsize=(8.0, 3.1), layout="constrained")
    first, second = figure.subplots(1, 2)
    for code, colour in (("lsoda", RED), ("dop853", BLUE)):
        rows = sorted(
            (v["tolerance"], abs(v["cost"] - exact), v["seconds"], v["status"])
            for name, v in store.rows(landmark_cases.TOLERANCES)
            if name.startswith(code) and v["cost"] is not None
        )
        if rows:
            tolerances, look = [r[0] for r in rows], {"color": colour, "markersize": 3}
            first.loglog(tolerances, [max(r[1], 1e-16) for r in rows], "o-", label=code, **look)
            second.semilogx(tolerances, [r[2] for r in rows], "o-", **look)
            failed = [r for r in rows if r[3] != "solved"]
            first.loglog([r[0] for r in failed], [r[1] for r in failed], "kx", markersize=6)
    first.set(xlabel="tolerance", ylabel="|cost − exact|")
    second.set(xlabel="tolerance", ylabel="seconds")
    second.set_ylim(bottom=0.0)
    first.legend(loc="lower right")
    return figure


def forty(store: Store) -> Figure:
    """Draw Figure 5.18: the paths of the forty landmarks, magnified."""
    figure = Figure(figsize=(5.2, 5.0), layout="constrained")
    axes = figure.subplots()
    _draw_paths(axes, (store.get(landmark_cases.REFERENCES, "nc 40") or {})["path"], "")
    axes.set(xlim=(-0.75, 0.75), ylim=(-0.75, 0.75))
    return figure


# ---- Open questions ----


def jump_figure(settings: Settings, store: Store) -> Figure:
    """Draw the difference between the costs of SLSQP and of Newton's method, and the seconds of SLSQP, against N."""
    counts = settings.counts[:2]
    figure, (above, below) = _panels(counts, (4.6 * len(counts), 5.8), "|cost − minimum|", "seconds")
    styles = {
        ("curved", landmark_cases.LOOSE): "-", ("straight", landmark_cases.LOOSE): ":",
        ("curved", landmark_cases.TIGHT): "--", ("straight", landmark_cases.TIGHT): "-.",
    }  # fmt: skip
    for error_axes, time_axes, count in zip(above, below, counts, strict=True):
        for variant in landmark_cases.VARIANTS:
            rows = by_variant(settings, store, variant, count)
            look = {
                "linestyle": styles[variant.path, variant.tolerance], "linewidth": 1.3,
                "color": RED if variant.momenta == "nodes" else BLUE,
            }  # fmt: skip
            label = f"momenta on {variant.momenta}, {variant.path}, {variant.tolerance:.0e}"
            steps = [n for n, _ in rows]
            error_axes.semilogy(steps, [max(v["error"], 1e-16) for _, v in rows], label=label, **look)
            time_axes.semilogy(steps, [v["seconds"] for _, v in rows], **look)
    figure.legend(*above[0].get_legend_handles_labels(), loc="outside lower center", ncols=_columns(figure))
    return figure


def by_variant(settings: Settings, store: Store, variant: landmark_cases.Minimisation, count: int) -> Rows:
    """Return the minimisations of a variant for `count` landmarks."""
    rows = ((n, store.get(landmark_cases.JUMPS_SECTION, variant.case(count, n))) for n in settings.steps)
    return [(n, values) for n, values in rows if values is not None and values["error"] is not None]


def work_and_precision(store: Store) -> Figure:
    """Draw the error in cost against seconds for forty landmarks."""
    exact = reference_cost(store, 40)
    figure = Figure(figsize=(5.6, 3.9), layout="constrained")
    axes = figure.subplots()
    lines: dict[str, list[tuple[float, float]]] = {}
    for section, separator in ((landmark_cases.WORK, ";"), (landmark_cases.TOLERANCES, " ")):
        for name, values in store.rows(section):
            if values["status"] == "solved":
                point = values["seconds"], abs(values["cost"] - exact)
                lines.setdefault(name.split(separator)[0], []).append(point)
    for scheme, points in lines.items():
        x, y = np.array(sorted(points)).T
        style = "x" if scheme in landmark_cases.ADAPTIVE else "o-"
        colour = colour_of(scheme)
        axes.loglog(x, np.maximum(y, 1e-16), style, color=colour, markersize=4.0, linewidth=1.3, label=scheme)
    axes.set(xlabel="seconds of a solve", ylabel="|cost − exact|")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def dimension_figure(store: Store) -> Figure:
    """Draw the seconds of a trajectory and of a solve against the number of landmarks."""
    figure = Figure(figsize=(8.2, 3.4), layout="constrained")
    panels = figure.subplots(1, 2)
    for (name, rows), colour in zip(by_kernel(store).items(), (AMBER, RED, BLUE, DARK), strict=False):
        for axes, key in zip(panels, ("seconds of a trajectory", "seconds"), strict=True):
            counts, times = [n for n, _ in rows], [v[key] for _, v in rows]
            axes.loglog(counts, times, "o-", color=colour, markersize=3.5, label=name)
    panels[0].set(xlabel="landmarks", ylabel="seconds of a trajectory, $N = 10$")
    panels[1].set(xlabel="landmarks", ylabel="seconds of a solve")
    panels[0].legend()
    return figure


def by_kernel(store: Store) -> dict[str, Rows]:
    """Return the numbers of landmarks with their measured values, for every kernel and dimension."""
    lines: dict[str, Rows] = {}
    for name, values in store.rows(landmark_cases.DIMENSION_SECTION):
        kernel, _, count = name.partition("; nc ")
        lines.setdefault(kernel, []).append((int(count), values))
    return lines


def smoothness_figure(store: Store) -> Figure:
    """Draw the error of the warped grid, and the least ratio of areas, against N."""
    figure = Figure(figsize=(8.2, 3.4), layout="constrained")
    first, second = figure.subplots(1, 2)
    for amplitude, colour in zip(landmark_cases.AMPLITUDES, (BLUE, GREEN, RED), strict=True):
        rows = warps(store, amplitude)
        if not rows:
            continue
        steps, look = [v["steps"] for v in rows], {"color": colour, "markersize": 3.5}
        label = f"displacements × {amplitude:g}"
        first.loglog(steps, [v["error"] for v in rows], "o-", label=label, **look)
        second.semilogx(steps, [v["least area"] for v in rows], "o-", label=label, **look)
        second.axhline(rows[0]["exact least area"], color=colour, linestyle=":", linewidth=1.0)
    second.axhline(0.0, color="black", linewidth=0.8)
    first.set(xlabel="steps $N$", ylabel="largest error of a warped place")
    second.set(xlabel="steps $N$", ylabel="least ratio of areas")
    first.legend()
    return figure


def warps(store: Store, amplitude: float) -> list[Values]:
    """Return the warps of an amplitude by increasing N, with errors against the finest; empty for only one warp."""
    prefix = f"amplitude {amplitude:g};"
    rows = [v for name, v in store.rows(landmark_cases.SMOOTHNESS_SECTION) if name.startswith(prefix)]
    rows = sorted((v for v in rows if v["status"] == "solved"), key=lambda v: int(v["steps"]))
    if len(rows) < 2:
        return []
    *rows, finest = rows
    errors = [float(np.abs(np.array(v["places"]) - np.array(finest["places"])).max()) for v in rows]
    least = finest["least area"]
    return [{**v, "error": error, "exact least area": least} for v, error in zip(rows, errors, strict=True)]
