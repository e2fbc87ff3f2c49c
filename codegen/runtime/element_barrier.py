"""An interval's element matrix, with controls and slacks of the interval eliminated.

Barrier terms make the block C of these unknowns different on every interval. Eliminating them leaves, in the remaining
unknowns of the element, K - B' inverse(C) B, with B the coupling block.
"""

import numpy as np
from numba import njit

from codegen.runtime.condensation import (
    INSIDE,
    INSIDE_COLUMNS,
    INSIDE_ROWS,
    invert_positive_definite,
    scatter,
    subtract_condensed,
)
from codegen.runtime.elements import BLOCK, WIDTH
from codegen.runtime.example import BODIES, CONDENSED


def allocate_condensed(grid):
    """Room for one block C, and for the inverse of C and B of all intervals of all bodies."""
    return np.zeros(CONDENSED**2 + BODIES * grid.steps * CONDENSED * (CONDENSED + WIDTH))


@njit(error_model="numpy", inline="always")
def condensed_parts(storage, steps):
    """One block C, the inverse of C, and B of all intervals of all bodies."""
    size, intervals = CONDENSED * CONDENSED, BODIES * steps
    inverses, couplings = storage[size : size + intervals * size], storage[size + intervals * size :]
    return (
        storage[:size].reshape((CONDENSED, CONDENSED)),
        inverses.reshape((intervals, CONDENSED, CONDENSED)),
        couplings.reshape((intervals, CONDENSED, WIDTH)),
    )


@njit(error_model="numpy", inline="always")
def prepare_condensed(weight, diagonal, condensed):
    """True: blocks are inverted interval by interval."""
    return True


@njit(error_model="numpy", inline="always")
def add_element(hessian, diagonal, gradient, condensed, interval, element):
    """Add K - B' inverse(C) B of an interval to the element matrix; False when C is not positive definite.

    `diagonal` and `gradient` are those of the interval's node and interval unknowns; inverse(C) and B are kept for the
    recovery.
    """
    block, inverses, couplings = condensed
    scatter(hessian, gradient, element, couplings[interval])
    for a in range(CONDENSED):
        for b in range(CONDENSED):
            block[a, b] = 0.0
        block[a, a] = diagonal[BLOCK + a]
    for j in range(INSIDE.size):
        block[INSIDE_ROWS[j], INSIDE_COLUMNS[j]] += hessian[INSIDE[j]]
        if INSIDE_ROWS[j] != INSIDE_COLUMNS[j]:
            block[INSIDE_COLUMNS[j], INSIDE_ROWS[j]] += hessian[INSIDE[j]]
    if not invert_positive_definite(block, inverses[interval]):
        return False
    subtract_condensed(couplings[interval], inverses[interval], element)
    return True
