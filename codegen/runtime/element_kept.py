"""An interval's element matrix, with all its unknowns kept: none can be eliminated beforehand."""

import numpy as np
from numba import njit

from codegen.runtime.elements import BORDER, TAIL
from codegen.runtime.example import BODIES, HESSIAN_COLUMNS, HESSIAN_ROWS, NODE, STRIDE

PLACE_ROWS = np.where(HESSIAN_ROWS < TAIL - BORDER, HESSIAN_ROWS, HESSIAN_ROWS + BORDER)
PLACE_COLUMNS = np.where(HESSIAN_COLUMNS < TAIL - BORDER, HESSIAN_COLUMNS, HESSIAN_COLUMNS + BORDER)


def allocate_condensed(grid):
    """Storage for eliminated unknowns: none."""
    return np.empty(0)


@njit(error_model="numpy", inline="always")
def condensed_parts(storage, steps):
    """Views of the storage: none."""
    return ()


@njit(error_model="numpy", inline="always")
def prepare_condensed(weight, diagonal, condensed):
    """True: there is no block that could be indefinite."""
    return True


@njit(error_model="numpy", inline="always")
def add_element(hessian, diagonal, gradient, condensed, interval, element):
    """Add the Hessian of an interval to the element matrix."""
    for j in range(hessian.size):
        row, column = PLACE_ROWS[j], PLACE_COLUMNS[j]
        element[row, column] += hessian[j]
        if row != column:
            element[column, row] += hessian[j]
    return True


@njit(error_model="numpy")
def condense(gradient, condensed, steps, reduced, root):
    """Fill the right-hand sides of every body with -gradient; `root` has been set already."""
    for body in range(BODIES):
        for i in range(steps * STRIDE + NODE):
            reduced[body, i] = -gradient[body * (steps * STRIDE + NODE) + i]


@njit(error_model="numpy")
def expand(gradient, condensed, steps, reduced, root, step):
    """Fill `step` with what was solved for, which is all there is."""
    for body in range(BODIES):
        for i in range(steps * STRIDE + NODE):
            step[body * (steps * STRIDE + NODE) + i] = reduced[body, i]
