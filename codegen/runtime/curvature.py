"""The direction along which the cost curves downwards most while the equations hold to first order."""

import numpy as np

from codegen.runtime.apart import allocate_system
from codegen.runtime.system import factor_kkt, solve_kkt
from codegen.runtime.layout import free_unknowns

FLAT = 1e-8  # a shift that makes up for rounding: curvatures above minus this count as none
ITERATIONS = 4
NEARLY = 1e-6  # error up to which a point without a way on is looked at as a saddle point
ESCAPES = 3  # how often a saddle point is left
LEFT = ("solved", "saddle point", "unbounded")  # ends of a descent beside a saddle point that tell about it


def least_shift(grid, unknowns, system, curvature=0.0):
    """A shift of the Hessian that makes its part along the equations positive definite; the system is factored with it.

    `curvature` is added to its diagonal first. No more than ten times as much as is needed, and infinite where no
    shift helps.
    """
    shift = FLAT
    while shift < 1e20:
        diagonal = np.where(grid.is_multiplier, -FLAT, shift + curvature)
        if factor_kkt(grid, unknowns, 1.0, diagonal, system) == 0:
            return shift
        shift *= 10.0
    return np.inf


def is_nearly_stationary(point):
    """Whether a descent that cannot go on may have come to a saddle point, towards which shifted steps are slow."""
    return max(point.residual, point.stationarity) <= NEARLY


def is_below(point, saddle):
    """Whether the cost is lower than at a saddle point, by more than rounding."""
    return point.cost < saddle.cost - 1e-9 * max(1.0, abs(saddle.cost))


def steps_aside(grid, unknowns, curvature, escapes):
    """Steps along the falling direction to both sides; the more escapes there were, the longer.

    The first are a tenth of the greatest unknown long, or of one where that is smaller.
    """
    direction = falling_direction(grid, unknowns, curvature)
    size = max(1.0, np.abs(unknowns[~grid.is_multiplier]).max(initial=0.0))
    direction *= 0.1 * 3.0**escapes * size / max(np.abs(direction).max(initial=0.0), 1e-300)
    return direction, -direction


def falling_direction(grid, unknowns, curvature=0.0):
    """Inverse iteration with the shifted KKT matrix from a fixed random vector; zero where no shift helps.

    `curvature` is what a barrier adds to the Hessian's diagonal.
    """
    system = allocate_system(grid)
    direction = np.random.default_rng(1).uniform(0.5, 1.0, unknowns.size)
    if least_shift(grid, unknowns, system, curvature) == np.inf:
        return np.zeros(unknowns.size)
    free = free_unknowns(grid) & ~grid.is_multiplier
    for _ in range(ITERATIONS):
        right = np.where(free, direction / np.abs(direction[free]).max(initial=1e-300), 0.0)
        direction = np.empty(unknowns.size)
        solve_kkt(grid, system, right, direction)
    return np.where(free, direction, 0.0)
