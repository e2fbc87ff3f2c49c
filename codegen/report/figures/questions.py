"""Figures of the thesis's open questions: the optimiser's jumps, work and precision, dimension, smoothness."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from codegen.plots.style import AMBER, BLUE, DARK, GREEN, RED
from codegen.report.figures.problems import colour_of
from codegen.report.measure import accuracy, dimension, jumps, smoothness
from codegen.report.settings import Settings
from codegen.report.store import Store, Values


def jump_figure(settings: Settings, store: Store) -> Figure:
    """Error of the optimiser's cost against Newton's on the same discrete problem, and its seconds, against N."""
    counts = settings.counts[:2]
    figure = Figure(figsize=(4.6 * len(counts), 5.8), layout="constrained")
    axes = figure.subplots(2, len(counts), squeeze=False)
    for column, count in enumerate(counts):
        for place, path, tolerance in jumps.VARIANTS:
            rows = of_variant(settings, store, place, path, tolerance, count)
            colour = RED if place == "nodes" else BLUE
            style = (
                ("-" if path == "curved" else ":") if tolerance == jumps.LOOSE else ("--" if path == "curved" else "-.")
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
    found = [(n, store.get(jumps.SECTION, jumps.case_name(place, path, tolerance, count, n))) for n in settings.steps]
    return [(n, values) for n, values in found if values is not None and values["error"] is not None]


def work_and_precision(store: Store) -> Figure:
    """Error in cost against seconds on forty landmarks."""
    exact = (store.get(accuracy.REFERENCES, "nc 40") or {})["cost"]
    figure = Figure(figsize=(5.6, 3.9), layout="constrained")
    axes = figure.subplots()
    lines: dict[str, list[tuple[float, float]]] = {}
    for name, values in store.rows(accuracy.WORK):
        if values["status"] == "solved":
            lines.setdefault(name.split(";")[0], []).append((values["seconds"], abs(values["cost"] - exact)))
    for name, values in store.rows(accuracy.TOLERANCES):
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
    for name, values in store.rows(dimension.SECTION):
        kernel, _, count = name.partition("; nc ")
        found.setdefault(kernel, []).append((int(count), values))
    return found


def smoothness_figure(store: Store) -> Figure:
    """Error of the warp of the whole disc, and the least and greatest change of area, against N."""
    figure = Figure(figsize=(8.2, 3.4), layout="constrained")
    first, second = figure.subplots(1, 2)
    for amplitude, colour in zip(smoothness.AMPLITUDES, (BLUE, GREEN, RED), strict=True):
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
    found = [dict(v) for name, v in store.rows(smoothness.SECTION) if name.startswith(f"amplitude {amplitude:g};")]
    found = sorted((v for v in found if v["status"] == "solved"), key=lambda v: int(v["steps"]))
    if len(found) < 2:
        return []
    exact = np.array(found[-1]["places"])
    for values in found:
        values["error"] = float(np.abs(np.array(values["places"]) - exact).max())
        values["exact least area"] = found[-1]["least area"]
    return found[:-1]
