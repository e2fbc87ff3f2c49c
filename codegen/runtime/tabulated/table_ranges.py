"""Whether an optimum reads tables inside their ranges; on the way to it they may be read as they go on outside."""

import numpy as np
from numba import njit

from codegen.runtime.stand_ins.example import (
    BODIES, ELEMENT, NODE, PHASES, SHARED, STRIDE, duration_of,
)  # fmt: skip
from codegen.runtime.stand_ins.example_tables import (
    RANGE_NAMES, RANGED, RANGES, end_inputs, interval_inputs, start_inputs,
)  # fmt: skip
from codegen.runtime.unknowns.phases import node_times
from codegen.runtime.unknowns.shared import read_shared
from codegen.runtime.unknowns.times import span

OUTSIDE_TABLE = "outside a table"  # the status of what would be solved, were the table wider
TABLE_MARGIN = 1e-8  # parts of a range by which an input may be outside, which is rounding


def tables_beyond(grid, unknowns):
    """Which table is read outside its range, with what value and where, or nothing; `unknowns` in their own units."""
    index, found = np.zeros(3, np.int64), np.zeros(2)
    farthest_outside(unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, index, found)
    value, excess = found
    if not excess > TABLE_MARGIN:
        return ""
    body, k, j = map(int, index)
    t = duration_of(grid, unknowns) * grid.nodes[min(max(k, 0), grid.steps)] / grid.steps
    if PHASES:
        t = node_times(grid, unknowns)[min(k, grid.steps)]
    where = f"on interval {k}" if 0 <= k < grid.steps else f"at node {max(0, k - 1)}"
    whose = f" of body {body}" if BODIES > 1 else ""
    least, greatest = grid.parameters[body, RANGES[j]]
    return f"{RANGE_NAMES[j]} is {value:g} {where} (t = {max(0.0, t):.3g}){whose}, outside {least:g} to {greatest:g}"


@njit(cache=True, error_model="numpy")
def farthest_outside(unknowns, steps, h, nodes, parameters, index, found):
    """Note in `index` (3,) body, interval and input farthest outside, in `found` (2,) its value and by how much.

    `unknowns` (n,), `nodes` (N + 1,), `parameters` (BODIES, P + SHARED). By how much is told in
    parts of the range. The interval is -1 at the start, N + 1 at the end.
    """
    inputs, chain = np.empty((RANGED, 2)), steps * STRIDE + NODE
    found[1] = 0.0
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        first, own = body * chain, parameters[body]
        for k in range(-1, steps + 2):
            for j in range(RANGED):
                inputs[j, 0], inputs[j, 1] = np.inf, -np.inf
            here = first + k * STRIDE
            if k < 0:
                start_inputs(unknowns[first : first + NODE], 0.0, own, inputs)
            elif k < steps:
                t, length = span(nodes, k, h)
                interval_inputs(unknowns[here : here + ELEMENT], t, length, own, inputs)
            elif k > steps:
                end_inputs(unknowns[here - STRIDE : here - STRIDE + NODE], steps * h, own, inputs)
            note_outside(inputs, own, body, k, index, found)


@njit(error_model="numpy")
def note_outside(inputs, parameters, body, k, index, found):
    """Keep what is farther outside than before of `inputs` (RANGED, 2), least and greatest; else as above."""
    for j in range(RANGED):
        least, greatest = parameters[RANGES[j, 0]], parameters[RANGES[j, 1]]
        for value, excess in ((inputs[j, 0], least - inputs[j, 0]), (inputs[j, 1], inputs[j, 1] - greatest)):
            if excess > found[1] * (greatest - least):
                found[0], found[1] = value, excess / (greatest - least)
                index[0], index[1], index[2] = body, k, j
