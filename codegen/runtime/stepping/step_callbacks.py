"""The equations of one implicit step as a root finder wants them.

`residual` and `jacobian` belong to the unknowns that are left after explicit elimination; `complete` gives the state
at the right node that follows from them.
"""

import numpy as np

from codegen.runtime.stand_ins.example_step import (
    STAGES,
    STATE,
    UNKNOWNS,
    complete_step,
    predict_step,
    step_jacobian,
    step_residual,
)


def predict(grid, state, t=0.0):
    """Unknowns from which to start, shape (UNKNOWNS,), for a step from `state`, shape (STATE,)."""
    unknowns = np.empty(UNKNOWNS)
    predict_step(np.array(state, dtype=float), t, grid.h, grid.parameters, unknowns)
    return unknowns


def residual(grid, unknowns, state, t=0.0):
    """Residual, shape (UNKNOWNS,), of the step from `state` at time t."""
    values = np.empty(UNKNOWNS)
    step_residual(np.array(unknowns, dtype=float), np.array(state, dtype=float), t, grid.h, grid.parameters, values)
    return values


def jacobian(grid, unknowns, state, t=0.0):
    """Jacobian of the residual by the unknowns, shape (UNKNOWNS, UNKNOWNS)."""
    values, matrix = np.empty(UNKNOWNS), np.empty((UNKNOWNS, UNKNOWNS))
    unknowns, state = np.array(unknowns, dtype=float), np.array(state, dtype=float)
    step_jacobian(unknowns, state, t, grid.h, grid.parameters, values, matrix)
    return matrix


def complete(grid, unknowns, state, t=0.0):
    """State (q, p), shape (STATE,), at the right node that belongs to a solution of the step's equations."""
    interval = np.empty(STAGES + STATE)
    unknowns, state = np.array(unknowns, dtype=float), np.array(state, dtype=float)
    complete_step(unknowns, state, t, grid.h, grid.parameters, interval)
    return interval[STAGES:]
