"""What is said of a step that leaves the range of a table."""

import numpy as np

from codegen.runtime.stand_ins.example_step import PARTS, STAGES, STATE
from codegen.runtime.stand_ins.example_tables import RANGE_NAMES, RANGED, RANGES
from codegen.runtime.stepping.composition import allocate_parts
from codegen.runtime.stepping.step_newton import advance, allocate_work
from codegen.runtime.tabulated.table_steps import left_tables


def range_left(grid, state, t):
    """Which input leaves the range of its table in the step from `state` (STATE,) at time t, in words, or nothing."""
    interval, inputs, here = np.empty(STAGES + STATE), np.empty((RANGED, 2)), np.array(state)
    if PARTS:
        work, lengths, _ = allocate_parts(grid.h, grid.given)
        for length in lengths:
            advance(here, t, length, grid.given, work, interval)
            if left_tables(here, interval, t, length, grid.parameters, inputs) >= 0:
                return range_message(grid.parameters, inputs)
            here, t = interval[STAGES:].copy(), t + length.sum()
        return ""
    else:
        advance(here, t, grid.h, grid.given, allocate_work(grid.h, grid.given), interval)
        is_left = left_tables(here, interval, t, grid.h, grid.parameters, inputs) >= 0
        return range_message(grid.parameters, inputs) if is_left else ""


def first_outside(grid, path):
    """The number of the first step along consecutive states (M, STATE) that leaves a table, and what is said of it.

    Zero and nothing where none does. Inner stages are those of the steps that the scheme itself makes.
    """
    for k in range(len(path) - 1):
        message = range_left(grid, path[k], k * grid.h)
        if message:
            return k + 1, message
    return 0, ""


def range_message(parameters, inputs):
    """The input that is farthest outside, in words."""
    ends = parameters[RANGES]
    excess = np.maximum(ends[:, 0] - inputs[:, 0], inputs[:, 1] - ends[:, 1]) / (ends[:, 1] - ends[:, 0])
    j = int(np.argmax(excess))
    value = inputs[j, 0] if inputs[j, 0] < ends[j, 0] else inputs[j, 1]
    return f"{RANGE_NAMES[j]} is {value:g}, outside {ends[j, 0]:g} to {ends[j, 1]:g}"
