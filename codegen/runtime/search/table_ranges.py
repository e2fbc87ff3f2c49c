"""Tables with ranges: whether an optimum reads them inside; on the way to it they are read as they go on outside."""

import numpy as np

from codegen.runtime.search.grid import node_times
from codegen.runtime.search.parts import fill

OUTSIDE_TABLE = "outside a table"  # the status of what would be solved, were the table wider
TABLE_MARGIN = 1e-8  # parts of a range by which an input may be outside, which is rounding


def tables_beyond(grid, unknowns):
    """Return which table is read outside its range, with what value and where, or nothing.

    Rows of `inputs`, (bodies, N + 2, inputs, 2): the start, all intervals, the end; least and greatest values.
    `unknowns` are in the problem's own units.
    """
    problem = grid.problem
    s, ranges = problem.structure, np.asarray(problem.ranges)
    inputs = np.empty((s.bodies, grid.steps + 2, 2 * len(ranges)))
    fill(problem.inputs.address, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, inputs.reshape(-1))
    inputs = inputs.reshape(s.bodies, grid.steps + 2, len(ranges), 2)
    ends = grid.parameters[:, ranges][:, None]
    excess = np.maximum(ends[..., 0] - inputs[..., 0], inputs[..., 1] - ends[..., 1]) / (ends[..., 1] - ends[..., 0])
    body, k, j = np.unravel_index(int(np.argmax(excess)), excess.shape)
    if not excess[body, k, j] > TABLE_MARGIN:
        return ""
    least, greatest = ends[body, 0, j]
    low, high = inputs[body, k, j]
    value, k = low if least - low >= high - greatest else high, k - 1
    node = min(max(k, 0), grid.steps)
    t = problem.duration_of(grid, unknowns) * grid.nodes[node] / grid.steps
    if s.phases:
        t = node_times(grid, unknowns)[node]
    where = f"on interval {k}" if 0 <= k < grid.steps else f"at node {node}"
    whose = f" of body {body}" if s.bodies > 1 else ""
    name = problem.range_names[j]
    return f"{name} is {value:g} {where} (t = {max(0.0, t):.3g}){whose}, outside {least:g} to {greatest:g}"
