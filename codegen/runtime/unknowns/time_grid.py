"""The time grid of a solution and its checks, views of the unknowns, the iteration log."""

import math

import numpy as np

from codegen.runtime.optimise.counts import checked_times
from codegen.runtime.stand_ins.example import BODIES, NODE, PHASES, SEVERAL, SHARED, STRIDE
from codegen.runtime.unknowns.layout import layout
from codegen.runtime.unknowns.point import Grid


NONE = np.zeros(0)  # sizes of unknowns that are not scaled
SHORTEST = 1e-10  # part of the duration, or of a phase, that an interval has at least
EQUAL = 1e-12  # parts of their length by which equal intervals may differ


def checked_grid(steps, duration, parameters, fractions):
    """A Grid; `parameters` are numbers, or arrays (BODIES,). ValueError for what is not finite or not positive."""
    steps, duration = checked_times(steps, duration)
    steps, nodes, is_uniform = checked_nodes(steps, fractions)
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
    return Grid(
        steps, duration / steps, nodes, is_uniform, table, layout(steps).is_multiplier.copy(), NONE, NONE, 1.0, ()
    )


def checked_nodes(steps, fractions):
    """The number of intervals, the indices of all nodes in mean lengths, and whether all intervals are equally long.

    `fractions`, if given, are parts of the duration, (N,), or of every phase, also (PHASES, N). ValueError for others.
    """
    chains = 1
    if PHASES:
        chains = PHASES
    if fractions is None:
        return steps, np.arange(chains * steps + 1.0), True
    lengths = np.array(fractions, dtype=float)
    if lengths.ndim == 1:
        lengths = np.tile(lengths, (chains, 1))
    if lengths.ndim != 2 or lengths.shape[0] != chains or not lengths.size:
        shape = "(N,)" if chains == 1 else f"(N,) or ({chains}, N)"
        raise ValueError(f"grid has shape {np.shape(fractions)}, expected {shape}")
    if not (lengths > SHORTEST).all() or not np.allclose(lengths.sum(axis=1), 1.0, rtol=0.0, atol=1e-6):
        raise ValueError(f"grid must hold fractions above {SHORTEST:g} whose sum is one, got {fractions!r}")
    steps = lengths.shape[1]
    if np.ptp(lengths) <= EQUAL / steps:
        return steps, np.arange(chains * steps + 1.0), True
    ends = np.cumsum(lengths, axis=1)
    indices = steps * (ends / ends[:, -1:] + np.arange(chains)[:, None])
    return steps, np.concatenate([[0.0], indices.ravel()]), False


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
