"""The figures of chapter 5 redone: landmarks, cost and time of every route, paths, adaptive codes."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from codegen.evidence.report import landmark_effort, landmark_motion
from codegen.evidence.report.problem_figures import colour_of
from codegen.evidence.report.settings import Settings, few_landmarks
from codegen.evidence.report.store import Store, Values
from codegen.show.figures.picture import AMBER, BLUE, DARK, GREEN, GREY, PINK, RED, SKY, STYLE
from codegen.solving.drivers import DRIVERS

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


def svg(draw: Callable[[], Figure]) -> str:
    """A figure as text that can stand inside a page."""
    with matplotlib.rc_context({**STYLE, "savefig.transparent": True}):
        figure, text = draw(), io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    found = text.getvalue()
    return found[found.index("<svg") :]


def landmarks(settings: Settings) -> Figure:
    """Figure 5.1: where landmarks start and end, and the curved paths from which the iterations start."""
    figure = Figure(figsize=(3.1 * len(settings.counts), 3.2), layout="constrained")
    for axes, count in zip(_row(figure, len(settings.counts)), settings.counts, strict=True):
        points, module = few_landmarks(count), settings.module("explicit-euler")
        case = module.make_case(points.start, points.target, 40)
        states = module.guessed_path(case, 40)
        draw_paths(axes, states[:, 0], f"$n_c = {count}$")
    return figure


def draw_paths(axes: Any, places: Any, title: str) -> None:
    """Paths of points in the unit disc, array of shape (N + 1, n, 2)."""
    places = np.asarray(places, dtype=float)
    axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, color=GREY, linewidth=0.8))
    axes.plot(places[:, :, 0], places[:, :, 1], color=BLUE, linewidth=1.0)
    axes.plot(*places[0].T, "x", color=DARK, markersize=4.5)
    axes.plot(*places[-1].T, "o", color=AMBER, markersize=3.5)
    axes.set(aspect="equal", xlim=(-1.04, 1.04), ylim=(-1.04, 1.04), xticks=[], yticks=[], title=title)
    axes.grid(False)
    for side in axes.spines.values():
        side.set_visible(False)


def routes(settings: Settings, store: Store, scheme: str) -> Figure:
    """Figures 5.2 to 5.4 and 5.8 to 5.10: distance of the cost from the exact one, and seconds, against N."""
    counts = settings.counts
    figure = Figure(figsize=(3.3 * len(counts) + 0.2, 5.6), layout="constrained")
    above = _row(figure, len(counts), 2)
    for column, count in enumerate(counts):
        cost_axes, time_axes = above[column], above[len(counts) + column]
        exact = (store.get(landmark_effort.REFERENCES, f"nc {count}") or {}).get("cost")
        for route in landmark_effort.ROUTES:
            rows = of_route(settings, store, scheme, route.label, count)
            solved = [(n, v) for n, v in rows if v["status"] == "solved"]
            failed = [(n, v) for n, v in rows if v["status"] != "solved"]
            colour, width = COLOURS[route.label], 2.6 if route.label == "stepping, newton" else 1.2
            style = "-" if DRIVERS[route.driver].generated else "--"
            if exact is not None:
                cost_axes.semilogy(
                    [n for n, _ in solved],
                    [abs(v["cost"] - exact) for _, v in solved],
                    style,
                    color=colour,
                    linewidth=width,
                    alpha=0.9,
                )
            time_axes.semilogy(
                [n for n, _ in solved],
                [v["seconds"] for _, v in solved],
                style,
                color=colour,
                linewidth=width,
                label=route.label,
            )
            if failed and not solved:
                time_axes.plot([], [], "x", color=colour, label=route.label)
            time_axes.semilogy(
                [n for n, _ in failed], [v["seconds"] for _, v in failed], "x", color=colour, markersize=4
            )
        cost_axes.set(title=f"$n_c = {count}$")
        time_axes.set(xlabel="steps $N$")
    above[0].set_ylabel("|cost − exact|")
    above[len(counts)].set_ylabel("seconds")
    handles, labels = above[len(counts)].get_legend_handles_labels()
    last = dict(zip(labels, handles, strict=True))  # a route that always failed has a second, empty line
    figure.legend(last.values(), last.keys(), loc="outside lower center", ncols=4)
    return figure


def of_route(settings: Settings, store: Store, scheme: str, route: str, count: int) -> list[tuple[int, Values]]:
    """Numbers of steps and what was measured with them."""
    found = [
        (n, store.get(landmark_effort.ROUTES_SECTION, landmark_effort.case_name(scheme, route, count, n)))
        for n in settings.steps
    ]
    return [(n, values) for n, values in found if values is not None and values["seconds"] is not None]


def route_paths(settings: Settings, store: Store, scheme: str) -> Figure:
    """Figures 5.5 to 5.7 and 5.11 to 5.13: the paths that every route finds."""
    names = [route.label for route in landmark_effort.ROUTES if scheme in route.schemes]
    found = {
        (count, name): (
            store.get(
                landmark_effort.ROUTES_SECTION, landmark_effort.case_name(scheme, name, count, landmark_effort.DRAWN)
            )
            or {}
        )
        for count in settings.counts
        for name in names
    }
    names = [name for name in names if any(found[count, name].get("path") for count in settings.counts)]
    figure = Figure(figsize=(1.6 * max(len(names), 1), 1.75 * len(settings.counts)), layout="constrained")
    if not names:
        return figure
    axes = figure.subplots(len(settings.counts), len(names), squeeze=False)
    for row, count in zip(axes, settings.counts, strict=True):
        for place, name in zip(row, names, strict=True):
            values = found[count, name]
            if values.get("path"):
                draw_paths(place, values["path"], name if count == settings.counts[0] else "")
            else:
                place.axis("off")
                place.text(
                    0.5,
                    0.5,
                    "not measured",
                    ha="center",
                    va="center",
                    fontsize=8,
                    color=GREY,
                    transform=place.transAxes,
                )
        row[0].text(-0.06, 0.5, f"$n_c = {count}$", transform=row[0].transAxes, rotation=90, va="center", ha="right")
    return figure


def best_of_each(settings: Settings, store: Store) -> Figure:
    """Figures 5.14 to 5.16: stepping by explicit Euler, by the midpoint rule, and by an adaptive code."""
    counts = settings.counts
    figure = Figure(figsize=(3.3 * len(counts) + 0.2, 5.2), layout="constrained")
    axes = _row(figure, len(counts), 2)
    for column, count in enumerate(counts):
        above, below = axes[column], axes[len(counts) + column]
        for scheme, colour in (("explicit-euler", BLUE), ("midpoint", GREEN)):
            rows = of_route(settings, store, scheme, "stepping, newton", count)
            above.plot([n for n, _ in rows], [v["cost"] for _, v in rows], color=colour, label=f"{scheme}")
            below.semilogy([n for n, _ in rows], [v["seconds"] for _, v in rows], color=colour)
        row = store.get(landmark_effort.TABLE, f"lsoda 1e-06; nc {count}")
        if row is not None:
            above.axhline(row["cost"], color=RED, linestyle="--", linewidth=1.1, label="lsoda, tolerance $10^{-6}$")
            below.axhline(row["seconds"], color=RED, linestyle="--", linewidth=1.1)
        above.set_title(f"$n_c = {count}$")
        below.set_xlabel("steps $N$")
    axes[0].set_ylabel("cost")
    axes[len(counts)].set_ylabel("seconds")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3)
    return figure


def eulers(settings: Settings, store: Store) -> Figure:
    """The symplectic and implicit Euler methods, whose figures the thesis omits, beside the explicit one."""
    counts = settings.counts
    figure = Figure(figsize=(3.3 * len(counts) + 0.2, 3.1), layout="constrained")
    axes = _row(figure, len(counts))
    for place, count in zip(axes, counts, strict=True):
        exact = (store.get(landmark_effort.REFERENCES, f"nc {count}") or {}).get("cost")
        for scheme, colour in (
            ("explicit-euler", BLUE),
            ("implicit-euler", RED),
            ("symplectic-euler", GREEN),
            ("midpoint", DARK),
        ):
            rows = of_route(settings, store, scheme, "stepping, newton", count)
            if exact is not None:
                errors = [abs(v["cost"] - exact) for _, v in rows]
                place.loglog([n for n, _ in rows], errors, color=colour, label=scheme)
        place.set(
            title=f"$n_c = {count}$",
            xlabel="steps $N$",
            xticks=[10, 20, 50, 100],
            xticklabels=["10", "20", "50", "100"],
        )
        place.xaxis.minorticks_off()
    axes[0].set_ylabel("|cost − exact|")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def tolerance_sweep(store: Store) -> Figure:
    """Figure 5.17: error in cost and seconds against the tolerance of the adaptive codes."""
    exact = (store.get(landmark_effort.REFERENCES, "nc 40") or {})["cost"]
    figure = Figure(figsize=(8.0, 3.1), layout="constrained")
    first, second = _row(figure, 2)
    for code, colour in (("lsoda", RED), ("dop853", BLUE)):
        rows = sorted(
            (v["tolerance"], abs(v["cost"] - exact), v["seconds"], v["status"])
            for name, v in store.rows(landmark_effort.TOLERANCES)
            if name.startswith(code) and v["cost"] is not None
        )
        if rows:
            first.loglog(
                [r[0] for r in rows], [max(r[1], 1e-16) for r in rows], "o-", color=colour, markersize=3, label=code
            )
            second.semilogx([r[0] for r in rows], [r[2] for r in rows], "o-", color=colour, markersize=3)
            bad = [r for r in rows if r[3] != "solved"]
            first.loglog([r[0] for r in bad], [r[1] for r in bad], "kx", markersize=6)
    first.set(xlabel="tolerance", ylabel="|cost − exact|")
    second.set(xlabel="tolerance", ylabel="seconds")
    second.set_ylim(bottom=0.0)
    first.legend(loc="lower right")
    return figure


def forty(store: Store) -> Figure:
    """Figure 5.18: the paths of the forty landmarks, magnified."""
    figure = Figure(figsize=(5.2, 5.0), layout="constrained")
    axes = figure.subplots()
    draw_paths(axes, (store.get(landmark_effort.REFERENCES, "nc 40") or {})["path"], "")
    axes.set(xlim=(-0.75, 0.75), ylim=(-0.75, 0.75))
    return figure


def _row(figure: Figure, columns: int, rows: int = 1) -> Sequence[Any]:
    found: Sequence[Any] = list(np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel())
    return found


def jump_figure(settings: Settings, store: Store) -> Figure:
    """Error of the optimiser's cost against Newton's on the same discrete problem, and its seconds, against N."""
    counts = settings.counts[:2]
    figure = Figure(figsize=(4.6 * len(counts), 5.8), layout="constrained")
    axes = figure.subplots(2, len(counts), squeeze=False)
    for column, count in enumerate(counts):
        for place, path, tolerance in landmark_motion.VARIANTS:
            rows = of_variant(settings, store, place, path, tolerance, count)
            colour = RED if place == "nodes" else BLUE
            style = (
                ("-" if path == "curved" else ":")
                if tolerance == landmark_motion.LOOSE
                else ("--" if path == "curved" else "-.")
            )
            label = f"momenta on {place}, {path}, {tolerance:.0e}"
            at = [n for n, _ in rows]
            errors = [max(v["error"], 1e-16) for _, v in rows]
            axes[0, column].semilogy(at, errors, style, color=colour, linewidth=1.3, label=label)
            axes[1, column].semilogy(at, [v["seconds"] for _, v in rows], style, color=colour, linewidth=1.3)
        axes[0, column].set_title(f"$n_c = {count}$")
        axes[1, column].set_xlabel("steps $N$")
    axes[0, 0].set_ylabel("|cost − minimum|")
    axes[1, 0].set_ylabel("seconds")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def of_variant(
    settings: Settings, store: Store, place: str, path: str, tolerance: float, count: int
) -> list[tuple[int, Values]]:
    """Numbers of steps and what was measured with them."""
    found = [
        (n, store.get(landmark_motion.JUMPS_SECTION, landmark_motion.case_name(place, path, tolerance, count, n)))
        for n in settings.steps
    ]
    return [(n, values) for n, values in found if values is not None and values["error"] is not None]


def work_and_precision(store: Store) -> Figure:
    """Error in cost against seconds on forty landmarks."""
    exact = (store.get(landmark_effort.REFERENCES, "nc 40") or {})["cost"]
    figure = Figure(figsize=(5.6, 3.9), layout="constrained")
    axes = figure.subplots()
    lines: dict[str, list[tuple[float, float]]] = {}
    for name, values in store.rows(landmark_effort.WORK):
        if values["status"] == "solved":
            lines.setdefault(name.split(";")[0], []).append((values["seconds"], abs(values["cost"] - exact)))
    for name, values in store.rows(landmark_effort.TOLERANCES):
        if values["status"] == "solved":
            lines.setdefault(name.split()[0], []).append((values["seconds"], abs(values["cost"] - exact)))
    for scheme, points in lines.items():
        x, y = np.array(sorted(points)).T
        adaptive = scheme in ("lsoda", "dop853")
        style = "x" if adaptive else "o-"
        colour = colour_of(scheme)
        axes.loglog(x, np.maximum(y, 1e-16), style, color=colour, markersize=4.0, linewidth=1.3, label=scheme)
    axes.set(xlabel="seconds of a solve", ylabel="|cost − exact|")
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure


def dimension_figure(store: Store) -> Figure:
    """Seconds of one trajectory and of a whole solve against the number of landmarks."""
    figure = Figure(figsize=(8.2, 3.4), layout="constrained")
    axes = figure.subplots(1, 2)
    lines = by_kernel(store)
    for (name, rows), colour in zip(lines.items(), (AMBER, RED, BLUE, DARK), strict=False):
        for place, key in zip(axes, ("seconds of a trajectory", "seconds"), strict=True):
            place.loglog(
                [n for n, _ in rows], [v[key] for _, v in rows], "o-", color=colour, markersize=3.5, label=name
            )
    axes[0].set(xlabel="landmarks", ylabel="seconds of a trajectory, $N = 10$")
    axes[1].set(xlabel="landmarks", ylabel="seconds of a solve")
    axes[0].legend()
    return figure


def by_kernel(store: Store) -> dict[str, list[tuple[int, Values]]]:
    """Numbers of landmarks and what was measured with them, for every kernel and dimension."""
    found: dict[str, list[tuple[int, Values]]] = {}
    for name, values in store.rows(landmark_effort.DIMENSION_SECTION):
        kernel, _, count = name.partition("; nc ")
        found.setdefault(kernel, []).append((int(count), values))
    return found


def smoothness_figure(store: Store) -> Figure:
    """Error of the warp of the whole disc, and the least and greatest change of area, against N."""
    figure = Figure(figsize=(8.2, 3.4), layout="constrained")
    first, second = figure.subplots(1, 2)
    for amplitude, colour in zip(landmark_motion.AMPLITUDES, (BLUE, GREEN, RED), strict=True):
        rows = warps(store, amplitude)
        if not rows:
            continue
        at, label = [v["steps"] for v in rows], f"displacements × {amplitude:g}"
        first.loglog(at, [v["error"] for v in rows], "o-", color=colour, markersize=3.5, label=label)
        second.semilogx(at, [v["least area"] for v in rows], "o-", color=colour, markersize=3.5, label=label)
        second.axhline(rows[0]["exact least area"], color=colour, linestyle=":", linewidth=1.0)
    second.axhline(0.0, color="black", linewidth=0.8)
    first.set(xlabel="steps $N$", ylabel="largest error of a warped place")
    second.set(xlabel="steps $N$", ylabel="least ratio of areas")
    first.legend()
    return figure


def warps(store: Store, amplitude: float) -> list[dict[str, Any]]:
    """What was measured at an amplitude, with errors against the finest warp, in the order of N; empty without it."""
    found = [
        dict(v)
        for name, v in store.rows(landmark_motion.SMOOTHNESS_SECTION)
        if name.startswith(f"amplitude {amplitude:g};")
    ]
    found = sorted((v for v in found if v["status"] == "solved"), key=lambda v: int(v["steps"]))
    if len(found) < 2:
        return []
    exact = np.array(found[-1]["places"])
    for values in found:
        values["error"] = float(np.abs(np.array(values["places"]) - exact).max())
        values["exact least area"] = found[-1]["least area"]
    return found[:-1]
