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


@njit(cache=True, error_model="numpy")
def measure_step(unknowns, gradient, step, is_multiplier):
    """Slope of the cost along a Newton step, and whether the step promises a descent.

    With W the Hessian as it was factored, A the Jacobian of the equations, d the primal and m the multipliers' part
    of the step, the step's own equations W d + A' m = -gradient and A d = -residual give d' W d and the derivative of
    the cost along d without another product with a matrix. The promise is the inertia-free test of Chiang and Zavala.
    """
    slope, curvature, linear, square = 0.0, 0.0, 0.0, 0.0
    for i in range(step.size):
        if is_multiplier[i]:
            slope += gradient[i] * unknowns[i]
            curvature += gradient[i] * step[i]
            linear -= gradient[i] * (unknowns[i] + step[i])
        else:
            slope += gradient[i] * step[i]
            curvature -= gradient[i] * step[i]
            square += step[i] * step[i]
    return slope, curvature + max(linear, 0.0) >= 1e-10 * square
