"""One step of an implicit scheme by Newton's method, iterated to rounding level.

Newton's method squares the error, so that after a correction of relative size 1e-13 nothing but rounding is left. The
correction of each unknown is measured against its own size, which it may have had a few steps ago: a sum over unknowns
would depend on their units. Corrections are taken in full: where they do not converge the step is too long for the
scheme, and shorter corrections were seen to end in spurious minima of the residual as often as in a solution.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_step import UNKNOWNS, complete_step, predict_step, step_jacobian
from codegen.runtime.stepping.scalar import factor_matrix, solve_factored

NON_FINITE, SINGULAR, NOT_CONVERGED = -1, -2, -3  # what `advance` returns when there is no solution
LEAST = 1e-300  # numbers below it are so close to the least ones that they have no relative size
ROUNDING = 1e-8  # corrections below this part of all unknowns are taken for rounding errors once they no longer shrink


@njit(cache=True, error_model="numpy")
def allocate_work(h, parameters):
    """Unknowns, residual, Jacobian and its pivots, sizes and last corrections of unknowns."""
    matrix, pivots = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS, np.int64)
    return np.empty(UNKNOWNS), np.empty(UNKNOWNS), matrix, pivots, np.zeros(UNKNOWNS), np.empty(UNKNOWNS)


@njit(cache=True, error_model="numpy")
def advance(state, t, h, parameters, work, interval, tolerance, max_iterations):
    """Fill `interval` with inner stages and the state at the right node; return the iterations, or why it failed."""
    unknowns, residual, jacobian, pivots, sizes, last = work
    predict_step(state, t, h, parameters, unknowns)
    magnitude = 0.0
    for i in range(state.size):
        magnitude += abs(state[i])
    for i in range(UNKNOWNS):
        sizes[i], last[i] = max(0.5 * sizes[i], LEAST), np.inf
    for iteration in range(1, max_iterations + 1):
        step_jacobian(unknowns, state, t, h, parameters, residual, jacobian)
        total = 0.0
        for i in range(UNKNOWNS):
            total += abs(residual[i])
        if not total < np.inf:
            return NON_FINITE
        if factor_matrix(jacobian, pivots) >= 0:
            return SINGULAR
        solve_factored(jacobian, pivots, residual)
        scale = magnitude
        for i in range(UNKNOWNS):
            unknowns[i] -= residual[i]
            scale += abs(unknowns[i])
        if has_converged(unknowns, residual, tolerance, ROUNDING * scale, sizes, last):
            complete_step(unknowns, state, t, h, parameters, interval)
            return iteration
    return NOT_CONVERGED


@njit(error_model="numpy")
def has_converged(unknowns, corrections, tolerance, rounding, sizes, last):
    """Whether each correction is small, or a rounding error that has stopped to shrink; note sizes and corrections."""
    settled = True
    for i in range(UNKNOWNS):
        change = abs(corrections[i])
        sizes[i] = max(sizes[i], abs(unknowns[i]))
        stagnates = change <= rounding and change >= 0.5 * last[i]
        settled = settled and (stagnates or change <= tolerance * sizes[i])
        last[i] = 0.0 if stagnates else change
    return settled
