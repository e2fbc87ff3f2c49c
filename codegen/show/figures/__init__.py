"""Figures of results: optima, simulations, connected points, sweeps, closed loops and specimens."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen.drawing import Scene
from codegen.errors import ArgumentError
from codegen.show.figures.control import Drawings, control_figure
from codegen.show.figures.pareto import objectives_of, pareto_figure, require_objectives
from codegen.show.figures.picture import finished, using, write
from codegen.show.figures.quantities import label
from codegen.show.figures.simulation import closed_loop_figure, connect_figure, simulation_figure, specimen_figure
from codegen.show.figures.sweep import sweep_figure
from codegen.solving.loading import GeneratedModule, is_connect, is_control
from codegen.solving.results.result import Result

if TYPE_CHECKING:
    from xarray import Dataset

__all__ = [
    "Drawings", "closed_loop_figure", "connect_figure", "control_figure", "figure", "figure_of_sweep", "label",
    "pareto_figure", "save_specimens", "save_sweep", "simulation_figure", "specimen_figure", "sweep_figure",
]  # fmt: skip


def figure(
    module: GeneratedModule,
    result: Result,
    drawings: Drawings | Scene | None = None,
    unit: str = "",
    style: str = "page",
    panels: Sequence[str] | None = None,
) -> Figure:
    """Return the figure of a module's result in a style; `unit` is the unit of time if the result has no unit for it.

    Raises ArgumentError for an unknown style.
    """
    if panels is not None and not is_control(module):
        raise ArgumentError("panels can be chosen for optimal controls only", "leave panels out")
    with using(style):
        if is_connect(module):
            return finished(connect_figure(module, result))
        if is_control(module):
            assert not isinstance(drawings, Scene)
            return finished(control_figure(module, result, drawings, unit, panels))
        assert not isinstance(drawings, Drawings)
        return finished(simulation_figure(result, drawings, unit))


def save_sweep(data: Dataset, path: Path, pareto: str | None = None, style: str = "page") -> None:
    """Write the figure of a sweep to a file, or its Pareto front for two objectives such as "cost,duration".

    Raises ArgumentError for unknown objectives and for an unknown style.
    """
    write(figure_of_sweep(data, pareto, style), path, style)


def figure_of_sweep(data: Dataset, pareto: str | None = None, style: str = "page") -> Figure:
    """Return the figure of a sweep or of its Pareto front; raises ArgumentError for unknown objectives."""
    with using(style):
        if pareto is None:
            return finished(sweep_figure(data))
        objectives = objectives_of(pareto)
        require_objectives(objectives, data)
        return finished(pareto_figure(data, objectives))


def save_specimens(points: NDArray[np.float64], names: Sequence[str], share: float, path: Path) -> None:
    """Write a map of specimens at `points` (m, 2) to a file; for `share` see `specimen_figure`."""
    with using("page"):
        drawn = specimen_figure(points, names, share)
    write(drawn, path)
