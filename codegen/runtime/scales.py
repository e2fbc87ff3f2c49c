"""Solve in parts of the sizes of unknowns and equations, which a change of units changes with them.

What is solved is the same problem in other units, those in which its numbers are of ordinary size (see `sizes`); where
all sizes are between 1/ORDINARY and ORDINARY, none is used.
"""

from functools import lru_cache

import numpy as np

from codegen.runtime.example import (
    BODIES,
    COUPLINGS,
    INEQUALITIES,
    NODE,
    OWN,
    SHARED,
    STRIDE,
    variable_bounds,
    with_pinned_values,
)
from codegen.runtime.frame import NONE, plain_grid
from codegen.runtime.messages import describe
from codegen.runtime.newton_filter import minimise
from codegen.runtime.point import evaluate
from codegen.runtime.sizes import fill_sizes

ORDINARY = 1e3  # sizes between its inverse and it need no scaling


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise in parts of sizes, unless `scaling` is "none"; return (status, message, point, iterations)."""
    if scaling not in ("auto", "none"):
        raise ValueError(f"scaling is {scaling!r}, expected 'auto' or 'none'")
    if scaling == "auto":
        grid = scaled_grid(grid, unknowns)
    start = unknowns / grid.sizes if grid.sizes.size else unknowns
    status, point, iterations = minimise(grid, start, tolerance, max_iterations, warm, log)
    return *describe(grid, start, point, status), in_units(grid, point), iterations


def scaled_grid(grid, unknowns):
    """The same grid with sizes of all unknowns and the weight of the cost, or without where all are ordinary."""
    sizes, bounds = np.empty(unknowns.size), (NONE, NONE)
    if INEQUALITIES:
        bounds = variable_bounds(grid)
    weight, extreme = fill_sizes(unknowns, *bounds, kinds_of(grid.steps), grid.steps, grid.h, grid.parameters, sizes)
    if not extreme > ORDINARY:
        return grid._replace(bounds=bounds)
    bounds = bounds[0] / sizes, bounds[1] / sizes
    return grid._replace(sizes=sizes, forces=weight * sizes, weight=weight, bounds=bounds)


@lru_cache(maxsize=4)
def kinds_of(steps):
    """The kind of every unknown: its place in a node with the interval after it, then the shared ones."""
    chain = np.tile(np.arange(steps * STRIDE + NODE) % STRIDE, BODIES)
    if SHARED:
        own, common = np.tile(np.arange(OWN), BODIES), np.arange(OWN, SHARED + COUPLINGS)
        return np.concatenate([chain, STRIDE + own, STRIDE + common])
    else:
        return chain


def in_units(grid, point):
    """A point in the problem's own units; its stationarity is the change of the cost with parts of sizes."""
    if not grid.sizes.size:
        return point
    stationarity = point.stationarity / grid.weight
    sizes, grid = grid.sizes, plain_grid(grid)
    point = evaluate(grid, with_pinned_values(grid, point.unknowns * sizes))
    return point._replace(stationarity=stationarity, error=max(point.residual, stationarity))
