"""Assembly of the KKT matrix with every unknown kept: the controls' block is not known to be constant and regular."""

import numpy as np
from numba import njit

from codegen.runtime.banded import factor_banded, solve_banded
from codegen.runtime.ends_pinned import close_ends
from codegen.runtime.example import (
    BANDWIDTH,
    ELEMENT,
    END_EXTRA,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    IS_MULTIPLIER,
    NODE,
    START_EXTRA,
    STRIDE,
    interval_hessian,
)
from codegen.runtime.lagrangian import add_end_gradients
from codegen.runtime.pins import clear_pinned

IS_CURVATURE = IS_MULTIPLIER[HESSIAN_ROWS % STRIDE] == IS_MULTIPLIER[HESSIAN_COLUMNS % STRIDE]


def allocate_system(grid):
    """Band matrix and its pivots."""
    size = START_EXTRA + grid.steps * STRIDE + NODE + END_EXTRA
    return np.empty((size, 3 * BANDWIDTH + 1)), np.empty(size, np.int64)


def assemble_kkt(grid, unknowns, weight, shift, dual_shift, gradient, system):
    """Fill gradient and system; return the cost and True (no block is eliminated that could be indefinite).

    The Hessian by primal unknowns is multiplied by `weight` and gets `shift` on its diagonal; the multipliers'
    diagonal gets -`dual_shift`.
    """
    band, _ = system
    band.fill(0.0)
    cost = assemble_band(
        unknowns, grid.steps, grid.h, grid.parameters, weight, shift, dual_shift, gradient, band
    )
    return cost, True


@njit(cache=True, error_model="numpy")
def assemble_band(unknowns, steps, h, parameters, weight, shift, dual_shift, gradient, band):
    """Add all intervals and both ends to gradient and band matrix; return the cost."""
    local, hessian = np.empty(ELEMENT), np.empty(HESSIAN_ROWS.size)
    for i in range(gradient.size):
        gradient[i] = 0.0
    cost = 0.0
    for k in range(steps):
        first = START_EXTRA + k * STRIDE
        cost += interval_hessian(unknowns[first : first + ELEMENT], k * h, h, parameters, local, hessian)
        for i in range(ELEMENT):
            gradient[first + i] += local[i]
        for j in range(hessian.size):
            row, column = HESSIAN_ROWS[j], HESSIAN_COLUMNS[j]
            value = weight * hessian[j] if IS_CURVATURE[j] else hessian[j]
            band[first + row, BANDWIDTH + column - row] += value
            if row != column:
                band[first + column, BANDWIDTH + row - column] += value
    for i in range(START_EXTRA, unknowns.size - END_EXTRA):
        band[i, BANDWIDTH] += -dual_shift if IS_MULTIPLIER[(i - START_EXTRA) % STRIDE] else shift
    add_end_gradients(unknowns, steps * h, parameters, gradient)
    close_ends(unknowns, steps * h, parameters, weight, shift, dual_shift, band)
    return cost


def factor_kkt(system):
    """Factor the assembled system in place; -1, or the row at which it is singular."""
    return factor_banded(system[0], system[1])


def solve_kkt(system, gradient, step):
    """Newton step for all unknowns."""
    band, pivots = system
    np.negative(gradient, out=step)
    clear_pinned(step)
    solve_banded(band, pivots, step)
