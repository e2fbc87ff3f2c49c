"""One step of an implicit scheme whose equations are linear with a constant matrix, which is factored once."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_step import (
    STATE,
    UNKNOWNS,
    complete_step,
    predict_step,
    step_jacobian,
    step_residual,
)
from codegen.runtime.stepping.scalar import factor_matrix, solve_factored

SINGULAR = -2  # what `advance` returns when the linear system has no unique solution


@njit(cache=True, error_model="numpy")
def allocate_work(h, parameters):
    """Unknowns, residual, factored Jacobian and its pivots, the first of which is -1 when it is singular."""
    unknowns, residual = np.zeros(UNKNOWNS), np.empty(UNKNOWNS)
    jacobian, pivots = np.empty((UNKNOWNS, UNKNOWNS)), np.zeros(UNKNOWNS, np.int64)
    step_jacobian(unknowns, np.zeros(STATE), 0.0, h, parameters, residual, jacobian)
    if factor_matrix(jacobian, pivots) >= 0:
        pivots[0] = -1
    return unknowns, residual, jacobian, pivots


@njit(cache=True, error_model="numpy")
def advance(state, t, h, parameters, work, interval, tolerance, max_iterations):
    """Fill `interval` with inner stages and the state at the right node; return 1, or SINGULAR."""
    unknowns, residual, jacobian, pivots = work
    if pivots[0] < 0:
        return SINGULAR
    predict_step(state, t, h, parameters, unknowns)
    step_residual(unknowns, state, t, h, parameters, residual)
    solve_factored(jacobian, pivots, residual)
    for i in range(UNKNOWNS):
        unknowns[i] -= residual[i]
    complete_step(unknowns, state, t, h, parameters, interval)
    return 1
