"""An interval's element matrix, with the interval's controls eliminated.

The controls' block C of the Hessian is the same on every interval, so it is inverted once. Eliminating the controls
of an interval leaves, in the remaining unknowns of its element, K - B' inverse(C) B, with B the coupling block.
"""

import numpy as np
from numba import njit

from codegen.runtime.elements import BLOCK, SIZE
from codegen.runtime.example import CONTROLS, ELEMENT, HESSIAN_COLUMNS, HESSIAN_ROWS, NODE, STRIDE, control_hessian


def sort_entries():
    """Sort the entries of an interval's Hessian: those that stay, and those that couple to controls.

    Each kind is a tuple of arrays (place in the list of entries, row, column); rows and columns are counted among the
    unknowns that stay, or among the controls.
    """
    is_control = (np.arange(ELEMENT) >= BLOCK) & (np.arange(ELEMENT) < STRIDE)
    place = np.concatenate([np.arange(BLOCK), np.arange(CONTROLS), np.arange(BLOCK, SIZE)])
    kinds = is_control[HESSIAN_ROWS].astype(int) + is_control[HESSIAN_COLUMNS]
    swapped = is_control[HESSIAN_COLUMNS] & ~is_control[HESSIAN_ROWS]
    rows = place[np.where(swapped, HESSIAN_COLUMNS, HESSIAN_ROWS)]
    columns = place[np.where(swapped, HESSIAN_ROWS, HESSIAN_COLUMNS)]
    return [(entries, rows[entries], columns[entries]) for entries in (np.flatnonzero(kinds == n) for n in range(2))]


(KEPT, KEPT_ROWS, KEPT_COLUMNS), (COUPLED, COUPLED_ROWS, COUPLED_COLUMNS) = sort_entries()
TOUCHED = np.unique(COUPLED_COLUMNS)  # unknowns whose entries the elimination of the controls changes
SLOTS = np.searchsorted(TOUCHED, COUPLED_COLUMNS)


def allocate_controls(grid):
    """The block C, room for its inverse, and for B of all intervals."""
    block = np.zeros((CONTROLS, CONTROLS))
    control_hessian(grid.h, grid.parameters, block)
    block += np.tril(block, -1).T
    return block, np.empty_like(block), np.zeros((grid.steps, CONTROLS, TOUCHED.size))


def prepare_controls(weight, shift, controls):
    """Invert the controls' block C, weighted and shifted; False when it is not positive definite."""
    block, inverse, _ = controls
    shifted = weight * block
    shifted.flat[:: CONTROLS + 1] += shift
    return invert_positive_definite(shifted.tolist(), inverse)


def invert_positive_definite(rows, inverse):
    """Invert a small symmetric matrix, given as lists, by Gauss-Jordan elimination; False when it is not positive.

    Plain Python is faster here than numpy, whose calls cost more than the arithmetic of a few controls.
    """
    size = len(rows)
    for k, pivot_row in enumerate(rows):
        pivot = pivot_row[k]
        if not 0.0 < pivot < np.inf:
            return False
        pivot_row[k] = 1.0
        pivot_row[:] = [value / pivot for value in pivot_row]
        for i in range(size):
            if i != k:
                factor, rows[i][k] = rows[i][k], 0.0
                rows[i][:] = [value - factor * above for value, above in zip(rows[i], pivot_row, strict=True)]
    inverse[:] = rows
    return True


@njit(error_model="numpy")
def add_element(hessian, controls, k, element):
    """Add K - B' inverse(C) B of interval k to the element matrix, and keep B for the recovery of the controls."""
    _, inverse, couplings = controls
    for j in range(KEPT.size):
        element[KEPT_ROWS[j], KEPT_COLUMNS[j]] += hessian[KEPT[j]]
        if KEPT_ROWS[j] != KEPT_COLUMNS[j]:
            element[KEPT_COLUMNS[j], KEPT_ROWS[j]] += hessian[KEPT[j]]
    for j in range(COUPLED.size):
        couplings[k, COUPLED_ROWS[j], SLOTS[j]] = hessian[COUPLED[j]]
    for a in range(CONTROLS):
        for b in range(CONTROLS):
            for i in range(TOUCHED.size):
                weighted = couplings[k, a, i] * inverse[a, b]
                for j in range(TOUCHED.size):
                    element[TOUCHED[i], TOUCHED[j]] -= weighted * couplings[k, b, j]


@njit(cache=True, error_model="numpy")
def condense(gradient, controls, reduced):
    """Fill `reduced` with the right-hand side -(g - B' inverse(C) g_u) of the unknowns that stay."""
    _, inverse, couplings = controls
    steps = couplings.shape[0]
    for i in range(NODE):
        reduced[steps * BLOCK + i] = -gradient[steps * STRIDE + i]
    for k in range(steps - 1, -1, -1):
        for i in range(BLOCK):
            reduced[k * BLOCK + i] = -gradient[k * STRIDE + i]
        for a in range(CONTROLS):
            for b in range(CONTROLS):
                weighted = inverse[a, b] * gradient[k * STRIDE + BLOCK + b]
                for i in range(TOUCHED.size):
                    reduced[k * BLOCK + TOUCHED[i]] += couplings[k, a, i] * weighted


@njit(cache=True, error_model="numpy")
def expand(gradient, controls, reduced, step):
    """Fill `step` with what was solved for and the controls' share -inverse(C) (g_u + B d) of every interval."""
    _, inverse, couplings = controls
    steps = couplings.shape[0]
    for i in range(NODE):
        step[steps * STRIDE + i] = reduced[steps * BLOCK + i]
    for k in range(steps):
        for i in range(BLOCK):
            step[k * STRIDE + i] = reduced[k * BLOCK + i]
        for a in range(CONTROLS):
            step[k * STRIDE + BLOCK + a] = 0.0
        for b in range(CONTROLS):
            forcing = gradient[k * STRIDE + BLOCK + b]
            for i in range(TOUCHED.size):
                forcing += couplings[k, b, i] * reduced[k * BLOCK + TOUCHED[i]]
            for a in range(CONTROLS):
                step[k * STRIDE + BLOCK + a] -= inverse[a, b] * forcing
