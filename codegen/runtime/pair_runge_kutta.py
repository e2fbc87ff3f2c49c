"""One step of an explicit Runge-Kutta method: k_i = F(z0 + h sum_j a_ij k_j), z1 = z0 + h sum_i b_i k_i."""

import numpy as np
from numba import njit

from codegen.runtime.example_pairs import POINTS, ROWS, WEIGHTS, hamiltonian_gradient
from codegen.runtime.pair_curvature import field, linearised_field

NON_FINITE = -1  # what `advance` returns when a state is infinite or not a number


@njit(cache=True, error_model="numpy")
def advance(z, h, own, parameters, points, after):
    """Fill `points`, shape (POINTS, 2, n, d), and the state `after` a step; return 0, or why it failed."""
    gradient, rates = np.empty(z.shape), np.empty((POINTS, *z.shape))
    after[:] = z
    for s in range(POINTS):
        points[s] = z
        for r in range(s):
            if ROWS[s][r] != 0.0:
                points[s] += h * ROWS[s][r] * rates[r]
        hamiltonian_gradient(points[s], own, parameters, gradient)
        field(z, own, parameters, gradient, rates[s])
        after += h * WEIGHTS[s] * rates[s]
    return 0 if np.isfinite(np.abs(after).sum()) else NON_FINITE


@njit(cache=True, error_model="numpy")
def advance_directions(hessians, points, first, h, own, parameters, directions, after):
    """Fill `after`, shape (2nd, m), with the derivative of a step times directions; the points begin at `first`."""
    products, middle = np.empty(directions.shape), np.empty(directions.shape)
    rates = np.empty((POINTS, *directions.shape))
    after[:] = directions
    for s in range(POINTS):
        middle[:] = directions
        for r in range(s):
            if ROWS[s][r] != 0.0:
                middle += h * ROWS[s][r] * rates[r]
        linearised_field(hessians, points, first + s, own, parameters, middle, products, rates[s])
        after += h * WEIGHTS[s] * rates[s]
    return True
