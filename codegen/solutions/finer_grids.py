"""A solution on a finer grid, whose intervals are parts of its own: to look at what lies between nodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from codegen.interfaces import Grid, Matrix, Vector, time_grid


def cut(module: Any, coarse: Grid, cuts: Matrix) -> Grid:
    """The grid on which every interval is cut in the parts (intervals, parts) of it."""
    phases = module.metadata.phases
    parts = (np.diff(coarse.nodes)[:, None] * cuts).reshape(phases, -1)
    parts /= parts.sum(axis=1, keepdims=True)
    return time_grid(module, parts.shape[1], parts if phases > 1 else parts[0])


def carried(module: Any, coarse: Grid, fine: Grid, unknowns: Vector, parts: int, straight: bool = False) -> Vector:
    """The unknowns on the finer grid: states interpolated, what intervals have as it is, no slacks nor multipliers.

    States are straight lines between the nodes of a scheme of order two, or where that is asked for, and monotone
    cubics for higher orders.
    """
    result = np.zeros(fine.is_multiplier.size)
    nodes, intervals = module.views(coarse, unknowns)
    new_nodes, new_intervals = module.views(fine, result)
    order = module.metadata.order
    phases, old, new = module.metadata.phases, coarse.nodes / coarse.steps, fine.nodes / fine.steps
    for phase in range(phases):
        count = intervals.shape[1] // phases
        here, there = (slice(phase * n + min(phase, 1), (phase + 1) * n + 1) for n in (count, parts * count))
        new_nodes[:, there] = _interpolated(old[here], nodes[:, here], new[there], straight or order == 2)
    new_intervals[:] = np.repeat(intervals, parts, axis=1)
    new_intervals[:, :, module.problem.structure.slacks - nodes.shape[2]] = 0.0
    root = module.problem.structure.root
    result[result.size - root :] = unknowns[unknowns.size - root :]
    result[fine.is_multiplier] = 0.0
    return result


def _interpolated(t: Vector, values: Matrix, at: Vector, straight: bool) -> Matrix:
    if not straight and t.size > 2:
        from scipy.interpolate import PchipInterpolator  # which takes long to import

        with np.errstate(over="ignore"):  # reciprocals of slopes that are next to zero
            return np.asarray(PchipInterpolator(t, values, axis=1)(np.clip(at, t[0], t[-1])), dtype=float)
    left = np.clip(np.searchsorted(t, at, side="right") - 1, 0, max(0, t.size - 2))
    right = np.minimum(left + 1, t.size - 1)
    width = np.where(right > left, t[right] - t[left], 1.0)
    share = np.clip((at - t[left]) / width, 0.0, 1.0)[None, :, None]
    return np.asarray((1.0 - share) * values[:, left] + share * values[:, right])
