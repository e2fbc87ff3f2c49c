"""Figures 3.3 to 3.9 of the thesis: the orbital transfer by midpoint and Euler, checked by a Runge-Kutta code.

The method R-K interpolates the optimal force of the midpoint rule by a cubic spline and integrates the forced equations
with it; where that motion ends, it should meet the target orbit. Its miss distance is an error that no part of the
generated code had a hand in.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from codegen.interfaces import ControlModule, is_control
from codegen.plots.style import BLUE, DARK, GREY, RED
from codegen.report.building import Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.figures.landmarks import svg
from codegen.report.measure.orders import measured_order, order_text
from codegen.report.section import Picture, Section, Table, number, seconds
from codegen.report.store import Case, Store, Values

SECTION = "orbital_transfer: figures 3.3 to 3.9"
METHODS = (("Mid.", "variational", "midpoint", 2, BLUE), ("Euler", "hamiltonian", "explicit-euler", 1, RED))
SWEEPS = {1: tuple(range(10, 51, 5)), 2: tuple(range(10, 101, 10))}
FORCES = {1: (50, 100, 150), 2: (100, 200, 300)}
"""Numbers of steps by revolutions: of Figures 3.3 and 3.4, and of Figures 3.7 to 3.9."""
TOLERANCE = 1e-11


def variants(problem: Path) -> list[Variant]:
    """The modules of both discretisations."""
    return [Variant(problem, method, scheme, order) for _, method, scheme, order, _ in METHODS]


def cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Both methods for one and two revolutions; the motions of the largest N are kept."""
    for variant, (label, *_) in zip(variants(problem), METHODS, strict=True):
        for revolutions, sweep in SWEEPS.items():
            wanted = sorted({*(sweep[::3] if extent.quick else sweep), *FORCES[revolutions]})
            for steps in wanted:
                yield Case(
                    SECTION,
                    _name(label, revolutions, steps),
                    lambda v=variant, p=revolutions, n=steps: _transfer(workshop, v, p, n, extent.repeat),  # type: ignore[misc]
                )


def _name(label: str, revolutions: int, steps: int) -> str:
    return f"{label}; {revolutions} revolutions; N {steps}"


def _transfer(workshop: Workshop, variant: Variant, revolutions: int, steps: int, repeat: int) -> Values:
    """A solution, its time, and where the motion under its splined force ends."""
    module = workshop.module(variant)
    assert is_control(module)
    best = math.inf
    for _ in range(3 * repeat + 1):
        begin = time.perf_counter()
        solution = module.solve(steps, revolutions=float(revolutions))
        best = min(best, time.perf_counter() - begin)
    found: dict[str, Any] = {
        "status": solution.status, "cost": solution.cost, "seconds": best, "steps": steps,
        "iterations": solution.iterations, "residual": solution.residual,
    }  # fmt: skip
    if variant.scheme == "midpoint":
        found |= _reintegrated(module, solution, revolutions)
    if steps in FORCES[revolutions]:
        found |= {"r": solution.q[:, 0], "phi": solution.q[:, 1], "t": solution.t, "u": solution.u[:, 0]}
    return found


def _reintegrated(module: ControlModule, solution: Any, revolutions: int) -> Values:
    """R-K: m (r'' - r phi'^2) = -GM m/r^2 and (m r^2 phi')' = r u, written for r, phi and their velocities."""
    values = module.metadata.parameters
    m, gravity, r0, r1 = (values[name] for name in ("m", "GM", "r0", "r1"))
    t = solution.t
    force = CubicSpline(0.5 * (t[1:] + t[:-1]), solution.u[:, 0])

    def field(at: float, z: Any) -> list[float]:
        r, _, y, w = z
        return [y, w, r * w * w - gravity / r**2, (float(force(at)) / m - 2.0 * y * w) / r]

    start = [r0, 0.0, 0.0, math.sqrt(gravity / r0**3)]
    done = solve_ivp(field, (t[0], t[-1]), start, "DOP853", rtol=TOLERANCE, atol=TOLERANCE,
                     t_eval=np.linspace(t[0], t[-1], 201))  # fmt: skip
    r, phi, y, w = done.y[:, -1]
    angle = 2.0 * math.pi * revolutions
    place = math.hypot(r * math.cos(phi) - r1 * math.cos(angle), r * math.sin(phi) - r1 * math.sin(angle))
    velocity = math.hypot(y, r * w - r1 * math.sqrt(gravity / r1**3))
    return {"miss": place, "velocity miss": velocity, "R-K r": done.y[0], "R-K phi": done.y[1]}


def _sweep(store: Store, label: str, revolutions: int) -> list[Values]:
    names = (_name(label, revolutions, n) for n in SWEEPS[revolutions])
    return [values for name in names if (values := store.get(SECTION, name)) is not None]


def sections(store: Store, problem: Path) -> list[Section]:
    """Costs, times, orbits, forces and the miss of R-K."""
    del problem
    if not _sweep(store, "Mid.", 1):
        return []
    text = (
        "R-K interpolates the optimal force of Mid. by a cubic spline (controls of an interval stand at its middle) "
        "and integrates the forced equations of section 3.3, written out here by hand, by DOP853 at tolerance "
        f"{TOLERANCE:g}: where it ends should be the target, the more so the larger N. The thesis's forces "
        "alternate from step to step, since its controls stand on nodes; here they stand on intervals."
    )
    pictures = (
        Picture("Costs, times and miss of R-K (Figures 3.3 and 3.4; the miss is not in the thesis).",
                svg(lambda: costs(store))),
        Picture("Orbits of the three methods (Figures 3.5 and 3.6); grey: first and last orbit.",
                svg(lambda: orbits(store))),
        Picture("Optimal forces (Figures 3.7 to 3.9).", svg(lambda: forces(store))),
    )  # fmt: skip
    return [Section("Orbital transfer: Figures 3.3 to 3.9", (text,), (_table(store),), pictures)]


def _table(store: Store) -> Table:
    rows = []
    for revolutions in SWEEPS:
        for label, *_ in METHODS:
            values = _sweep(store, label, revolutions)
            last = values[-1]
            missed = [v.get("miss") for v in values]
            rows.append((
                label, str(revolutions), str(last["steps"]), f"{last['cost']:.8g}", seconds(last["seconds"]),
                str(last["iterations"]), number(last.get("miss")), number(last.get("velocity miss")),
                order_text(measured_order([v["steps"] for v in values], missed), 2),
                str(sum(v["status"] != "solved" for v in values)),
            ))  # fmt: skip
    head = ("method", "revolutions", "N", "cost", "time", "iterations", "miss of R-K", "its velocity miss",
            "order of the miss", "failed")  # fmt: skip
    return Table("The largest N of each sweep.", head, tuple(rows))


def costs(store: Store) -> Figure:
    """A row for each number of revolutions."""
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    axes = figure.subplots(2, 3)
    for row, revolutions in zip(axes, SWEEPS, strict=True):
        for label, *_, colour in METHODS:
            values = [v for v in _sweep(store, label, revolutions) if v["status"] == "solved"]
            steps = [v["steps"] for v in values]
            row[0].plot(steps, [v["cost"] for v in values], "o-", markersize=3, color=colour, label=label)
            row[1].plot(steps, [1e3 * v["seconds"] for v in values], "o-", markersize=3, color=colour)
            if label == "Mid.":
                row[2].loglog(steps, [v["miss"] for v in values], "o-", markersize=3, color=DARK, label="place")
                row[2].loglog(steps, [v["velocity miss"] for v in values], "o--", markersize=3, color=GREY,
                              label="velocity")  # fmt: skip
        ticks = [n for n in (10, 20, 50, 100) if n <= SWEEPS[revolutions][-1]]
        row[2].set(xticks=ticks, xticklabels=[str(n) for n in ticks])
        row[2].minorticks_off()
        plural = "s" if revolutions > 1 else ""
        row[0].set_ylabel(f"{revolutions} revolution{plural}\ncost")
        row[1].set_ylabel("time [ms]")
        row[1].set_ylim(bottom=0.0)
        row[2].set_ylabel("miss of R-K")
    for place in axes[1]:
        place.set_xlabel("steps $N$")
    axes[0][0].legend()
    axes[0][2].legend()
    return figure


def orbits(store: Store) -> Figure:
    """Polar plots of the smallest N of the force figures."""
    figure = Figure(figsize=(8.6, 4.2), layout="constrained")
    for place, (revolutions, steps) in enumerate((p, FORCES[p][0]) for p in SWEEPS):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="polar")
        angles = np.linspace(0.0, 2.0 * np.pi, 200)
        for label, *_, colour in METHODS:
            values = store.get(SECTION, _name(label, revolutions, steps))
            if values is None:
                continue
            axes.plot(values["phi"], values["r"], color=colour, label=label)
            for radius in (values["r"][0], values["r"][-1]):
                axes.plot(angles, np.full(200, radius), color=GREY, linewidth=0.6)
            if "R-K r" in values:
                axes.plot(
                    values["R-K phi"], values["R-K r"], color=DARK, linestyle=":", label="R-K", zorder=3, linewidth=1.3
                )
        axes.set(title=f"{revolutions} revolution{'s' if revolutions > 1 else ''}, N = {steps}", rlabel_position=135)
        axes.set_rlim(0.0, 7.0)
        axes.set_rticks([5.0, 6.0])
        if place == 1:
            axes.legend(loc="center")
    return figure


def forces(store: Store) -> Figure:
    """Forces of Mid. and Euler against time."""
    figure = Figure(figsize=(9.6, 5.4), layout="constrained")
    axes = figure.subplots(2, 3, sharex="row", sharey="row")
    for row, (revolutions, counts) in zip(axes, FORCES.items(), strict=True):
        for place, steps in zip(row, counts, strict=True):
            for label, *_, colour in METHODS:
                values = store.get(SECTION, _name(label, revolutions, steps))
                if values is not None:
                    place.stairs(values["u"], values["t"], color=colour, label=label, baseline=None, linewidth=1.2)
            place.set_title(f"$p = {revolutions}$, $N = {steps}$")
        row[0].set_ylabel("force $u$")
        for place in row:
            place.set_xlabel("time")
    axes[0][0].legend()
    return figure
