"""Broyden's method on the initial momenta: every iteration costs one trajectory and no derivative.

The first approximation of the derivative is duration times H_pp at the start, which differs from it by what the motion
adds; each step corrects that by a matrix of rank one. Where the residual no longer falls, Newton's method takes over.
Source: Kelley (1995), Iterative methods for linear and nonlinear equations, section 7.3 (the inverse as a product).
"""

import numpy as np
from numba import njit

from codegen.runtime.particles.pair_algebra import largest, solve_cholesky
from codegen.runtime.particles.trajectory import follow

BROYDEN_STEPS = 40  # iterations, each of which keeps two vectors
PATIENCE = 6  # iterations after which the residual must have halved
ENOUGH = 1e-4  # relative accuracy of implicit steps, as a part of that of the arrival before


@njit(error_model="numpy")
def fill_end_residual(state, target, sigma, residual):
    """Fill `residual`, shape (nd,), with q_N + sigma^2 p_N - target; return its largest entry and its 2-norm."""
    size, total, k = 0.0, 0.0, 0
    for i in range(target.shape[0]):
        for a in range(target.shape[1]):
            value = state[0, i, a] + sigma[i] * sigma[i] * state[1, i, a] - target[i, a]
            residual[k] = value
            size, total, k = max(size, abs(value)), total + value * value, k + 1
    return size, np.sqrt(total)


@njit(error_model="numpy")
def approximate_inverse(factor, left, right, values, change):
    """Fill `change`, shape (nd,), with the approximate inverse of the derivative times `values`.

    A row of `left` and `right`, shape (steps, nd), is the correction by a step.
    """
    for k in range(values.size):
        change[k] = values[k]
    solve_cholesky(factor, change.reshape((factor.shape[0], values.size // factor.shape[0])))
    for c in range(left.shape[0]):
        product = 0.0
        for k in range(values.size):
            product += right[c, k] * change[k]
        for k in range(values.size):
            change[k] += left[c, k] * product


@njit(cache=True, error_model="numpy", nogil=True)
def broyden_steps(pairs, h, own, parameters, target, sigma, factor, tolerance, path, points):
    """Improve path[0, 1], shape (n, d), as long as the residual falls; return how many steps were made.

    `path` and `points` belong to the best momenta at the end, whose residual the caller has to look at.
    """
    size = target.size
    left, right = np.empty((BROYDEN_STEPS, size)), np.empty((BROYDEN_STEPS, size))
    step, change, residual = np.empty(size), np.empty(size), np.empty(size)
    momenta = path[0, 1].reshape(size)
    kept = momenta.copy()
    error, norm = fill_end_residual(path[-1], target, sigma, residual)
    scale = max(largest(target.reshape(size)), 1e-300)
    start, best, halved, waited, made, is_kept = norm, norm, norm, 0, 0, True
    approximate_inverse(factor, left[:made], right[:made], residual, step)
    while made < BROYDEN_STEPS and error > tolerance and waited < PATIENCE:
        for k in range(size):
            step[k] = -step[k]
            momenta[k] += step[k]
        made, waited, is_kept = made + 1, waited + 1, False
        if follow(pairs, h, own, parameters, path, points, max(ENOUGH * error / scale, 1e-15)) < 0:
            break
        error, norm = fill_end_residual(path[-1], target, sigma, residual)
        if not norm <= 2.0 * start:
            break
        if norm < best:
            best, kept, is_kept = norm, momenta.copy(), True
        if norm < 0.5 * halved:
            halved, waited = norm, 0
        approximate_inverse(factor, left[: made - 1], right[: made - 1], residual, change)
        along = 0.0
        for k in range(size):
            along += step[k] * (step[k] + change[k])
        if not abs(along) > 0.0:
            break
        product = 0.0
        for k in range(size):
            left[made - 1, k], right[made - 1, k] = -change[k] / along, step[k]
            product += step[k] * change[k]
        for k in range(size):
            step[k] = change[k] * (1.0 - product / along)
    if not is_kept:
        for k in range(size):  # an assignment of arrays has numba compile text for errors: a tenth of all time
            momenta[k] = kept[k]
        follow(pairs, h, own, parameters, path, points, 0.0)
    return made
