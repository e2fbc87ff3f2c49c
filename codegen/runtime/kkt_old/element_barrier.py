"""An interval's element matrix, with controls and slacks of the interval eliminated.

Barrier terms make the block C of these unknowns different on every interval. Eliminating them leaves, in the remaining
unknowns of the element, K - B' inverse(C) B, with B the coupling block.
"""

import numpy as np
from numba import njit

from codegen.runtime.kkt.static_condensation import ENTRIES, scatter, subtract_schur_complement
from codegen.runtime.kkt.elements import BLOCK, WIDTH
from codegen.runtime.stand_ins.example import BODIES, CONDENSED, STRIDE
from codegen.runtime.kkt.inverse import invert_positive_definite

INSIDE, INSIDE_ROWS, INSIDE_COLUMNS = ENTRIES[2]


def allocate_condensed(grid):
    """`inverses` (BODIES, N + 1, CONDENSED, CONDENSED), k's at k + 1, and `couplings` (BODIES, N, CONDENSED, WIDTH)."""
    return (
        np.zeros((BODIES, grid.steps + 1, CONDENSED, CONDENSED)),
        np.zeros((BODIES, grid.steps, CONDENSED, WIDTH)),
    )


@njit(error_model="numpy", inline="always")
def prepare_condensed(h, nodes, parameters, weight, parts, diagonal, inverses):
    """True: blocks are inverted interval by interval; arrays as in `eliminate_body`."""
    return True


@njit(error_model="numpy", inline="always")
def add_element(hessian, diagonal, gradient, inverses, couplings, k, element):
    """Add K - B' inverse(C) B of interval k to the element matrix; False when C is not positive definite.

    `diagonal` and `gradient` (N STRIDE + NODE,), `inverses` and `couplings` are those of the body, kept for the
    recovery; `hessian` (HESSIAN_ROWS.size,), `element` (ROWS, WIDTH).
    """
    block = inverses[k + 1]
    scatter(hessian, gradient, k, element, couplings[k])
    for a in range(CONDENSED):
        for b in range(CONDENSED):
            block[a, b] = 0.0
        block[a, a] = diagonal[k * STRIDE + BLOCK + a]
    for j in range(INSIDE.size):
        block[INSIDE_ROWS[j], INSIDE_COLUMNS[j]] += hessian[INSIDE[j]]
        if INSIDE_ROWS[j] != INSIDE_COLUMNS[j]:
            block[INSIDE_COLUMNS[j], INSIDE_ROWS[j]] += hessian[INSIDE[j]]
    if not invert_positive_definite(block, CONDENSED):
        return False
    subtract_schur_complement(couplings[k], block, element)
    return True
