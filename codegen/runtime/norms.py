"""Sums over all unknowns that Newton's method needs at every iterate."""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def measure(gradient, is_multiplier):
    """Max-norm and sum of the residual of the discrete equations, and max-norm of the stationarity.

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


def measure_step(unknowns, gradient, step, is_multiplier):
    """Slope of the cost along a Newton step, and whether the step promises a descent.

    With W the Hessian as it was factored, A the Jacobian of the equations, d the primal and m the multipliers' part
    of the step, the step's own equations W d + A' m = -gradient and A d = -residual give d' W d and the derivative of
    the cost along d without another product with a matrix. The promise is the inertia-free test of Chiang and Zavala.
    """
    slope = gradient @ np.where(is_multiplier, unknowns, step)
    curvature = gradient @ np.where(is_multiplier, step, -step)
    linear = -(gradient @ np.where(is_multiplier, unknowns + step, 0.0))
    primal = np.where(is_multiplier, 0.0, step)
    return slope, curvature + max(linear, 0.0) >= 1e-10 * (primal @ primal)
