"""One step made up of steps of another scheme, whose lengths are rows of FRACTIONS in parts of the whole."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_step import FRACTIONS, PARTS, RANGED, STAGES, STATE, step_equations
from codegen.runtime.stepping.step_newton import advance, allocate_work
from codegen.runtime.tabulated.table_steps import LEFT_TABLE, left_tables


@njit(cache=True, error_model="numpy")
def allocate_parts(h, given):
    """What the base scheme needs, the lengths of its steps, shape as FRACTIONS, and the state before each of them."""
    return allocate_work(h, given), h * FRACTIONS, np.empty(STATE)


@njit(cache=True, error_model="numpy")
def advance_parts(state, t, given, work, interval):
    """Make all steps of the base scheme from `state`, shape (STATE,); otherwise as `advance` for the last of them."""
    inner_work, lengths, here = work
    iterations = 0
    if RANGED:
        inputs = np.empty((RANGED, 2))
    for i in range(STATE):
        here[i] = state[i]
    for part in range(PARTS):
        outcome = advance(here, t, lengths[part], given, inner_work, interval)
        if RANGED and outcome >= 0 and left_tables(here, interval, t, lengths[part], given[0], inputs) >= 0:
            return LEFT_TABLE
        if outcome < 0:
            return outcome
        iterations += outcome
        for i in range(STATE):
            here[i] = interval[STAGES + i]
        for i in range(lengths.shape[1]):
            t += lengths[part, i]
    return iterations


@njit(cache=True, error_model="numpy")
def parts_residual(state, end, t, given, work, interval, residual):
    """Max-norm of the base scheme's equations, shape (STAGES + STATE,), over steps made again from `state` to `end`."""
    inner_work, lengths, here = work
    largest = 0.0
    for i in range(STATE):
        here[i] = state[i]
    for part in range(PARTS):
        advance(here, t, lengths[part], given, inner_work, interval)
        if part == PARTS - 1:
            for i in range(STATE):
                interval[STAGES + i] = end[i]
        step_equations(here, interval, t, lengths[part], given[0], residual)
        for i in range(STAGES + STATE):
            if not abs(residual[i]) < np.inf:
                return np.inf
            largest = max(largest, abs(residual[i]))
        for i in range(STATE):
            here[i] = interval[STAGES + i]
        for i in range(lengths.shape[1]):
            t += lengths[part, i]
    return largest
