"""One step made up of steps of another scheme, whose lengths are rows of FRACTIONS in parts of the whole."""

import numpy as np
from numba import njit

from codegen.runtime.example_step import FRACTIONS, PARTS, STAGES, STATE, step_equations
from codegen.runtime.step_newton import advance


@njit(cache=True, error_model="numpy")
def advance_parts(state, t, h, parameters, work, interval, tolerance, max_iterations):
    """Make all steps of the base scheme from `state`; `interval` is that of the last. Return as `advance` does."""
    here, iterations = state.copy(), 0
    for part in range(PARTS):
        lengths = h * FRACTIONS[part]
        outcome = advance(here, t, lengths, parameters, work, interval, tolerance, max_iterations)
        if outcome < 0:
            return outcome
        iterations += outcome
        t += lengths.sum()
        for i in range(STATE):
            here[i] = interval[STAGES + i]
    return iterations


@njit(cache=True, error_model="numpy")
def parts_residual(state, end, t, h, parameters, work, interval, residual, tolerance, max_iterations):
    """Max-norm of the base scheme's equations over the steps from `state` to `end`, the others being made again."""
    here, largest = state.copy(), 0.0
    for part in range(PARTS):
        lengths = h * FRACTIONS[part]
        advance(here, t, lengths, parameters, work, interval, tolerance, max_iterations)
        if part == PARTS - 1:
            for i in range(STATE):
                interval[STAGES + i] = end[i]
        step_equations(here, interval, t, lengths, parameters, residual)
        for i in range(STAGES + STATE):
            if not abs(residual[i]) < np.inf:
                return np.inf
            largest = max(largest, abs(residual[i]))
        t += lengths.sum()
        for i in range(STATE):
            here[i] = interval[STAGES + i]
    return largest
