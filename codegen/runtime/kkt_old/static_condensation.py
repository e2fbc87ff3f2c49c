"""Static condensation of unknowns inside an interval: entries, Schur complement, right-hand sides, recovery."""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.kkt.elements import (
    BLOCK, COLUMNS, LEFT_NODE, RIGHT, RIGHT_NODE, ROWS, SIZE, TAIL, interval_of, unknown_of,
)  # fmt: skip
from codegen.runtime.stand_ins.example import (
    CARRIED, CONDENSED, ELEMENT, HESSIAN_COLUMNS, HESSIAN_ROWS, NODE, SHARED, STRIDE,
)  # fmt: skip
from codegen.runtime.kkt.symmetric import subtract_row


def sort_entries():
    """Sort the entries of an interval's Hessian by how many of their two unknowns are eliminated: none, one or both.

    Each kind is a list of arrays (index in the list of entries, row, column); rows and columns are those of the
    element matrix, or counted among the unknowns that are eliminated.
    """
    eliminated = (np.arange(ELEMENT + SHARED) >= BLOCK) & (np.arange(ELEMENT + SHARED) < STRIDE)
    left, right, kept = LEFT_NODE + np.arange(NODE), RIGHT_NODE + np.arange(NODE), np.arange(NODE, BLOCK)
    index = np.concatenate([left, kept, np.arange(CONDENSED), right, np.arange(TAIL, ROWS)])
    kinds = eliminated[HESSIAN_ROWS].astype(int) + eliminated[HESSIAN_COLUMNS]
    swapped = eliminated[HESSIAN_COLUMNS] & ~eliminated[HESSIAN_ROWS]
    rows = index[np.where(swapped, HESSIAN_COLUMNS, HESSIAN_ROWS)]
    columns = index[np.where(swapped, HESSIAN_ROWS, HESSIAN_COLUMNS)]
    # Indices without a sign need no test for what counts from the end.
    tables = [table.astype(np.uint64) for table in (np.arange(kinds.size), rows, columns)]
    return [[table[kinds == n] for table in tables] for n in range(3)]


ENTRIES = sort_entries()
(KEPT, KEPT_ROWS, KEPT_COLUMNS), (COUPLED, COUPLED_ROWS, COUPLED_COLUMNS) = ENTRIES[:2]
TOUCHED = np.unique(COUPLED_COLUMNS)  # unknowns whose rows the elimination changes


@njit(error_model="numpy", inline="always")
def scatter(hessian, gradient, k, element, coupling):
    """Put second derivatives by unknowns that stay into the element matrix, and the mixed ones into `coupling`.

    `hessian` (HESSIAN_ROWS.size,), `element` (ROWS, WIDTH), `coupling` (CONDENSED, WIDTH), where the right-hand side,
    too, is a column if it is carried along: minus what the body's `gradient` has for those that interval k eliminates.
    """
    for j in range(KEPT.size):
        element[KEPT_ROWS[j], KEPT_COLUMNS[j]] = element[KEPT_COLUMNS[j], KEPT_ROWS[j]] = hessian[KEPT[j]]
    for j in range(COUPLED.size):
        coupling[COUPLED_ROWS[j], COUPLED_COLUMNS[j]] = hessian[COUPLED[j]]
    if CARRIED:
        for a in range(CONDENSED):
            coupling[a, RIGHT] = -gradient[k * STRIDE + BLOCK + a]


@njit(error_model="numpy", inline="always")
def subtract_schur_complement(coupling, inverse, element):
    """Subtract B' inverse(C) B from `element` (ROWS, WIDTH), which leaves the Schur complement.

    B, `coupling` (CONDENSED, WIDTH), has its columns.
    """
    for i in TOUCHED:
        for a in range(CONDENSED):
            weighted = 0.0
            for b in range(CONDENSED):
                weighted += inverse[a, b] * coupling[b, i]
            subtract_row(weighted, coupling, a, COLUMNS, element, i)


@njit(error_model="numpy")
def condense(gradient, inverses, couplings, steps, right):
    """Fill a body's `right` (N BLOCK + NODE + SHARED,), -(g - B' inverse(C) g_u); `gradient` (N STRIDE + NODE,)."""
    for i in range(NODE):
        right[steps * BLOCK + i] = -gradient[unknown_of(steps, i, steps)]
    for block in range(steps - 1, -1, -1):
        k = interval_of(block, steps)
        inverse = inverses[min(k + 1, inverses.shape[0] - 1)]
        for i in range(BLOCK):
            right[block * BLOCK + i] = -gradient[unknown_of(block, i, steps)]
        for a in range(CONDENSED):
            weighted = 0.0
            for b in range(CONDENSED):
                weighted += inverse[a, b] * gradient[k * STRIDE + BLOCK + b]
            for i in range(SIZE):
                right[block * BLOCK + i] += couplings[k, a, i] * weighted
            for i in range(SHARED):
                right[steps * BLOCK + NODE + i] += couplings[k, a, TAIL + i] * weighted


@njit(error_model="numpy")
def recover_condensed(gradient, inverses, couplings, steps, solved, step):
    """Fill a body's `step` (N STRIDE + NODE,) with `solved`, like `right`, and -inverse(C) (g_u + B d) of intervals."""
    forcing = zero_vector(CONDENSED)
    for i in range(NODE):
        step[unknown_of(steps, i, steps)] = solved[steps * BLOCK + i]
    for block in range(steps):
        k = interval_of(block, steps)
        inverse = inverses[min(k + 1, inverses.shape[0] - 1)]
        for i in range(BLOCK):
            step[unknown_of(block, i, steps)] = solved[block * BLOCK + i]
        for b in range(CONDENSED):
            forcing[b] = gradient[k * STRIDE + BLOCK + b]
            for i in range(SIZE):
                forcing[b] += couplings[k, b, i] * solved[block * BLOCK + i]
            for i in range(SHARED):
                forcing[b] += couplings[k, b, TAIL + i] * solved[steps * BLOCK + NODE + i]
        for a in range(CONDENSED):
            value = 0.0
            for b in range(CONDENSED):
                value -= inverse[a, b] * forcing[b]
            step[k * STRIDE + BLOCK + a] = value
