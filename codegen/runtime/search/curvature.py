"""Directions of negative curvature, and steps along them away from saddle points.

Newton's steps with a shifted Hessian may stay in a set that the symmetry of a problem singles out, such as a plane. A
minimum of the cost on this set is a saddle point of the problem. Near it, the steps become slow long before they end. A
step along a direction of negative curvature leaves the set. Sources: More and Sorensen (1979), On the use of directions
of negative curvature in a modified Newton method, Mathematical Programming 16; Gould, Lucidi, Roma and Toint (2000),
Exploiting negative curvature directions in linesearch methods for unconstrained optimization.
"""

import numpy as np

from codegen.runtime.search.direction import FLAT
from codegen.runtime.search.grid import free_unknowns, views
from codegen.runtime.search.iterates import moved, step_along
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, solve_kkt

INVERSE_ITERATIONS = 4  # number of steps of the inverse iteration


def step_aside(search, iterate):
    """Return the iterate after a step along the direction of most negative curvature, downhill.

    The weight of the barrier, multipliers and duals stay as they are, up to the safeguard (16) of duals.
    """
    bounds, point = search.bounds, iterate.point
    downhill = -point.gradient
    np.add.at(downhill, bounds.indices, bounds.side * iterate.mu / iterate.distance)
    step, back = escape_steps(search.grid, point.unknowns, barrier_curvature(search, iterate), 0)
    if downhill @ step < 0.0:
        step = back
    taken = step_along(search, iterate, downhill, step)._replace(dual=np.zeros(iterate.duals.size))
    return moved(search, iterate, taken, taken.longest)


def barrier_curvature(search, iterate):
    """Return the second derivatives (n,) of the barrier."""
    curvature = np.zeros(iterate.point.unknowns.size)
    np.add.at(curvature, search.bounds.indices, iterate.duals / iterate.distance)
    return curvature


def escape_steps(grid, unknowns, curvature, escapes):
    """Return two opposite steps (n,) along the direction of most negative curvature, longer after more `escapes`.

    The first steps change each quantity by at most a tenth of max(1, its largest value). Each quantity has its own
    limit, because the magnitude of one quantity says nothing about others. `curvature` (n,) are the second derivatives
    of the barrier.
    """
    direction, sizes = negative_curvature_direction(grid, unknowns, curvature), np.maximum(1.0, np.abs(unknowns))
    for values in views(grid, sizes):
        values[:] = values.max(axis=1, initial=1.0)[:, None]
    direction *= 0.1 * 3.0**escapes / max((np.abs(direction) / sizes).max(initial=0.0), 1e-300)
    return direction, -direction


def negative_curvature_direction(grid, unknowns, curvature=0.0):
    """Return the direction (n,) of most negative curvature along which the equations hold to first order.

    The method is inverse iteration with the shifted KKT matrix from a fixed random vector. The result is zero if no
    shift suffices. `curvature` (n,), from the barrier, is added to the diagonal of the Hessian.
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


def least_delta_w(grid, unknowns, system, curvature=0.0):
    """Return a shift delta_w of the Hessian that makes the reduced Hessian positive definite, and factor with it.

    `curvature` is added to the diagonal first. The result is at most ten times the least possible shift, or infinite if
    no shift suffices.
    """
    delta_w = FLAT
    while delta_w < 1e20:
        diagonal = np.where(grid.is_multiplier, -FLAT, delta_w + curvature)
        if factor_kkt(grid, unknowns, 1.0, diagonal, system) == 0:
            return delta_w
        delta_w *= 10.0
    return np.inf
