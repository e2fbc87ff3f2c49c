"""Sums over all unknowns that Newton's method needs at every iterate."""

import numpy as np
from numba import njit


@njit(error_model="numpy")
def measure(gradient, is_multiplier):
    """Max-norm and sum of the residual of the equations, and max-norm of the stationarity, from `gradient` (n,).

    All are infinite when an entry is infinite or NaN.
    """
    largest_residual, total_residual, stationarity = 0.0, 0.0, 0.0
    for i in range(gradient.size):
        value = abs(gradient[i])
        if not value < np.inf:
            return np.inf, np.inf, np.inf
        if is_multiplier[i]:
            total_residual += value
            if value > largest_residual:
                largest_residual = value
        elif value > stationarity:
            stationarity = value
    return largest_residual, total_residual, stationarity
