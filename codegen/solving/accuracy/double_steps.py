"""The discretisation error of a solution, estimated on double steps: two intervals in one.

On the grid of double steps the solution leaves residuals, the defects of its steps. Newton's method with the same
active bounds turns them into changes: of states by the KKT matrix, and of the cost by the Lagrangian, where each defect
has the multiplier of its equation as weight. Both changes are 2^p - 1 times the error; p is the order of the optima.
A step or two of Newton's method, on half as many intervals, take no longer than one iteration of the solve.
Where active bounds differ on the two grids, or the solution is no minimum on the coarser one, the optimum on double
steps is searched for. Sources: Richardson (1911); Becker and Rannacher (2001), An optimal control approach to a
posteriori error estimation in finite element methods, Acta Numerica 10, section 2; Hairer, Norsett and Wanner (1993),
Solving ordinary differential equations I, II.4, for double steps.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np

from codegen.interfaces import ControlModule, Grid, Indices, Vector, time_grid
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import corrected_cost
from codegen.solutions.control import held_at_bounds
from codegen.solutions.result import DiscretisationError, Result
from codegen.solutions.segments import segments_of
from codegen.solving.accuracy.arcs import NEGLIGIBLE, sizes_of
from codegen.solving.refinement import order_of_optima

STEPS, CONTRACTION, SETTLED = 4, 0.5, 0.1
"""The most Newton steps; the least factor by which they shrink; the largest share of the last one in the change."""
HELD, LOOSE = 1e8, 1e-12
"""Curvatures, in parts of sizes, of unknowns on bounds that hold them, and of others with bounds."""
BEYOND = 0.01
"""Part of its size by which an unknown leaves its bounds where these do not hold as they did."""

Search = Callable[[int, Vector, Vector | None], Vector | None]
"""The optimum for a number of intervals, a start and fractions of the duration; None where none was found."""

_STEP = re.compile(r"multiplier of the (?:step|equation of motion) of (?P<name>.*)")
_STAGE = re.compile(r"(?P<name>.*)_stage\d+")


def discretisation_error(module: ControlModule, result: Result, search: Search) -> DiscretisationError | None:
    """Estimate the error of a solution, relative to the largest value of every state, and of the cost.

    Newton's method is tried before `search`. None where there is no pair of intervals, and where no optimum was found
    on double steps, so that nothing is known of the error.
    """
    assert result.unknowns is not None
    fine = time_grid(module, result.steps, result.grid)
    kept = _kept(result.steps, _inner(module, fine))
    phases, steps = module.metadata.get("phases", 1), kept.size - 1
    rows = np.concatenate([[0], *(phase * result.steps + kept[1:] for phase in range(phases))])
    # Lengths of double steps, in parts of the duration (n,), or of every phase (phases, n).
    lengths = np.diff(fine.nodes[rows]).reshape(phases, -1)
    lengths /= lengths.sum(axis=1, keepdims=True)
    fractions = np.asarray(lengths if phases > 1 else lengths[0])
    equal = result.grid is None and result.steps == 2 * steps
    grid = time_grid(module, steps, None if equal else fractions)
    if steps == result.steps or tuple(rows[list(_inner(module, grid))]) != _inner(module, fine):
        return None
    start = _restricted(module, fine, grid, rows, result.unknowns)
    found = _carried_on(module, fine, grid, rows, result.unknowns, start)
    if found is None:
        found = search(steps, start, None if equal else fractions)
    if found is None or not np.isfinite(found).all():
        return None
    return _compared(module, result, grid, found, rows)


def _inner(module: ControlModule, grid: Grid) -> tuple[int, ...]:
    """The nodes of a grid at inner times."""
    return tuple(map(int, grid.inner)) if module.metadata.get("inner_times", 0) else ()


def _kept(steps: int, inner: tuple[int, ...]) -> Indices:
    """The nodes of N = `steps` intervals between double steps: every second one, inner times and the last."""
    kept = [0]
    while kept[-1] < steps:
        following = kept[-1] + 1
        kept.append(following if following in inner else min(following + 1, steps))
    return np.array(kept)


def _restricted(module: Any, fine: Grid, grid: Grid, rows: Indices, unknowns: Vector) -> Vector:
    """The unknowns of a solution on double steps.

    Nodes have their values, controls and slacks the mean of two intervals, and so have multipliers of steps; other
    multipliers are integrals over their interval, and add up. From its node on, a stage has gone as far as both.
    """
    result = np.zeros(grid.is_multiplier.size)
    (nodes, intervals), (new_nodes, new_intervals) = module.views(fine, unknowns), module.views(grid, result)
    first, last = rows[:-1], rows[1:] - 1
    new_nodes[:] = nodes[:, rows]
    one, other, double = intervals[:, first], intervals[:, last], first != last
    new_intervals[:] = 0.5 * (one + other)
    structure = module.problem.structure
    names, meanings = list(module.metadata["node"]), module.metadata["meanings"]
    for column, name in enumerate(module.metadata["interval"]):
        step, stage = _STEP.fullmatch(meanings.get(name, "")), _STAGE.fullmatch(name)
        if structure.is_multiplier[structure.node + column]:
            if not (step and step["name"] in names):
                new_intervals[:, double, column] *= 2.0
        elif stage and stage["name"] in names:
            middle = nodes[:, last, names.index(stage["name"])]
            new_intervals[:, double, column] = (one + other)[:, double, column] - middle[:, double]
    result[result.size - structure.root :] = unknowns[unknowns.size - structure.root :]
    return np.asarray(module.with_pinned_values(grid, result))


def _carried_on(module: Any, fine: Grid, grid: Grid, rows: Indices, unknowns: Vector, start: Vector) -> Vector | None:
    """The optimum on double steps by Newton's method, with bounds that hold as on the finer grid.

    None where steps do not settle, the reduced Hessian is not positive definite, or other bounds would have to hold.
    """
    scaled = scaled_grid(grid, start)
    sizes = scaled.sizes if scaled.sizes.size else np.ones(start.size)
    held = bounded = np.zeros(start.size, dtype=bool)
    if module.metadata["inequalities"]:
        # Which unknowns of double steps are on bounds: those that are so at their node, or on both intervals.
        found = held_at_bounds(module, fine, unknowns).astype(float)
        result = np.zeros(grid.is_multiplier.size)
        (nodes, intervals), (new_nodes, new_intervals) = module.views(fine, found), module.views(grid, result)
        new_nodes[:] = nodes[:, rows]
        new_intervals[:] = np.minimum(intervals[:, rows[:-1]], intervals[:, rows[1:] - 1])
        root = module.problem.structure.root
        result[result.size - root :] = found[found.size - root :]
        held = result > 0.0
        lower, upper = module.variable_bounds(grid)
        bounded = (np.isfinite(lower) | np.isfinite(upper)) & ~held
    diagonal = np.where(held, HELD, np.where(bounded, LOOSE, 0.0))
    system, current, before = allocate_system(scaled), start, np.inf
    primal = ~np.asarray(grid.is_multiplier)
    units = np.maximum(sizes, np.abs(start))[primal]
    for _ in range(STEPS):
        step = np.zeros(start.size)
        point = module.evaluate(scaled, current / sizes)
        if factor_kkt(scaled, point.unknowns, 1.0, diagonal, system, point.gradient, step) != 0:
            return None
        following = module.with_pinned_values(grid, current + sizes * step)
        length = float(np.max(np.abs(following - current)[primal] / units))
        current = following
        if not length <= CONTRACTION * before:
            return None
        before = length
        if length <= SETTLED * float(np.max(np.abs(current - start)[primal] / units)) or length <= NEGLIGIBLE:
            break
    else:
        return None
    if bounded.any():
        beyond = np.maximum(lower - current, current - upper)[bounded]
        if np.max(beyond / np.maximum(sizes, np.abs(current))[bounded]) > BEYOND:
            return None
    return np.asarray(current)


def _compared(module: ControlModule, result: Result, grid: Grid, found: Vector, rows: Indices) -> DiscretisationError:
    """The error that the change from double steps to steps tells of; free parameters count among states."""
    assert result.cost is not None
    _, q, p, *_ = module.unpack(grid, found)
    table, coarse = np.column_stack([result.q, result.p]), np.column_stack([q, p])
    names, times = [*result.names["q"], *result.names["p"]], result.t[rows]
    kept = [i for i in range(table.shape[1]) if np.isfinite(table[:, i]).all()]
    changes = np.abs(coarse - table[rows])[:, kept] / sizes_of(table[:, kept])
    node, column = np.unravel_index(int(np.argmax(changes)), changes.shape)
    states, quantity, time = float(changes[node, column]), names[kept[column]], float(times[node])
    free = module.metadata["free_parameters"]
    last = found.size - module.problem.structure.couplings
    for name, value in zip(free, found[last - len(free) : last], strict=True):
        own = result.summary[name]
        change = abs(float(value) - own) / (abs(own) if abs(own) > NEGLIGIBLE else 1.0)
        if change > states:
            states, quantity, time = change, name, float(result.t[-1])
    cost = corrected_cost(grid, module.evaluate(grid, found))
    size = abs(result.cost) if abs(result.cost) > NEGLIGIBLE else 1.0
    if segments := segments_of(module.metadata):
        quantity, segment = segments.split(quantity)
        time += (segment - 1) * float(result.t[-1] - result.t[0])
    factor = 2.0 ** order_of_optima(module) - 1.0
    return DiscretisationError(states / factor, abs(cost - result.cost) / size / factor, quantity, time)
