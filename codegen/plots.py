"""Pictures of a result: trajectories, controls and orbits, phase portraits and energy errors."""

from __future__ import annotations

import re
import textwrap
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from codegen.drivers.result import Result
from codegen.load import Matrix, Vector

BLUE, ORANGE, GREEN, PURPLE, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#666666"
"""Colours that remain distinct for colour-blind readers: Okabe and Ito (2008), Color universal design."""

_STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.labelsize": 11,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.formatter.use_mathtext": True,
    "axes.formatter.limits": (-3, 4),
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "svg.hashsalt": "codegen",
}
_MOST_PANELS = 6
_MOST_POINTS = 20_000
_GREEK = set(
    "alpha beta gamma delta epsilon zeta eta theta iota kappa mu nu xi pi rho sigma tau phi chi psi omega".split()
)


def save(result: Result, path: Path) -> None:
    """Draw a result into a file whose ending matplotlib knows."""
    with matplotlib.rc_context(_STYLE):
        figure = control_figure(result) if result.task == "control" else simulation_figure(result)
        metadata = {"Date": None} if path.suffix.lower() == ".svg" else None
        figure.savefig(path, dpi=150, metadata=metadata)


def control_figure(result: Result) -> Figure:
    """Coordinates, momenta and controls over time, and the orbit when the coordinates are polar."""
    assert result.u is not None, "a control problem has controls"
    shown = min(len(result.names["q"]), _MOST_PANELS)
    controls = min(len(result.names["u"]), _MOST_PANELS)
    is_orbit = result.names["q"] == ("r", "phi")
    rows: list[Any] = [[f"q{i}", f"p{i}"] for i in range(shown)] + [[f"u{j}"] * 2 for j in range(controls)]
    if is_orbit:
        rows = [["orbit", *row] for row in rows]
    figure = Figure(figsize=(12.0 if is_orbit else 8.5, 0.9 + 1.9 * len(rows)), layout="constrained")
    panels = figure.subplot_mosaic(
        rows,
        width_ratios=[1.35, 1, 1] if is_orbit else [1, 1],
        per_subplot_kw={"orbit": {"projection": "polar"}} if is_orbit else {},
    )
    for i in range(shown):
        _curve(panels[f"q{i}"], result.t, result.q[:, i], result.names["q"][i], BLUE)
        _curve(panels[f"p{i}"], result.t, result.p[:, i], result.names["p"][i], GREEN)
    for j in range(controls):
        _control(panels[f"u{j}"], result.t, result.u[:, j], result.names["u"][j])
        if j == controls - 1:
            panels[f"u{j}"].set_xlabel("time")
    if is_orbit:
        _orbit(panels["orbit"], result.q)
    cost = f", cost {result.cost:.6g}" if result.cost is not None else ""
    _title(figure, result, cost)
    return figure


def simulation_figure(result: Result) -> Figure:
    """Phase portrait of every coordinate, and the error of the energy over time."""
    assert result.energy is not None, "a simulation has energies"
    shown = min(len(result.names["q"]), _MOST_PANELS)
    columns = min(shown, 3)
    rows: list[Any] = [[f"phase{i}" for i in range(first, first + columns)] for first in range(0, shown, columns)]
    rows = [[name if int(name[5:]) < shown else "." for name in row] for row in rows]
    figure = Figure(figsize=(max(6.5, 4.0 * columns), 1.2 + 3.4 * len(rows) + 2.1), layout="constrained")
    panels = figure.subplot_mosaic([*rows, ["energy"] * columns], height_ratios=[3.4] * len(rows) + [2.0])
    stride = max(1, -(-result.t.size // _MOST_POINTS))
    for i in range(shown):
        _phase_portrait(panels[f"phase{i}"], result, i, stride)
    axes = panels["energy"]
    axes.plot(result.t[::stride], (result.energy - result.energy[0])[::stride], color=ORANGE, linewidth=1.2)
    axes.set_xlabel("time")
    axes.set_ylabel("change of energy")
    axes.margins(x=0)
    _title(figure, result, "")
    return figure


def label(name: str) -> str:
    """A symbol's name as mathematics: phi1 becomes a Greek letter with an index."""
    parts = re.sub(r"(?<=[A-Za-z])(\d+)$", r"_\1", name).split("_")
    letters = [_letter(part) for part in parts]
    return "$" + letters[0] + ("_{" + ",".join(letters[1:]) + "}" if len(letters) > 1 else "") + "$"


def _letter(name: str) -> str:
    if name.lower() in _GREEK:
        return rf"\{name}"
    return name if len(name) == 1 else rf"\mathrm{{{name}}}"


def _curve(axes: Any, t: Vector, values: Vector, name: str, colour: str) -> None:
    axes.plot(t, values, color=colour)
    axes.plot(t[[0, -1]], values[[0, -1]], "o", color=colour, markersize=4)
    axes.set_ylabel(label(name))
    axes.margins(x=0.02)
    _widen_if_flat(axes, values)


def _control(axes: Any, t: Vector, values: Vector, name: str) -> None:
    """A step for every interval, or a polygon through the nodes."""
    if values.size == t.size:
        axes.plot(t, values, color=ORANGE)
    else:
        axes.stairs(values, t, baseline=None, color=ORANGE, linewidth=1.6)
    axes.axhline(0.0, color=GREY, linewidth=0.6)
    axes.set_ylabel(label(name))
    axes.margins(x=0.01)


def _orbit(axes: Any, q: Matrix) -> None:
    angles = np.linspace(0.0, 2.0 * np.pi, 200)
    axes.plot(
        angles, np.full_like(angles, q[0, 0]), color=GREY, linestyle=(0, (1, 2)), label=f"start, $r$ = {q[0, 0]:g}"
    )
    axes.plot(
        angles, np.full_like(angles, q[-1, 0]), color=GREY, linestyle=(0, (5, 3)), label=f"end, $r$ = {q[-1, 0]:g}"
    )
    # Straight lines between nodes would cut the corner: the angle is interpolated, as it is in the coordinates.
    fine = np.linspace(0, q.shape[0] - 1, max(q.shape[0], 400))
    nodes = np.arange(q.shape[0])
    axes.plot(np.interp(fine, nodes, q[:, 1]), np.interp(fine, nodes, q[:, 0]), color=BLUE, label="transfer")
    axes.plot(q[0, 1], q[0, 0], "o", color=BLUE)
    axes.plot(q[-1, 1], q[-1, 0], "s", color=BLUE)
    axes.set_ylim(0.0, 1.08 * float(np.max(q[:, 0])))
    axes.set_xticklabels([])
    axes.set_yticks([])
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, 0.0), ncols=3)


def _phase_portrait(axes: Any, result: Result, i: int, stride: int) -> None:
    q, p = result.q[::stride, i], result.p[::stride, i]
    few = q.size <= 2000
    axes.plot(q, p, color=BLUE, linewidth=0.8 if few else 0.5, alpha=0.6)
    if few:
        axes.plot(q, p, ".", color=BLUE, markersize=3)
    axes.plot(q[0], p[0], "o", color=ORANGE, markersize=6, label="start")
    axes.set_xlabel(label(result.names["q"][i]))
    axes.set_ylabel(label(result.names["p"][i]))
    axes.legend(loc="upper right", handletextpad=0.2)


def _widen_if_flat(axes: Any, values: Vector) -> None:
    """Do not blow rounding errors of a constant up to the height of the panel."""
    middle, spread = float(np.mean(values)), float(np.ptp(values))
    if spread <= 1e-9 * max(1.0, abs(middle)):
        axes.set_ylim(middle - 0.5 * max(1.0, abs(middle)), middle + 0.5 * max(1.0, abs(middle)))


def _title(figure: Figure, result: Result, cost: str) -> None:
    lines = textwrap.wrap(result.title.rstrip("."), 90)
    status = "" if result.solved else f"; NOT SOLVED: {result.status}"
    subtitle = f"{result.method}, {result.scheme}, {result.steps} steps{cost}{status}"
    figure.suptitle("\n".join([*lines, subtitle]), fontsize=11)
