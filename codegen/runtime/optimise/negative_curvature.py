"""The direction of most negative curvature of the Lagrangian while the equations hold to first order."""

import numpy as np

from codegen.runtime.kkt.unbordered import allocate_system
from codegen.runtime.kkt.system import factor_kkt, solve_kkt
from codegen.runtime.unknowns.layout import free_unknowns

FLAT = 1e-8  # a delta_w that makes up for rounding: curvatures above minus this count as none
ITERATIONS = 4


def least_delta_w(grid, unknowns, system, curvature=0.0):
    """A delta_w that makes the Hessian on the equations' null space positive definite; the system is factored with it.

    `curvature` is added to its diagonal first. No more than ten times as much as is needed, and infinite where none
    is enough.
    """
    delta_w = FLAT
    while delta_w < 1e20:
        diagonal = np.where(grid.is_multiplier, -FLAT, delta_w + curvature)
        if factor_kkt(grid, unknowns, 1.0, diagonal, system) == 0:
            return delta_w
        delta_w *= 10.0
    return np.inf


def negative_curvature_direction(grid, unknowns, curvature=0.0):
    """Inverse iteration with the shifted KKT matrix from a fixed random vector; zero where no delta_w helps.

    `curvature` is what a barrier adds to the Hessian's diagonal.
    """
    system = allocate_system(grid)
    direction = np.random.default_rng(1).uniform(0.5, 1.0, unknowns.size)
    if least_delta_w(grid, unknowns, system, curvature) == np.inf:
        return np.zeros(unknowns.size)
    free = free_unknowns(grid) & ~grid.is_multiplier
    for _ in range(ITERATIONS):
        right = np.where(free, direction / np.abs(direction[free]).max(initial=1e-300), 0.0)
        direction = np.empty(unknowns.size)
        solve_kkt(grid, system, right, direction)
    return np.where(free, direction, 0.0)
