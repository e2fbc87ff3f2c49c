"""One step of an implicit scheme by Newton's method, whose first correction is exact where equations are linear."""

import numpy as np
from numba import njit

from codegen.runtime.lu import factor_matrix, solve_factored
from codegen.runtime.stand_ins.example_step import (
    CONSTANT,
    ITERATED,
    STATE,
    SYSTEM,
    UNKNOWNS,
    complete_step,
    predict_step,
    step_jacobian,
    step_residual,
)

SINGULAR = -2  # what `advance` returns when a linear system has no unique solution
if ITERATED:
    NON_FINITE, NOT_CONVERGED = -1, -3  # what it returns when Newton's method finds none
    LEAST = 1e-300  # numbers below it are so close to the least ones that they have no relative size
    ROUNDING = 1e-8  # corrections below this part of all unknowns are rounding errors once they no longer shrink


@njit(cache=True, error_model="numpy")
def allocate_work(h, given):
    """Unknowns and residual, shape (UNKNOWNS,), Jacobian and pivots; to iterate, sizes and last corrections as well."""
    unknowns, residual = np.zeros(UNKNOWNS), np.empty(UNKNOWNS)
    jacobian, pivots = np.empty((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS, np.int64)
    if CONSTANT:
        step_jacobian(unknowns, np.zeros(STATE), 0.0, h, given[0], residual, jacobian)
        if SYSTEM and factor_matrix(jacobian, pivots) >= 0:
            pivots[0] = -1
    if ITERATED:
        return unknowns, residual, jacobian, pivots, np.zeros(UNKNOWNS), np.empty(UNKNOWNS)
    else:
        return unknowns, residual, jacobian, pivots


@njit(cache=True, error_model="numpy")
def advance(state, t, h, given, work, interval):
    """Fill `interval`, shape (STAGES + STATE,), with inner stages and the state at the right node.

    `state` has shape (STATE,). Return the iterations, or why there is no solution.
    """
    parameters, (unknowns, residual, jacobian, pivots) = given[0], work[:4]
    predict_step(state, t, h, parameters, unknowns)
    if ITERATED:
        # Corrections are taken in full: where they do not converge the step is too long for the scheme, and shorter
        # corrections were seen to end in spurious minima of the residual as often as in a solution.
        (tolerance, max_iterations), (sizes, last), magnitude = given[1:], work[4:], 0.0
        for i in range(STATE):
            magnitude += abs(state[i])
        for i in range(UNKNOWNS):
            sizes[i], last[i] = max(0.5 * sizes[i], LEAST), np.inf
        for iteration in range(1, max_iterations + 1):
            outcome = correct(state, t, h, parameters, unknowns, residual, jacobian, pivots)
            if outcome < 0:
                return outcome
            scale = magnitude
            for i in range(UNKNOWNS):
                scale += abs(unknowns[i])
            if has_converged(unknowns, residual, tolerance, ROUNDING * scale, sizes, last):
                complete_step(unknowns, state, t, h, parameters, interval)
                return iteration
        return NOT_CONVERGED
    else:
        outcome = correct(state, t, h, parameters, unknowns, residual, jacobian, pivots)
        if outcome > 0:
            complete_step(unknowns, state, t, h, parameters, interval)
        return outcome


@njit(error_model="numpy", forceinline=True)
def correct(state, t, h, parameters, unknowns, residual, jacobian, pivots):
    """Make a Newton correction, which `residual` holds afterwards; return 1, or why there is none.

    `state` has shape (STATE,), the other arrays those of `allocate_work`; `jacobian` then holds factors.
    """
    if CONSTANT:
        step_residual(unknowns, state, t, h, parameters, residual)
    else:
        step_jacobian(unknowns, state, t, h, parameters, residual, jacobian)
    if ITERATED:
        total = 0.0
        for i in range(UNKNOWNS):
            total += abs(residual[i])
        if not total < np.inf:
            return NON_FINITE
    if SYSTEM:
        if CONSTANT:  # noqa: SIM108  decided when a module is made
            is_singular = pivots[0] < 0
        else:
            is_singular = factor_matrix(jacobian, pivots) >= 0
        if is_singular:
            return SINGULAR
        solve_factored(jacobian, pivots, residual)
    else:
        if not abs(jacobian[0, 0]) > 0.0:
            return SINGULAR
        residual[0] /= jacobian[0, 0]
    for i in range(UNKNOWNS):
        unknowns[i] -= residual[i]
    return 1


if ITERATED:

    @njit(error_model="numpy")
    def has_converged(unknowns, corrections, tolerance, rounding, sizes, last):
        """Whether each correction, shape (UNKNOWNS,), is small, or a rounding error that has stopped to shrink.

        Newton's method squares the error, so that after a correction of relative size 1e-13 nothing but rounding is
        left. Each is measured against its unknown's own size, which that may have had a few steps ago: a sum over
        unknowns would depend on their units. `sizes` and `last` take what the next call has to know.
        """
        settled = True
        for i in range(UNKNOWNS):
            change = abs(corrections[i])
            sizes[i] = max(sizes[i], abs(unknowns[i]))
            stagnates = change <= rounding and change >= 0.5 * last[i]
            settled = settled and (stagnates or change <= tolerance * sizes[i])
            last[i] = 0.0 if stagnates else change
        return settled
