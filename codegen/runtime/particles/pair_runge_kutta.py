"""One step of an explicit Runge-Kutta method: k_i = F(z0 + h sum_j a_ij k_j), z1 = z0 + h sum_i b_i k_i."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_pairs import POINTS, ROWS, WEIGHTS, hamiltonian_gradient
from codegen.runtime.particles.pair_algebra import copy_state
from codegen.runtime.particles.pair_curvature import linearised_field

NON_FINITE = -1  # what `advance` returns when a state is infinite or not a number


@njit(cache=True, error_model="numpy")
def advance(z, t, h, given, work, after):
    """Fill the state `after` a step from `z`, both of shape (2, n, d); return 0 iterations, or why it failed.

    The first of `work`, shape (POINTS, 2, n, d), takes the points of the step; the second is for implicit steps.
    """
    (parameters, own), points = given, work[0]
    gradients = np.empty((POINTS, *z.shape))
    for s in range(POINTS):
        combined(z, h, gradients, ROWS[s], s, points[s])
        hamiltonian_gradient(points[s], own, parameters, gradients[s])
    combined(z, h, gradients, WEIGHTS, len(WEIGHTS), after)
    return 0 if copy_state(after, gradients[0]) else NON_FINITE


@njit(cache=True, error_model="numpy")
def combined(z, h, gradients, weights, count, result):
    """Fill `result`, shape (2, n, d), with z + h sum_r weights[r] (H_p, -H_q)_r over the first `count` stages."""
    for i in range(z.shape[1]):
        for k in range(z.shape[2]):
            position, momentum = z[0, i, k], z[1, i, k]
            for r in range(count):
                position += h * weights[r] * gradients[r, 1, i, k]
                momentum -= h * weights[r] * gradients[r, 0, i, k]
            result[0, i, k], result[1, i, k] = position, momentum


@njit(cache=True, error_model="numpy")
def advance_directions(curvature, points, first, h, own, parameters, directions, after):
    """Fill `after`, shape (2nd, m), with the derivative of a step times directions; the points begin at `first`."""
    hessians, anew = curvature
    rates, middle = np.empty((POINTS, *directions.shape)), np.empty(directions.shape)
    for s in range(POINTS):
        combined_directions(directions, h, rates, ROWS[s], s, middle)
        linearised_field(hessians, anew, points, first + s, own, parameters, middle, rates[s])
    combined_directions(directions, h, rates, WEIGHTS, len(WEIGHTS), after)
    return True


@njit(cache=True, error_model="numpy")
def combined_directions(directions, h, rates, weights, count, result):
    """Fill `result`, shape (2nd, m), with directions + h sum_r weights[r] rates[r] over the first `count` stages."""
    for row in range(directions.shape[0]):
        for c in range(directions.shape[1]):
            value = directions[row, c]
            for r in range(count):
                value += h * weights[r] * rates[r, row, c]
            result[row, c] = value
