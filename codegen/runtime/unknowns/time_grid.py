"""The time grid of a solution and its checks, views of the unknowns, the iteration log."""

import math

import numpy as np

from codegen.runtime.optimise.counts import checked_times
from codegen.runtime.stand_ins.example import BODIES, NODE, PHASES, SEVERAL, SHARED, STRIDE
from codegen.runtime.unknowns.layout import layout
from codegen.runtime.unknowns.point import Grid


NONE = np.zeros(0)  # sizes of unknowns that are not scaled


def checked_grid(steps, duration, parameters):
    """A Grid; `parameters` are numbers, or arrays (BODIES,). ValueError for what is not finite or not positive."""
    steps, duration = checked_times(steps, duration)
    table = np.zeros((BODIES, len(parameters) + SHARED))  # shared unknowns stand behind the parameters
    numbers = [value if isinstance(value, (int, float)) else 0.0 for value in parameters]
    table[:, : len(parameters)] = numbers
    finite = all(map(math.isfinite, numbers))
    for i, value in enumerate(parameters):
        if value is not numbers[i]:  # differs from body to body
            table[:, i] = value
            finite = finite and all(map(math.isfinite, table[:, i].tolist()))
    if not finite:
        raise ValueError(f"parameters and boundary values must be finite, got {table}")
    if PHASES:
        steps, duration = PHASES * steps, PHASES  # the time of a chain runs from each phase's number to the next
    return Grid(steps, duration / steps, table, layout(steps).is_multiplier.copy(), NONE, NONE, 1.0, ())


def plain_grid(grid):
    """The same grid without sizes, in the problem's own units."""
    return grid._replace(sizes=NONE, forces=NONE, weight=1.0, bounds=())


def replace_values(boundary, where, values):
    """Overwrite prescribed boundary values by name; ValueError tells which names there are."""
    for quantity, value in (values or {}).items():
        key = f"{where} {quantity}"
        if key not in boundary:
            known = ", ".join(name.split()[1] for name in boundary if name.startswith(where)) or "nothing"
            raise ValueError(f"{quantity!r} is not prescribed at the {where}; prescribed: {known}")
        boundary[key] = np.asarray(value, dtype=float)


def views(grid, unknowns):
    """Views of `unknowns` (n,): nodes (BODIES, N + 1, NODE), what lies on intervals (BODIES, N, STRIDE - NODE)."""
    item, chain = unknowns.itemsize, grid.steps * STRIDE + NODE
    nodes = np.ndarray((BODIES, grid.steps + 1, NODE), float, unknowns, 0, (chain * item, STRIDE * item, item))
    shape = BODIES, grid.steps, STRIDE - NODE
    intervals = np.ndarray(shape, float, unknowns, NODE * item, (chain * item, STRIDE * item, item))
    return nodes, intervals


def side_by_side(values):
    """Values (BODIES, times, m) as (times, BODIES m): the columns of several bodies side by side."""
    if SEVERAL:
        return values.transpose(1, 0, 2).copy().reshape(values.shape[1], -1)
    else:
        return values[0].copy()


def print_log(rows):
    """Print the iterations: cost, residual, stationarity, shift of the Hessian, step length, weight of a barrier."""
    last = "  barrier" if len(rows[0]) > 5 else ""
    print(f"iteration            cost   residual  stationarity     shift     step{last}")
    for i, (cost, residual, stationarity, shift, length, *barrier) in enumerate(rows):
        weight = "".join(f" {mu:8.1e}" for mu in barrier)
        print(f"{i:9d} {cost:15.8g} {residual:10.2e} {stationarity:13.2e} {shift:9.1e} {length:8.1e}{weight}")
