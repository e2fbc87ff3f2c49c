"""How large the terms of the equations are: what a residual has to be compared with."""

import numpy as np

from codegen.runtime.search.descent import UNIT_ROUNDOFF, VANISHED, WORTH_MEASURING
from codegen.runtime.search.linear_system import allocate_system, filled_entries, multiply_entries


def sizes_of_terms(grid, unknowns, system=None):
    """Return the largest sums of absolute terms |K| |x| in an equation, and in a stationarity condition, scaled.

    Half a unit in the last place of every unknown changes a residual by as much as that times the unit roundoff; see
    Higham (2002), Accuracy and stability of numerical algorithms, section 7.2.
    """
    system, s, sums = system or allocate_system(grid), grid.problem.structure, np.zeros(unknowns.size)
    own = unknowns * grid.sizes if grid.sizes.size else unknowns
    entries = filled_entries(grid, own, system)
    multiply_entries(entries, system.rows, system.columns, grid.steps, system.counts, own, sums, True)
    for entry, row in s.fillings(grid.steps):
        value = entries[entry]
        sums[row] += (abs(value + 1.0) - 1.0 - abs(value)) * abs(own[row])
    if grid.sizes.size:
        sums *= grid.forces
    equations = sums[grid.is_multiplier].max(initial=0.0)
    stationarity = sums[~grid.is_multiplier].max(initial=0.0)
    return float(equations), float(max(1.0, stationarity) if s.costless else stationarity)


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
