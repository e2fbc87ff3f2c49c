"""An interval's element matrix, with all its unknowns kept: none can be eliminated beforehand."""

import numpy as np
from numba import njit

from codegen.runtime.kkt.elements import BLOCK, LEFT_NODE, RIGHT_NODE, ROWS, TAIL, unknown_of
from codegen.runtime.stand_ins.example import BODIES, HESSIAN_COLUMNS, HESSIAN_ROWS, NODE

# Rows of an element matrix for its unknowns; indices without a sign need no test for what counts from the end.
PLACES = np.concatenate(
    [LEFT_NODE + np.arange(NODE), np.arange(NODE, BLOCK), RIGHT_NODE + np.arange(NODE), np.arange(TAIL, ROWS)]
).astype(np.uint64)
ELEMENT_ROWS, ELEMENT_COLUMNS = PLACES[HESSIAN_ROWS], PLACES[HESSIAN_COLUMNS]


def allocate_condensed(grid):
    """`inverses` and `couplings` of eliminated unknowns: there are none."""
    return np.zeros((BODIES, 0, 0, 0)), np.zeros((BODIES, 0, 0, 0))


@njit(error_model="numpy", inline="always")
def prepare_condensed(h, nodes, parameters, weight, parts, diagonal, inverses):
    """True: there is no block that could be indefinite; arrays as in `eliminate_body`."""
    return True


@njit(error_model="numpy", inline="always")
def add_element(hessian, diagonal, gradient, inverses, couplings, k, element):
    """Put an interval's `hessian` (HESSIAN_ROWS.size,) into `element` (ROWS, WIDTH), which is zero elsewhere."""
    for j in range(ELEMENT_ROWS.size):
        element[ELEMENT_ROWS[j], ELEMENT_COLUMNS[j]] = element[ELEMENT_COLUMNS[j], ELEMENT_ROWS[j]] = hessian[j]
    return True


@njit(error_model="numpy")
def condense(gradient, inverses, couplings, steps, right):
    """Fill a body's `right` (N STRIDE + NODE + SHARED,) with -`gradient` (N STRIDE + NODE,)."""
    for block in range(steps + 1):
        for i in range(BLOCK if block < steps else NODE):
            right[block * BLOCK + i] = -gradient[unknown_of(block, i, steps)]


@njit(error_model="numpy")
def recover_condensed(gradient, inverses, couplings, steps, solved, step):
    """Fill a body's `step` (N STRIDE + NODE,) with what was `solved` for, which is all there is."""
    for block in range(steps + 1):
        for i in range(BLOCK if block < steps else NODE):
            step[unknown_of(block, i, steps)] = solved[block * BLOCK + i]
