"""Saddle points of the cost on the set where the equations hold: which points may be one, and steps beside it."""

import numpy as np

from codegen.runtime.optimise.negative_curvature import negative_curvature_direction
from codegen.runtime.unknowns.time_grid import views

NEARLY = 1e-6  # error up to which a point without a way on is looked at as a saddle point
ESCAPES = 3  # how often a saddle point is left
LEFT = ("solved", "saddle point", "unbounded")  # ends of a descent beside a saddle point that tell about it


def is_nearly_stationary(point):
    """Whether a descent that cannot go on may have come to a saddle point, towards which shifted steps are slow."""
    return max(point.residual, point.stationarity) <= NEARLY


def is_below(cost, saddle_cost):
    """Whether a cost is lower than at a saddle point, by more than rounding."""
    return cost < saddle_cost - 1e-9 * max(1.0, abs(saddle_cost))


def escape_steps(grid, unknowns, curvature, escapes):
    """Steps along the falling direction to both sides; the more escapes there were, the longer.

    The first change each quantity by a tenth of its greatest value at most, or of one where that is smaller: a large
    one says nothing about how far the others may go.
    """
    direction, sizes = negative_curvature_direction(grid, unknowns, curvature), np.maximum(1.0, np.abs(unknowns))
    for own in views(grid, sizes):
        own[:] = own.max(axis=1, initial=1.0)[:, None]
    direction *= 0.1 * 3.0**escapes / max((np.abs(direction) / sizes).max(initial=0.0), 1e-300)
    return direction, -direction
