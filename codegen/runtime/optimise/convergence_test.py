"""How large the terms of the equations are: what a residual has to be compared with."""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.kkt.ends_linear import add_end_terms
from codegen.runtime.stand_ins.example import (
    BODIES,
    COSTLESS,
    ELEMENT,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    NODE,
    SCALED,
    SHARED,
    STRIDE,
    interval_hessian,
)
from codegen.runtime.unknowns.shared import global_index, read_shared
from codegen.runtime.unknowns.times import span

UNIT_ROUNDOFF = 2.2e-16
VANISHED = 1e-20  # of ordinary size nothing is as small: where a cost of squares vanishes, so do all terms
WORTH_MEASURING = 1e-7  # above this error nobody has to know how small it could be


@njit(cache=True, error_model="numpy")
def term_sizes(unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, enough, as_many):
    """Largest sum of absolute terms |K| |x| in an equation of motion, and in a stationarity condition.

    `unknowns`, `sizes`, `is_multiplier` (n,), `nodes` (N + 1,), `parameters` (BODIES, P + SHARED).
    Half a unit in the last place of every unknown changes a residual by as much as that times the unit roundoff; see
    Higham (2002), Accuracy and stability of numerical algorithms, section 7.2.
    Terms only add up: once the former has reached `enough` and the latter `as_many`, no more intervals are looked at.
    """
    hessian, sums = zero_vector(HESSIAN_ROWS.size), zero_vector(unknowns.size)
    equations, stationarity = 0.0, 0.0
    if SCALED and sizes.size:
        unknowns = unknowns * sizes
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        for k in range(steps):
            first = body * (steps * STRIDE + NODE) + k * STRIDE
            here = unknowns[first : first + ELEMENT]
            t, length = span(nodes, k, h)
            interval_hessian(here, t, length, parameters[body], hessian)
            for j in range(HESSIAN_ROWS.size):
                row, column = first + HESSIAN_ROWS[j], first + HESSIAN_COLUMNS[j]
                if SHARED:
                    row = global_index(HESSIAN_ROWS[j], ELEMENT, first, body, unknowns.size)
                    column = global_index(HESSIAN_COLUMNS[j], ELEMENT, first, body, unknowns.size)
                sums[row] += abs(hessian[j] * unknowns[column])
                if row != column:
                    sums[column] += abs(hessian[j] * unknowns[row])
            if enough < np.inf:
                for i in range(first, first + ELEMENT):
                    size = sums[i]
                    if SCALED and sizes.size:
                        size *= weight * sizes[i]
                    if is_multiplier[i]:
                        equations = max(equations, size)
                    else:
                        stationarity = max(stationarity, size)
                if equations >= enough and stationarity >= as_many:
                    return equations, stationarity
        add_end_terms(unknowns, body, steps, h, parameters[body], sums)
    for i in range(sums.size):
        if SCALED and sizes.size:
            sums[i] *= weight * sizes[i]
        if is_multiplier[i]:
            if sums[i] > equations:
                equations = sums[i]
        elif sums[i] > stationarity:
            stationarity = sums[i]
    return equations, stationarity


def sizes_of_terms(grid, unknowns, enough=np.inf, as_many=np.inf):
    """The same of a grid, in parts of sizes where it has them."""
    steps, h, nodes, _, parameters, is_multiplier, sizes, _, weight, *_ = grid
    arguments = unknowns, sizes, weight, steps, h, nodes, parameters, is_multiplier, enough, as_many
    if COSTLESS:
        equations, stationarity = term_sizes(*arguments)  # the latter tends to zero with all multipliers
        return equations, max(1.0, stationarity)
    else:
        return term_sizes(*arguments)


def is_solved(grid, point, tolerance, roundings=1.0):
    """Whether residual and stationarity are within the tolerance, or no more than some rounding errors of their terms.

    The tolerance is absolute where the terms of the equations exceed one and relative to them where they are smaller,
    so that a problem in small units is not called solved too early.
    """
    if SCALED and point.error > max(tolerance, WORTH_MEASURING):
        return False
    if max(point.residual, point.stationarity) <= tolerance:  # then larger terms make no difference
        limits = enough_terms(point.residual, tolerance), enough_terms(point.stationarity, tolerance)
    else:
        limits = np.inf, np.inf
    equations, stationarity = sizes_of_terms(grid, point.unknowns, *limits)
    return is_small(point.residual, equations, tolerance, roundings) and is_small(
        point.stationarity, stationarity, tolerance, roundings
    )


def enough_terms(value, tolerance):
    """How large terms have to be for a value within the tolerance to be zero as `is_small` says, twice for rounding."""
    return 2.0 * value / tolerance if 2.0 * value < tolerance else 1.0


def is_small(value, size, tolerance, roundings):
    """Whether a sum of terms of a given size is zero, to the tolerance or but for rounding."""
    return value <= max(tolerance * min(1.0, size), roundings * UNIT_ROUNDOFF * size, VANISHED)
