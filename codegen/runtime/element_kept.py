"""An interval's element matrix, with all its unknowns kept: no control can be eliminated beforehand."""

import numpy as np
from numba import njit

from codegen.runtime.example import HESSIAN_COLUMNS, HESSIAN_ROWS


def allocate_controls(grid):
    """Storage for eliminated controls: none."""
    return ()


def prepare_controls(weight, shift, controls):
    """True: there is no block of controls that could be indefinite."""
    return True


@njit(error_model="numpy")
def add_element(hessian, controls, k, element):
    """Add the Hessian of interval k to the element matrix."""
    for j in range(hessian.size):
        row, column = HESSIAN_ROWS[j], HESSIAN_COLUMNS[j]
        element[row, column] += hessian[j]
        if row != column:
            element[column, row] += hessian[j]


def condense(gradient, controls, reduced):
    """The right-hand side -gradient."""
    np.negative(gradient, out=reduced[: gradient.size])


def expand(gradient, controls, reduced, step):
    """The step, which is all there is."""
    step[:] = reduced[: step.size]
