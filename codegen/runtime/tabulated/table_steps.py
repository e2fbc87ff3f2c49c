"""Whether a step reads tables inside their ranges."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example_tables import RANGED, RANGES, step_inputs

LEFT_TABLE = -4  # what tells that a step has left the range of a table
TABLE_MARGIN = 1e-8  # parts of a range by which an input may be outside, which is rounding


@njit(cache=True, error_model="numpy")
def left_tables(state, interval, t, length, parameters, inputs):
    """The number of the first input that leaves its range in a step from `state` (STATE,), -1 where none does.

    `inputs` (RANGED, 2) takes the least and the greatest value of each; `length` is what the scheme takes for it.
    """
    for j in range(RANGED):
        inputs[j, 0], inputs[j, 1] = np.inf, -np.inf
    step_inputs(state, interval, t, length, parameters, inputs)
    for j in range(RANGED):
        least, greatest = parameters[RANGES[j, 0]], parameters[RANGES[j, 1]]
        margin = TABLE_MARGIN * (greatest - least)
        if inputs[j, 0] < least - margin or inputs[j, 1] > greatest + margin:
            return j
    return -1
