"""One step of an implicit scheme by Newton's method, iterated to rounding level.

Newton's method squares the error, so that after a correction of relative size 1e-13 nothing but rounding is left. The
size of a correction is measured against the sum of the magnitudes of state and unknowns. Corrections are taken in full:
where they do not converge the step is too long for the scheme, and shorter corrections were seen to end in spurious
minima of the residual as often as in a solution.
"""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_step import UNKNOWNS, complete_step, predict_step, step_jacobian
from codegen.runtime.stepping.scalar import factor_matrix, solve_factored

NON_FINITE, SINGULAR, NOT_CONVERGED = -1, -2, -3  # what `advance` returns when there is no solution
LEAST = 1e-300  # added to that sum: below it numbers are so close to the least ones that they have no relative size
ROUNDING = 1e-8  # relative corrections below this are taken for rounding errors once they no longer shrink


@njit(cache=True, error_model="numpy")
def allocate_work(h, parameters):
    """Unknowns, residual, Jacobian and its pivots."""
    return np.empty(UNKNOWNS), np.empty(UNKNOWNS), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS, np.int64)


@njit(cache=True, error_model="numpy")
def advance(state, t, h, parameters, work, interval, tolerance, max_iterations):
    """Fill `interval` with inner stages and the state at the right node; return the iterations, or why it failed."""
    unknowns, residual, jacobian, pivots = work
    predict_step(state, t, h, parameters, unknowns)
    magnitude, previous = LEAST, np.inf
    for i in range(state.size):
        magnitude += abs(state[i])
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
        correction, scale = 0.0, magnitude
        for i in range(UNKNOWNS):
            unknowns[i] -= residual[i]
            correction += abs(residual[i])
            scale += abs(unknowns[i])
        stagnates = correction <= ROUNDING * scale and correction >= 0.5 * previous
        if correction <= tolerance * scale or stagnates:
            complete_step(unknowns, state, t, h, parameters, interval)
            return iteration
        previous = correction
    return NOT_CONVERGED
