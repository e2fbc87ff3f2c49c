"""An interval's element matrix, with all its unknowns kept: none can be eliminated beforehand."""

import numpy as np
from numba import njit

from codegen.runtime.kkt.elements import BORDER, TAIL
from codegen.runtime.stand_ins.example import BODIES, HESSIAN_COLUMNS, HESSIAN_ROWS

# Indices without a sign need no test for what counts from the end.
ELEMENT_ROWS = np.where(HESSIAN_ROWS < TAIL - BORDER, HESSIAN_ROWS, HESSIAN_ROWS + BORDER).astype(np.uint64)
ELEMENT_COLUMNS = np.where(HESSIAN_COLUMNS < TAIL - BORDER, HESSIAN_COLUMNS, HESSIAN_COLUMNS + BORDER).astype(np.uint64)


def allocate_condensed(grid):
    """`inverses` and `couplings` of eliminated unknowns: there are none."""
    return np.zeros((BODIES, 0, 0, 0)), np.zeros((BODIES, 0, 0, 0))


@njit(error_model="numpy", inline="always")
def prepare_condensed(weight, parts, diagonal, inverses):
    """True: there is no block that could be indefinite."""
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
    for i in range(gradient.size):
        right[i] = -gradient[i]


@njit(error_model="numpy")
def recover_condensed(gradient, inverses, couplings, steps, solved, step):
    """Fill a body's `step` (N STRIDE + NODE,) with what was `solved` for, which is all there is."""
    for i in range(step.size):
        step[i] = solved[i]
