"""The smallest residual that floating-point numbers can be expected to reach."""

import numpy as np
from numba import njit

from codegen.runtime.example import ELEMENT, HESSIAN_COLUMNS, HESSIAN_ROWS, STRIDE, interval_hessian


@njit(cache=True, error_model="numpy")
def rounding_level(unknowns, steps, h, parameters):
    """Largest error of a residual when every unknown is off by half a unit in the last place: eps max_i |K| |x|.

    Source: Higham (2002), Accuracy and stability of numerical algorithms, section 7.2.
    """
    local, hessian = np.empty(ELEMENT), np.empty(HESSIAN_ROWS.size)
    sums = np.zeros(unknowns.size)
    for k in range(steps):
        first = k * STRIDE
        interval_hessian(unknowns[first : first + ELEMENT], k * h, h, parameters, local, hessian)
        for j in range(HESSIAN_ROWS.size):
            row, column = first + HESSIAN_ROWS[j], first + HESSIAN_COLUMNS[j]
            sums[row] += abs(hessian[j] * unknowns[column])
            if row != column:
                sums[column] += abs(hessian[j] * unknowns[row])
    largest = 0.0
    for i in range(sums.size):
        largest = max(largest, sums[i])
    return 2.2e-16 * largest
