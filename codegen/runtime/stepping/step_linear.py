"""One step of an implicit scheme whose equations are linear in the unknowns: one linear solve, no iteration."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_step import UNKNOWNS, complete_step, predict_step, step_jacobian
from codegen.runtime.stepping.scalar import factor_matrix, solve_factored

SINGULAR = -2  # what `advance` returns when the linear system has no unique solution


@njit(cache=True, error_model="numpy")
def allocate_work(h, parameters):
    """Unknowns, residual, Jacobian and its pivots."""
    return np.empty(UNKNOWNS), np.empty(UNKNOWNS), np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS, np.int64)


@njit(cache=True, error_model="numpy")
def advance(state, t, h, parameters, work, interval, tolerance, max_iterations):
    """Fill `interval` with inner stages and the state at the right node; return 1, or SINGULAR."""
    unknowns, residual, jacobian, pivots = work
    predict_step(state, t, h, parameters, unknowns)
    step_jacobian(unknowns, state, t, h, parameters, residual, jacobian)
    if factor_matrix(jacobian, pivots) >= 0:
        return SINGULAR
    solve_factored(jacobian, pivots, residual)
    for i in range(UNKNOWNS):
        unknowns[i] -= residual[i]
    complete_step(unknowns, state, t, h, parameters, interval)
    return 1
