"""Assembly of the KKT matrix with the controls of each interval eliminated.

The controls' block C of the Hessian is the same on every interval, so it is inverted once. Eliminating the controls
of an interval leaves, in the remaining unknowns of its element, K - B' inverse(C) B, with B the coupling block.
"""

import numpy as np
from numba import njit

from codegen.runtime.banded import factor_banded, solve_banded
from codegen.runtime.ends_pinned import close_ends
from codegen.runtime.example import (
    BANDWIDTH,
    CONTROLS,
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

BLOCK = STRIDE - CONTROLS  # unknowns of a node and its interval that stay


def sort_entries():
    """Sort the entries of an interval's Hessian: those that stay, those that couple to controls, the controls' own.

    Each kind is a tuple of arrays (place in the list of entries, row, column), rows and columns counted among the
    unknowns that stay, or among the controls.
    """
    is_control = (np.arange(ELEMENT) >= BLOCK) & (np.arange(ELEMENT) < STRIDE)
    place = np.cumsum(~is_control) - 1
    place[is_control] = np.arange(CONTROLS)
    kinds = is_control[HESSIAN_ROWS].astype(int) + is_control[HESSIAN_COLUMNS]
    swapped = is_control[HESSIAN_COLUMNS] & ~is_control[HESSIAN_ROWS]
    rows = place[np.where(swapped, HESSIAN_COLUMNS, HESSIAN_ROWS)]
    columns = place[np.where(swapped, HESSIAN_ROWS, HESSIAN_COLUMNS)]
    return [(entries, rows[entries], columns[entries]) for entries in (np.flatnonzero(kinds == n) for n in range(3))]


(KEPT, KEPT_ROWS, KEPT_COLUMNS), (COUPLED, COUPLED_ROWS, COUPLED_COLUMNS), INNER = sort_entries()
IS_CURVATURE = IS_MULTIPLIER[HESSIAN_ROWS % STRIDE] == IS_MULTIPLIER[HESSIAN_COLUMNS % STRIDE]
TOUCHED = np.unique(COUPLED_COLUMNS)  # what the elimination of the controls changes
SLOTS = np.searchsorted(TOUCHED, COUPLED_COLUMNS)


def allocate_system(grid):
    """Band matrix, its pivots, the coupling blocks B of all intervals and the inverse of C."""
    size = START_EXTRA + grid.steps * BLOCK + NODE + END_EXTRA
    return (
        np.empty((size, 3 * BANDWIDTH + 1)),
        np.empty(size, np.int64),
        np.zeros((grid.steps, CONTROLS, TOUCHED.size)),
        np.empty((CONTROLS, CONTROLS)),
    )


def assemble_kkt(grid, unknowns, weight, shift, dual_shift, gradient, system):
    """Fill gradient and system; return the cost and whether the controls' block is positive definite.

    The Hessian by primal unknowns is multiplied by `weight` and gets `shift` on its diagonal; the multipliers'
    diagonal gets -`dual_shift`.
    """
    band, _, couplings, inverse = system
    positive = invert_controls(grid, unknowns, weight, shift, inverse)
    band.fill(0.0)
    cost = assemble_band(
        unknowns, grid.steps, grid.h, grid.parameters, weight, shift, dual_shift, gradient, band, couplings, inverse
    )
    return cost, positive


def invert_controls(grid, unknowns, weight, shift, inverse):
    """Invert the controls' block C, which is that of the first interval; False when it is not positive definite."""
    hessian = np.empty(HESSIAN_ROWS.size)
    interval_hessian(unknowns[START_EXTRA:], 0.0, grid.h, grid.parameters, np.empty(ELEMENT), hessian)
    block = shift * np.eye(CONTROLS)
    entries, rows, columns = INNER
    block[rows, columns] += weight * hessian[entries]
    block[columns, rows] = block[rows, columns]
    if not np.isfinite(block).all() or np.linalg.eigvalsh(block)[0] <= 0.0:
        return False
    inverse[:] = np.linalg.inv(block)
    return True


@njit(cache=True, error_model="numpy")
def assemble_band(
    unknowns, steps, h, parameters, weight, shift, dual_shift, gradient, band, couplings, inverse
):
    """Add all intervals and both ends to gradient and band matrix, keep the coupling blocks; return the cost."""
    local, hessian = np.empty(ELEMENT), np.empty(HESSIAN_ROWS.size)
    for i in range(gradient.size):
        gradient[i] = 0.0
    cost = 0.0
    for k in range(steps):
        first = START_EXTRA + k * STRIDE
        cost += interval_hessian(unknowns[first : first + ELEMENT], k * h, h, parameters, local, hessian)
        for i in range(ELEMENT):
            gradient[first + i] += local[i]
        if weight != 1.0:
            for j in range(hessian.size):
                if IS_CURVATURE[j]:
                    hessian[j] *= weight
        add_interval(hessian, couplings[k], inverse, START_EXTRA + k * BLOCK, band)
    for i in range(START_EXTRA, band.shape[0] - END_EXTRA):
        band[i, BANDWIDTH] += -dual_shift if IS_MULTIPLIER[(i - START_EXTRA) % BLOCK] else shift
    add_end_gradients(unknowns, steps * h, parameters, gradient)
    close_ends(unknowns, steps * h, parameters, weight, shift, dual_shift, band)
    return cost


@njit(cache=True, error_model="numpy")
def add_interval(hessian, coupling, inverse, first, band):
    """Add K - B' inverse(C) B of one interval to the band matrix, and keep B for the recovery of the controls."""
    for j in range(KEPT.size):
        row, column, value = KEPT_ROWS[j], KEPT_COLUMNS[j], hessian[KEPT[j]]
        band[first + row, BANDWIDTH + column - row] += value
        if row != column:
            band[first + column, BANDWIDTH + row - column] += value
    for j in range(COUPLED.size):
        coupling[COUPLED_ROWS[j], SLOTS[j]] = hessian[COUPLED[j]]
    for a in range(CONTROLS):
        for b in range(CONTROLS):
            for i in range(TOUCHED.size):
                weighted = coupling[a, i] * inverse[a, b]
                for j in range(TOUCHED.size):
                    band[first + TOUCHED[i], BANDWIDTH + TOUCHED[j] - TOUCHED[i]] -= weighted * coupling[b, j]


def factor_kkt(system):
    """Factor the assembled system in place; -1, or the row at which it is singular."""
    return factor_banded(system[0], system[1])


def solve_kkt(system, gradient, step):
    """Newton step for all unknowns: eliminate the controls from -gradient, solve, recover the controls."""
    band, pivots, couplings, inverse = system
    reduced = np.empty(band.shape[0])
    condense(gradient, couplings, inverse, reduced)
    solve_banded(band, pivots, reduced)
    expand(reduced, gradient, couplings, inverse, step)


@njit(cache=True, error_model="numpy")
def condense(gradient, couplings, inverse, reduced):
    """The right-hand side -(g - B' inverse(C) g_u) of the unknowns that stay."""
    for i in range(reduced.size):
        block = min((i - START_EXTRA) // BLOCK, couplings.shape[0]) if i >= START_EXTRA else 0
        reduced[i] = -gradient[i + block * CONTROLS]
    for k in range(couplings.shape[0]):
        first, controls = START_EXTRA + k * BLOCK, START_EXTRA + k * STRIDE + BLOCK
        for a in range(CONTROLS):
            for b in range(CONTROLS):
                weighted = inverse[a, b] * gradient[controls + b]
                for i in range(TOUCHED.size):
                    reduced[first + TOUCHED[i]] += couplings[k, a, i] * weighted
    clear_pinned(reduced)


@njit(cache=True, error_model="numpy")
def expand(reduced, gradient, couplings, inverse, step):
    """The step of all unknowns, with the controls' share -inverse(C) (g_u + B d) of every interval."""
    for i in range(reduced.size):
        block = min((i - START_EXTRA) // BLOCK, couplings.shape[0]) if i >= START_EXTRA else 0
        step[i + block * CONTROLS] = reduced[i]
    for k in range(couplings.shape[0]):
        first, controls = START_EXTRA + k * BLOCK, START_EXTRA + k * STRIDE + BLOCK
        for a in range(CONTROLS):
            step[controls + a] = 0.0
        for b in range(CONTROLS):
            forcing = gradient[controls + b]
            for i in range(TOUCHED.size):
                forcing += couplings[k, b, i] * reduced[first + TOUCHED[i]]
            for a in range(CONTROLS):
                step[controls + a] -= inverse[a, b] * forcing
