"""Figures A.1 to A.5 of the thesis: hovercraft that meet in a polygon, first guess and optimum."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from codegen.interfaces import is_control
from codegen.plots.style import CRIMSON, GREY, body_colours
from codegen.report.building import Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.figures.landmarks import svg
from codegen.report.measure.optima import solved
from codegen.report.section import Picture, Section, Table, number, seconds
from codegen.report.store import Case, Store, Values

SECTION = "hovercraft: figures A.1 to A.5"
CRAFT = (3, 5)
STEPS = 20


def variants(problem: Path) -> list[Variant]:
    """A module for three craft, and one for five."""
    return [Variant(problem, "variational", "midpoint", 2, (("craft", str(count)),)) for count in CRAFT]


def cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """A case for each number of craft."""
    for variant, count in zip(variants(problem), CRAFT, strict=True):
        yield Case(SECTION, f"{count} craft", lambda v=variant: _solved(workshop, v, extent.repeat))  # type: ignore[misc]


def _solved(workshop: Workshop, variant: Variant, repeat: int) -> Values:
    module = workshop.module(variant)
    assert is_control(module)
    grid = module.make_grid(STEPS)
    _, guess, *_ = module.unpack(grid, module.initial_guess(grid))
    optimum = module.solve(STEPS).q
    bodies = module.metadata.bodies
    values = solved(module, STEPS, repeat)
    return {
        **values,
        "guess": guess.reshape(STEPS + 1, bodies, 3),
        "optimum": optimum.reshape(STEPS + 1, bodies, 3),
    }


def sections(store: Store, problem: Path) -> list[Section]:
    """A table and the paths."""
    del problem
    found = {count: store.get(SECTION, f"{count} craft") for count in CRAFT}
    known = {count: values for count, values in found.items() if values is not None}
    if not known:
        return []
    rows = tuple(
        (str(count), v["status"], f"{v['cost']:.9g}", seconds(v["seconds"]), str(v["iterations"]),
         number(v["residual"], 2), number(v["stationarity"], 2))
        for count, v in known.items()
    )  # fmt: skip
    head = ("craft", "status", "cost", "time", "iterations", "residual", "stationarity")
    table = Table(f"Hovercraft on N = {STEPS} intervals.", head, rows)
    picture = Picture(
        "First guess (left) and optimum (right); arrows show the heading at every other node.",
        svg(lambda: paths(known)),
    )
    return [Section("Hovercraft: Figures A.1 to A.5", (), (table,), (picture,))]


def paths(known: dict[int, Values]) -> Figure:
    """A row for each number of craft."""
    figure = Figure(figsize=(8.6, 4.3 * len(known)), layout="constrained")
    axes = figure.subplots(len(known), 2, squeeze=False, sharex="row", sharey="row")
    for row, (count, values) in zip(axes, known.items(), strict=True):
        for place, name in zip(row, ("guess", "optimum"), strict=True):
            _draw(place, np.array(values[name], dtype=float))
            place.set(aspect="equal", xlabel="$x$", title=f"{count} craft, {name}")
        row[0].set_ylabel("$y$")
    return figure


def _draw(axes: Any, states: Any) -> None:
    """Paths with headings, and the polygon in which they end; states of shape (N + 1, craft, 3)."""
    ends = states[-1, :, :2]
    axes.plot(*np.vstack([ends, ends[:1]]).T, color=GREY, linewidth=0.8)
    for body, colour in enumerate(body_colours(states.shape[1], "")):
        x, y, heading = states[:, body].T
        axes.plot(x, y, color=colour)
        axes.plot(x[0], y[0], "x", color=colour, markersize=5)
        axes.plot(x[-1], y[-1], "o", color=colour, markersize=4)
        axes.quiver(x[::2], y[::2], np.cos(heading[::2]), np.sin(heading[::2]), color=CRIMSON, angles="xy",
                    scale=14, width=0.004, headwidth=4)  # fmt: skip
