"""How large the terms of the equations are: what a residual has to be compared with."""

import numpy as np

from codegen.runtime.search import descent
from codegen.runtime.search.descent import UNIT_ROUNDOFF, VANISHED, WORTH_MEASURING
from codegen.runtime.search.iterates import arguments_of
from codegen.runtime.search.linear_system import allocate_system


def sizes_of_terms(grid, unknowns, system=None):
    """Return the largest sums of absolute terms in an equation, and in a stationarity condition, as `terms`, scaled."""
    problem, data, storage = arguments_of(grid, system or allocate_system(grid))
    vectors, is_costless = np.empty((descent.VECTORS, unknowns.size)), int(grid.problem.structure.costless)
    return descent.terms(problem, data, storage, unknowns, is_costless, vectors)


def is_solved(grid, point, tolerance, roundings=1.0, system=None):
    """Return True if residual and stationarity are within the tolerance, or some rounding errors of their terms.

    The tolerance is absolute where the terms of the equations exceed one and relative to them where they are smaller,
    so that a problem in small units is not called solved too early.
    """
    if not grid.problem.structure.linear_quadratic and point.error > max(tolerance, WORTH_MEASURING):
        return False
    equations, stationarity = sizes_of_terms(grid, point.unknowns, system)
    return is_small(point.residual, equations, tolerance, roundings) and is_small(
        point.stationarity, stationarity, tolerance, roundings
    )


def is_small(value, size, tolerance, roundings):
    """Return True if a sum of terms of a given size is zero, to the tolerance or but for rounding."""
    return value <= max(tolerance * min(1.0, size), roundings * UNIT_ROUNDOFF * size, VANISHED)


def is_at_rounding_level(grid, point, system=None):
    """Return True if residual and stationarity are no larger than a thousand rounding errors."""
    sizes = sizes_of_terms(grid, point.unknowns, system)
    return point.residual <= 1e3 * UNIT_ROUNDOFF * sizes[0] and point.stationarity <= 1e3 * UNIT_ROUNDOFF * sizes[1]
