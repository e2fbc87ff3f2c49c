"""Saddle points of the cost on the set where the equations hold: directions of negative curvature and escape steps."""

import numpy as np

from codegen.runtime.search.descent import FLAT
from codegen.runtime.search.grid import free_unknowns, views
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, solve_kkt

INVERSE_ITERATIONS = 4
ESCAPES = 3  # how often a saddle point is left
LEFT = ("solved", "saddle point", "unbounded")  # ends of a descent beside a saddle point that tell about it


def least_delta_w(grid, unknowns, system, curvature=0.0):
    """Return a delta_w that makes the Hessian on the equations' null space positive definite, and factor with it.

    `curvature` is added to the diagonal first. The result is at most ten times as much as is needed, and infinite where
    none is enough.
    """
    delta_w = FLAT
    while delta_w < 1e20:
        diagonal = np.where(grid.is_multiplier, -FLAT, delta_w + curvature)
        if factor_kkt(grid, unknowns, 1.0, diagonal, system) == 0:
            return delta_w
        delta_w *= 10.0
    return np.inf


def negative_curvature_direction(grid, unknowns, curvature=0.0):
    """Return the direction (n,) of most negative curvature while the equations hold to first order.

    By inverse iteration with the shifted KKT matrix from a fixed random vector; zero where no shift helps. `curvature`
    is what a barrier adds to the Hessian's diagonal.
    """
    system = allocate_system(grid)
    direction = np.random.default_rng(1).uniform(0.5, 1.0, unknowns.size)
    if least_delta_w(grid, unknowns, system, curvature) == np.inf:
        return np.zeros(unknowns.size)
    free = free_unknowns(grid) & ~grid.is_multiplier
    for _ in range(INVERSE_ITERATIONS):
        right = np.where(free, direction / np.abs(direction[free]).max(initial=1e-300), 0.0)
        direction = np.empty(unknowns.size)
        solve_kkt(grid, system, right, direction)
    return np.where(free, direction, 0.0)


def is_below(cost, saddle_cost):
    """Return True if a cost is lower than at a saddle point, by more than rounding."""
    return cost < saddle_cost - 1e-9 * max(1.0, abs(saddle_cost))


def escape_steps(grid, unknowns, curvature, escapes):
    """Return steps along the falling direction to both sides; the more escapes there were, the longer.

    The first change each quantity by a tenth of its greatest value at most, or of one where that is smaller: a large
    one says nothing about how far the others may go.
    """
    direction, sizes = negative_curvature_direction(grid, unknowns, curvature), np.maximum(1.0, np.abs(unknowns))
    for own in views(grid, sizes):
        own[:] = own.max(axis=1, initial=1.0)[:, None]
    direction *= 0.1 * 3.0**escapes / max((np.abs(direction) / sizes).max(initial=0.0), 1e-300)
    return direction, -direction
