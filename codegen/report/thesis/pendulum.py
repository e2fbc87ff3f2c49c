"""Figure 1.3 of the thesis: phase portraits of the pendulum by four methods, and how their energies drift."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from codegen.interfaces import is_simulation
from codegen.plots.style import GREY
from codegen.report.building import Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.figures.landmarks import svg
from codegen.report.figures.problems import colour_of
from codegen.report.section import Picture, Section, Table, number
from codegen.report.store import Case, Store, Values

SECTION = "pendulum: figure 1.3"
PORTRAITS = (
    ("explicit-euler", 0.2, ((0.5, 0.0),), 60),
    ("implicit-euler", 0.2, ((1.5, 0.0),), 150),
    ("symplectic-euler", 0.3, ((0.0, 0.7), (0.0, 1.4), (0.0, 2.1)), 200),
    ("midpoint", 0.3, ((0.0, 0.7), (0.0, 1.4), (0.0, 2.1)), 200),
)
"""Scheme, step, initial states and number of steps, which the thesis does not give."""
LONG = 100_000
"""Steps after which the drift of energy is measured again."""


def variants(problem: Path) -> list[Variant]:
    """The modules that the portraits need."""
    return [Variant(problem, "hamiltonian", scheme, 2 if scheme == "midpoint" else 1) for scheme, *_ in PORTRAITS]


def cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """A case for every method and initial state."""
    del extent
    for variant, (scheme, h, starts, steps) in zip(variants(problem), PORTRAITS, strict=True):
        for start in starts:
            yield Case(
                SECTION,
                f"{scheme}; {start}",
                lambda v=variant, h=h, z=start, n=steps: _path(workshop, v, h, z, n),  # type: ignore[misc]
            )


def _path(workshop: Workshop, variant: Variant, h: float, start: tuple[float, float], steps: int) -> Values:
    module = workshop.module(variant)
    assert is_simulation(module)
    short = module.solve(steps, duration=h * steps, start=start)
    long = module.solve(LONG, duration=h * LONG, start=start, every=LONG // 1000)
    return {
        "q": short.q[:, 0],
        "p": short.p[:, 0],
        "largest drift": np.abs(short.energy - short.energy[0]).max(),
        "final drift": short.energy[-1] - short.energy[0],
        "largest drift in the long run": np.abs(long.energy - long.energy[0]).max(),
        "slope in the long run": _slope(long.t, long.energy),
    }


def _slope(t: Any, energy: Any) -> float:
    """Least-squares slope of the energy over the second half of a run, in energy per unit of time."""
    half = t.size // 2
    return float(np.polyfit(t[half:], energy[half:], 1)[0])


def sections(store: Store, problem: Path) -> list[Section]:
    """The portraits, and the drift numbers."""
    del problem
    rows = []
    for scheme, h, starts, steps in PORTRAITS:
        for start in starts:
            values = store.get(SECTION, f"{scheme}; {start}")
            if values is not None:
                rows.append((
                    scheme, number(h), f"({start[0]:g}, {start[1]:g})", str(steps), number(values["largest drift"]),
                    number(values["final drift"]), number(values["largest drift in the long run"]),
                    number(values["slope in the long run"], 2),
                ))  # fmt: skip
    head = ("scheme", "h", "z₀", "steps", "largest |H − H₀|", "final H − H₀", f"largest after {LONG:,} steps",
            "slope of H per unit of time then")  # fmt: skip
    text = (
        "The thesis's Figure 1.3: explicit Euler spirals out, implicit Euler in, the symplectic methods stay near "
        "level curves of H (grey). The number of steps is not in the thesis; explicit Euler's portrait stops before "
        "the pendulum turns over."
    )
    table = Table("Drift of energy. A bounded drift without slope is what a symplectic method promises.", head,
                  tuple(rows))  # fmt: skip
    return [Section("Pendulum: phase portraits (Figure 1.3)", (text,), (table,),
                    (Picture("Phase portraits in the plane of q and p.", svg(lambda: portraits(store))),))]  # fmt: skip


def portraits(store: Store) -> Figure:
    """Four panels as in the thesis."""
    figure = Figure(figsize=(8.6, 6.4), layout="constrained")
    panels = figure.subplots(2, 2, sharex=True, sharey=True).ravel()
    q, p = np.meshgrid(np.linspace(-3.4, 3.4, 200), np.linspace(-2.4, 2.4, 160))
    for axes, (scheme, h, starts, _) in zip(panels, PORTRAITS, strict=True):
        levels = sorted({0.5 * p0**2 - np.cos(q0) for q0, p0 in starts})
        axes.contour(q, p, p**2 / 2 - np.cos(q), levels=levels, colors=[GREY], linewidths=0.9, linestyles="-")
        for start in starts:
            values = store.get(SECTION, f"{scheme}; {start}") or {"q": [], "p": []}
            places = (np.array(values["q"]) + np.pi) % (2.0 * np.pi) - np.pi
            axes.plot(places, values["p"], ".", markersize=3.0, color=colour_of(scheme))
            axes.plot(*start, "o", markersize=4.5, markerfacecolor="white", color=colour_of(scheme))
        axes.set(title=f"{scheme}, $h = {h}$", aspect="equal", xlim=(-3.3, 3.3), ylim=(-2.4, 2.4))
    for axes in panels[2:]:
        axes.set_xlabel("$q$")
    for axes in panels[::2]:
        axes.set_ylabel("$p$")
    return figure
