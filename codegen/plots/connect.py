"""The figure of a connect problem: where particles go, and H along the way."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from codegen.interfaces import ConnectModule
from codegen.plots.purposes import new_figure
from codegen.plots.style import AMBER, BLUE, DARK, GREY, RED, title
from codegen.solutions.result import Result


def connect_figure(module: ConnectModule, result: Result) -> Figure:
    """Paths in the plane of the first two coordinates, and the change of H, which the exact motion keeps."""
    assert result.energy is not None, "a motion has energies"
    dimension = len(module.metadata.coordinates)
    paths = result.q.reshape(result.t.size, -1, dimension)
    second = 1 if dimension > 1 else 0
    figure = new_figure(7.0, 8.6)
    axes, below = figure.subplots(2, 1, height_ratios=[5.0, 1.2])
    x, y = paths[:, :, 0], paths[:, :, second]
    axes.plot(x, y, color=BLUE, linewidth=1.1, alpha=0.9)
    axes.plot(x[0], y[0], "x", color=DARK, markersize=5, label="start")
    axes.plot(x[-1], y[-1], ".", color=AMBER, markersize=7, label="end")
    if np.isfinite(result.summary["domain_margin"]):
        axes.add_patch(Circle((0.0, 0.0), 1.0, fill=False, color=GREY, linewidth=1.0))
    axes.set_aspect("equal")
    axes.legend(loc="upper right")
    below.plot(result.t, result.energy - result.energy[0], color=RED, linewidth=1.2)
    below.set_xlabel("time")
    below.set_ylabel("change of H")
    below.margins(x=0)
    title(figure, result)
    return figure
