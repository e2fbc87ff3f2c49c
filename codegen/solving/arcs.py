"""Arcs of a solution, switching times between arcs, and estimates of the discretisation error.

An arc is a part of the motion on which the same bounds and inequalities are active. A gap between two arcs contains a
switching time. On an interval with a switching time a control is the mean of two values, which causes an error of all
later states. Intervals in gaps are made so short that this error is negligible.

Two estimates of the error of an optimum exist. The first one compares it with the optimum on the bisected grid, for
each quantity and each interval. Quantities are coordinates, momenta, and the cost up to each node, relative to their
largest values.

The second one uses double steps, which join two intervals. On the grid of double steps the solution has residuals, the
defects of the steps. Newton's method with the same active bounds computes the changes that remove the defects. States
change by the solution of a linear system with the KKT matrix. The cost changes by the sum of all defects times their
multipliers. Both changes are 2^p - 1 times the error, where p is the order of the optima. One or two Newton steps on
half as many intervals take no longer than one iteration of the solve. If other bounds are active on the coarser grid,
or the solution is no minimum there, the optimum on double steps is searched for.

The error of a simulation follows from a simulation with another number of steps, by Richardson extrapolation.

Sources: Richardson (1911); Becker and Rannacher (2001), An optimal control approach to a posteriori error estimation in
finite element methods, Acta Numerica 10, section 2; Hairer, Norsett and Wanner (1993), Solving ordinary differential
equations I, II.4, for double steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from codegen.runtime.record import Kind, Sites
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.runtime.search.point import interval_parts, stationarity
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import corrected_cost
from codegen.solving.loading import ControlModule, Grid, Indices, Matrix, SimulateModule, Vector, time_grid
from codegen.solving.results.control import bound_distances, free_parameters, held_at_bounds
from codegen.solving.results.motions import ROUNDING
from codegen.solving.results.result import DiscretisationError, Result, SimulateAttempt
from codegen.solving.results.segments import segments_of

LEAST_ARC = 4
"""Least number of intervals of an arc; fewer intervals belong to a gap."""
SECANTS = 8
"""Number of secant iterations for a switching time."""
LEAST_JUMP = 0.05
"""Smallest jump of a control, relative to its range, for which a switching time is computed."""
BESIDE, FAR = 3, 12
"""Number of nodes on each side of a gap that are omitted: for a switching time, and for estimates of errors on arcs."""
MOST_GAPS = 40
"""Largest number of gaps in a phase; with more gaps the controls chatter, and all gaps of the phase are ignored."""
CLOSE = 1e-3
"""Distance to a bound, relative to the distance between two bounds, below which the bound is active."""
NEGLIGIBLE = 1e-12
"""Magnitude of a quantity below which its absolute error is used in place of its relative error."""
AT_REST = 1e-6
"""Magnitude below which the absolute error is used for quantities that contact forces hold at zero."""
STEPS, CONTRACTION, SETTLED = 4, 0.5, 0.1
"""Limits of Newton's method on double steps.

The limits are the largest number of Newton steps, and the largest ratio of the lengths of two successive steps. The
method ends if the ratio of the last step to the whole change is below the third limit.
"""
HELD, LOOSE = 1e8, 1e-12
"""Scaled curvatures that are added to the KKT matrix for unknowns at active bounds, and for other bounded unknowns."""
BEYOND = 0.01
"""Violation of a bound, relative to the unknown, above which another set of active bounds is assumed."""
SAME_TIME = 1e-9
"""Difference of two times, relative to the duration, that is a rounding error."""


@dataclass(frozen=True)
class Gap:
    """A short part of a phase between two arcs, which contains a switching time.

    `begin`, `end` and `switch` are fractions of the duration of the phase. `switch` is None if the time is unknown.
    """

    phase: int
    begin: float
    end: float
    switch: float | None = None


def order_of_optima(module: ControlModule) -> int:
    """Return the order of convergence of the optimal cost: the order of the scheme, limited by that of the controls.

    At a minimum the error of the cost is a square of the error of the control. A smooth control is approximated at
    order 1 by constants on intervals, and at order 2 by lines between nodes. With bounds the order of lines is 2,
    because a control may turn or jump inside an interval. Controls at stages do not limit the order. Contact begins and
    ends at nodes, so that the order is 1.
    """
    order, metadata = int(module.metadata.order), module.metadata
    if metadata.relaxation:
        return 1
    if not metadata.control_names or metadata.controls == Sites.STAGES:
        return order
    return min(order, 4 if metadata.controls == Sites.LINEAR and not metadata.inequalities else 2)


def gaps(module: ControlModule, result: Result) -> list[Gap]:
    """Return the gaps between the arcs of all bounded unknowns, without the phases that have more than MOST_GAPS."""
    grid = time_grid(module, result.steps, result.grid)
    separate: list[Gap] = []
    for phase, kinds in _active_bounds(module, result, grid):
        nodes = grid.nodes[phase * result.steps : (phase + 1) * result.steps + 1] / result.steps - phase
        # A run is a sequence of intervals with the same active bound: (first interval, last interval, active bound).
        ends = np.flatnonzero(np.diff(kinds)) + 1
        runs = [(int(part[0]), int(part[-1]), int(kinds[part[0]])) for part in np.split(np.arange(kinds.size), ends)]
        arcs = [run for run in runs if run[1] - run[0] + 1 >= LEAST_ARC] or [(0, kinds.size - 1, 0)]
        for (_, last, kind), (first, _, other) in pairwise(arcs):
            if kind != other or first - last > 1:
                separate.append(Gap(phase, float(nodes[last]), float(nodes[min(first + 1, nodes.size - 1)])))
    merged: list[Gap] = []
    for gap in sorted(separate, key=lambda gap: (gap.phase, gap.begin)):
        if merged and merged[-1].phase == gap.phase and gap.begin <= merged[-1].end:
            merged[-1] = Gap(gap.phase, merged[-1].begin, max(merged[-1].end, gap.end))
        else:
            merged.append(gap)
    few = [gap for gap in merged if sum(other.phase == gap.phase for other in merged) <= MOST_GAPS]
    return [replace(gap, switch=_switching_time(result, grid, gap)) for gap in few]


def _active_bounds(module: ControlModule, result: Result, grid: Grid) -> Iterator[tuple[int, NDArray[np.int8]]]:
    """Yield the phase and the active bounds (N,) on its intervals, for each phase, body and bounded unknown.

    An entry is -1 for the lower bound, 1 for the upper bound and 0 if no bound is active.
    """
    if not module.metadata.inequalities or result.unknowns is None:
        return
    primal, bounded = module.primal_unknowns(grid), np.zeros(result.unknowns.size, bool)
    below, above = bound_distances(module, grid, result.unknowns)
    slopes = stationarity(grid, result.unknowns)
    lower, upper = module.variable_bounds(grid)
    width = (upper - lower)[primal]
    close = np.minimum(below, above)
    # With two bounds, the distance decides if a bound is active. With a single bound, the slope of the Lagrangian does.
    active = np.where(np.isfinite(width), close < CLOSE * width, np.abs(slopes) > close)
    kind = np.zeros(result.unknowns.size, np.int8)
    kind[primal] = np.where(active, np.where(below < above, -1, 1), 0)
    bounded[primal] = np.isfinite(close)
    (nodes, intervals), (at_nodes, inside) = (module.views(grid, table.astype(float)) for table in (kind, bounded))
    kinds = np.concatenate([nodes[:, 1:], intervals], axis=2)
    has_bounds = np.concatenate([at_nodes[:, 1:], inside], axis=2).any(axis=1)
    for phase in range(module.metadata.phases):
        rows = slice(phase * result.steps, (phase + 1) * result.steps)
        for body, column in zip(*np.nonzero(has_bounds), strict=True):
            yield phase, kinds[body, rows, column].astype(np.int8)


def _switching_time(result: Result, grid: Grid, gap: Gap) -> float | None:
    """Return the time in a gap at which a control jumps, as a fraction of the phase; None if no jump is found.

    The control is extrapolated linearly from two intervals before the gap and from two intervals after the gap. The
    jump between the two lines is placed such that the integral of the control over the gap is preserved. The control
    with the largest jump is used.
    """
    u, steps = result.u, result.steps
    if u is None or len(u) != result.t.size - 1:
        return None
    nodes = grid.nodes[gap.phase * steps : (gap.phase + 1) * steps + 1] / steps - gap.phase
    window = around(nodes, gap, BESIDE)
    first, last = window.start, window.stop - 1
    if first < 2 or last > steps - 2:
        return None
    controls, middles, lengths = u[gap.phase * steps :][:steps], 0.5 * (nodes[:-1] + nodes[1:]), np.diff(nodes)
    jumps = np.abs(controls[first - 1] - controls[last])
    values = controls[:, int(np.argmax(jumps / np.maximum(np.ptp(controls, axis=0), 1e-300)))]

    def line(i: int) -> Vector:
        slope = (values[i + 1] - values[i]) / (middles[i + 1] - middles[i])
        return np.array([slope, values[i] - slope * middles[i]])

    before, after = line(first - 2), line(last)
    left, right = float(nodes[first]), float(nodes[last])
    total = float(values[first:last] @ lengths[first:last])
    time = 0.5 * (left + right)
    for _ in range(SECANTS):
        jump = np.polyval(before, time) - np.polyval(after, time)
        if abs(jump) < LEAST_JUMP * np.ptp(values):
            return None
        integrals = np.polyint(before), np.polyint(after)
        area = np.polyval(integrals[0], time) - np.polyval(integrals[0], left)
        area += np.polyval(integrals[1], right) - np.polyval(integrals[1], time)
        time = float(np.clip(time + (total - area) / jump, left, right))
    return time if left < time < right else None


def around(nodes: Vector, gap: Gap, margin: int) -> slice:
    """Return the slice of the nodes of a phase that lie in a gap, with `margin` more nodes on each side.

    `nodes` are the times of all nodes of the phase, as fractions of its duration.
    """
    first, last = np.searchsorted(nodes, [gap.begin + 1e-12, gap.end - 1e-12])
    return slice(max(0, int(first) - margin), int(last) + margin + 1)


# The error from a solution on the bisected grid


@dataclass(frozen=True)
class Estimate:
    """The largest relative difference between two solutions, with its quantity and its time."""

    difference: float
    quantity: str
    time: float


def trajectories(module: ControlModule, result: Result) -> tuple[Matrix, tuple[str, ...]]:
    """Return a table (nodes, quantities) of coordinates, momenta and the cost up to each node, and the column names.

    Columns with values that are not finite are omitted.
    """
    # The cost of all bodies is added. Terminal costs and measurements are omitted, because the cost jumps there.
    grid = time_grid(module, result.steps, result.grid)
    if module.metadata.observations is not None:
        first = module.problem.structure.first_sample
        grid = grid._replace(parameters=np.ascontiguousarray(grid.parameters[:, :first]))
    costs = interval_parts(grid, result.unknowns)[..., -1]
    table = np.column_stack([result.q, result.p, np.concatenate([[0.0], np.cumsum(costs.sum(axis=0))])])
    names = [*result.names["q"], *result.names["p"], "the cost"]
    finite = [i for i in range(table.shape[1]) if np.isfinite(table[:, i]).all()]
    return table[:, finite], tuple(names[i] for i in finite)


def scales_of(table: Matrix, has_contact: bool) -> Vector:
    """Return the largest absolute value of each column of a table; 1 if this value is negligible."""
    scales = np.abs(table).max(axis=0)
    return np.where(scales > (AT_REST if has_contact else NEGLIGIBLE), scales, 1.0)


def compared(module: ControlModule, coarse: Result, fine: Result, without: Sequence[Gap] = ()) -> Estimate:
    """Return the largest relative difference between results on a grid and on the bisected grid.

    Trajectories are compared at the nodes of the coarser grid. The duration, free parameters and the cost are compared
    as well. Nodes in the gaps `without`, and close to these gaps, are omitted.
    """
    table, names = trajectories(module, fine)
    before, _ = trajectories(module, coarse)
    if before.shape[1] != table.shape[1]:
        return Estimate(np.inf, "a state", 0.0)
    differences = np.abs(table[::2] - before) / scales_of(table, bool(module.metadata.relaxation))
    nodes = time_grid(module, coarse.steps, coarse.grid).nodes
    for gap in without:
        first = gap.phase * coarse.steps
        touched = around(nodes[first:] / coarse.steps - gap.phase, gap, FAR)
        differences[first : first + coarse.steps + 1][touched] = 0.0
    node, column = np.unravel_index(int(np.argmax(differences)), differences.shape)
    worst = Estimate(float(differences[node, column]), names[column], float(fine.t[::2][node]))
    pairs = {
        name: (coarse.summary[name], fine.summary[name]) for name in ("duration", *module.metadata.free_parameters)
    }
    if coarse.cost is not None and fine.cost is not None:
        pairs["the cost"] = coarse.cost, fine.cost
    for name, (old, new) in pairs.items():
        difference = _relative(old, new)
        if difference > worst.difference:
            worst = Estimate(difference, name, float(fine.t[-1]))
    return worst


def _relative(value: float, reference: float) -> float:
    """Return the difference of a value from a reference, relative to the reference unless this is negligible."""
    return abs(value - reference) / (abs(reference) if abs(reference) > NEGLIGIBLE else 1.0)


def interval_errors(module: ControlModule, fine: Result, order: int) -> Matrix:
    """Return the errors (phases, N) of all intervals of a grid, from the solution `fine` on the bisected grid.

    The bisected grid has one inner node in each interval of the coarser grid. The error is the distance of the solution
    at this node from a polynomial of degree p = `order` through nodes of the coarser grid. Like the error of one step,
    it is proportional to h^(p + 1). Several polynomials are tried, with different numbers of nodes to the left, and the
    least distance is used. A kink at a node then does not affect neighbouring intervals.
    """
    table, _ = trajectories(module, fine)
    table = table / scales_of(table, bool(module.metadata.relaxation))
    phases, steps = module.metadata.phases, fine.steps // 2
    errors = np.empty((phases, steps))
    for phase in range(phases):
        skipped = min(phase, 1)  # the node at a switch has the values before a jump
        rows = slice(phase * fine.steps + 2 * skipped, (phase + 1) * fine.steps + 1)
        times, values = fine.t[rows], table[rows]
        nodes, middles = times[::2], times[1::2]
        count = min(order + 1, nodes.size)
        intervals = np.arange(middles.size)
        least = np.full(middles.size, np.inf)
        for left in range(count - 1):  # number of stencil nodes to the left of the left node of the interval
            indices = np.clip(intervals - left, 0, nodes.size - count)[:, None] + np.arange(count)
            stencil = nodes[indices]
            weights = np.ones_like(stencil)  # Lagrange polynomials at the inner nodes
            for i in range(count):
                for j in range(count):
                    if i != j:
                        weights[:, i] *= (middles - stencil[:, j]) / (stencil[:, i] - stencil[:, j])
            interpolated = np.einsum("ki,kij->kj", weights, values[::2][indices])
            least = np.minimum(least, np.abs(interpolated - values[1::2]).max(axis=1))
        errors[phase, skipped:] = least
        if skipped:
            errors[phase, 0] = errors[phase, min(1, steps - 1)]
    return errors


# The error from other steps

Search = Callable[[int, Vector, Vector | None], Vector | None]
"""A function that returns the unknowns of an optimum, or None if no optimum is found.

The arguments are the number of intervals, the initial guess (n,), and the lengths of the intervals relative to the
duration, or None for equal intervals.
"""


def discretisation_error(module: ControlModule, result: Result, search: Search) -> DiscretisationError | None:
    """Return the estimated discretisation error of the states and of the cost, from the optimum on double steps.

    The optimum is computed by Newton's method from the solution, or by `search` if that fails. Return None if no
    two intervals can be joined, or if no optimum is found on double steps.
    """
    assert result.unknowns is not None
    fine = time_grid(module, result.steps, result.grid)
    inner = _inner_nodes(module, fine)
    kept = [0]  # the nodes between double steps: every second node, the nodes at inner times and the last node
    while kept[-1] < result.steps:
        following = kept[-1] + 1
        kept.append(following if following in inner else min(following + 1, result.steps))
    phases, steps = module.metadata.phases, len(kept) - 1
    rows = np.concatenate([[0], *(phase * result.steps + np.array(kept[1:]) for phase in range(phases))])
    # Lengths of double steps as fractions of the duration (n,), or of every phase (phases, n).
    lengths = np.diff(fine.nodes[rows]).reshape(phases, -1)
    lengths /= lengths.sum(axis=1, keepdims=True)
    fractions = np.asarray(lengths if phases > 1 else lengths[0])
    equal = result.grid is None and result.steps == 2 * steps
    grid = time_grid(module, steps, None if equal else fractions)
    if steps == result.steps or tuple(rows[list(_inner_nodes(module, grid))]) != inner:
        return None
    start = _restricted(module, fine, grid, rows, result.unknowns)
    optimum = _carried_on(module, fine, grid, rows, result.unknowns, start)
    if optimum is None:
        optimum = search(steps, start, None if equal else fractions)
    if optimum is None or not np.isfinite(optimum).all():
        return None
    return _error(module, result, grid, optimum, rows)


def _inner_nodes(module: ControlModule, grid: Grid) -> tuple[int, ...]:
    return tuple(map(int, grid.inner)) if module.metadata.inner_times else ()


def _restricted(module: ControlModule, fine: Grid, grid: Grid, rows: Indices, unknowns: Vector) -> Vector:
    """Return the unknowns of a solution, transferred from the grid `fine` to the grid of double steps.

    `rows` are the indices of the nodes of `fine` that remain. Their values do not change. Controls, slacks and
    multipliers of the equations of motion are the mean of two intervals. Other multipliers are integrals over their
    interval, and are added. The differences between a stage and its node are also added.
    """
    result = np.zeros(grid.is_multiplier.size)
    (nodes, intervals), (new_nodes, new_intervals) = module.views(fine, unknowns), module.views(grid, result)
    first, last = rows[:-1], rows[1:] - 1
    new_nodes[:] = nodes[:, rows]
    one, other, double = intervals[:, first], intervals[:, last], first != last
    new_intervals[:] = 0.5 * (one + other)
    structure = module.problem.structure
    metadata, names = module.metadata, list(module.metadata.node)
    for column, name in enumerate(metadata.interval):
        state = metadata.stages.get(name)
        if structure.is_multiplier[structure.node + column]:
            if not (metadata.kind(name) in (Kind.STEP, Kind.MOTION) and metadata.meanings[name].of in names):
                new_intervals[:, double, column] *= 2.0
        elif state in names:
            middle = nodes[:, last, names.index(state)]
            new_intervals[:, double, column] = (one + other)[:, double, column] - middle[:, double]
    result[result.size - structure.root :] = unknowns[unknowns.size - structure.root :]
    return np.asarray(module.with_pinned_values(grid, result))


def _carried_on(
    module: ControlModule, fine: Grid, grid: Grid, rows: Indices, unknowns: Vector, start: Vector
) -> Vector | None:
    """Return the optimum on double steps by Newton's method from `start`, with the active bounds of the finer grid.

    `unknowns` is the solution on the grid `fine`, and `rows` are the indices of its nodes that remain. Return None if
    the method does not converge, the reduced Hessian is not positive definite, or other bounds become active.
    """
    scaled = scaled_grid(grid, start)
    scales = scaled.sizes if scaled.sizes.size else np.ones(start.size)
    held = bounded = np.zeros(start.size, dtype=bool)
    if module.metadata.inequalities:
        # An unknown on double steps is held at a bound if it is held at the same node, or on both joined intervals.
        held_before = held_at_bounds(module, fine, unknowns).astype(float)
        result = np.zeros(grid.is_multiplier.size)
        (nodes, intervals), (new_nodes, new_intervals) = module.views(fine, held_before), module.views(grid, result)
        new_nodes[:] = nodes[:, rows]
        new_intervals[:] = np.minimum(intervals[:, rows[:-1]], intervals[:, rows[1:] - 1])
        root = module.problem.structure.root
        result[result.size - root :] = held_before[held_before.size - root :]
        held = result > 0.0
        lower, upper = module.variable_bounds(grid)
        bounded = (np.isfinite(lower) | np.isfinite(upper)) & ~held
    diagonal = np.where(held, HELD, np.where(bounded, LOOSE, 0.0))
    system, current, before = allocate_system(scaled), start, np.inf
    primal = ~np.asarray(grid.is_multiplier)
    units = np.maximum(scales, np.abs(start))[primal]
    for _ in range(STEPS):
        step = np.zeros(start.size)
        point = module.evaluate(scaled, current / scales)
        if factor_kkt(scaled, point.unknowns, 1.0, diagonal, system, point.gradient, step) != 0:
            return None
        following = module.with_pinned_values(grid, current + scales * step)
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
        # Relative to the largest value of the same quantity: a slack may be small everywhere.
        largest = np.zeros(start.size)
        for values, sizes in zip(module.views(grid, start), module.views(grid, largest), strict=True):
            sizes[:] = np.abs(values).max(axis=(0, 1))
        beyond = np.maximum(lower - current, current - upper)[bounded]
        if np.max(beyond / np.where(largest > 0.0, largest, np.maximum(scales, np.abs(current)))[bounded]) > BEYOND:
            return None
    return np.asarray(current)


def _error(module: ControlModule, result: Result, grid: Grid, optimum: Vector, rows: Indices) -> DiscretisationError:
    """Return the error that follows from the change between a result and the optimum on double steps.

    The error of the states includes the errors of free parameters. `rows` are the indices of the remaining nodes.
    """
    assert result.cost is not None
    _, q, p, *_ = module.unpack(grid, optimum)
    table, coarse = np.column_stack([result.q, result.p]), np.column_stack([q, p])
    names, times = [*result.names["q"], *result.names["p"]], result.t[rows]
    finite = [i for i in range(table.shape[1]) if np.isfinite(table[:, i]).all()]
    changes = np.abs(coarse - table[rows])[:, finite] / scales_of(table[:, finite], bool(module.metadata.relaxation))
    node, column = np.unravel_index(int(np.argmax(changes)), changes.shape)
    states, quantity, time = float(changes[node, column]), names[finite[column]], float(times[node])
    for name, value in free_parameters(module, optimum).items():
        change = _relative(value, result.summary[name])
        if change > states:
            states, quantity, time = change, name, float(result.t[-1])
    cost = corrected_cost(grid, module.evaluate(grid, optimum))
    if segments := segments_of(module.metadata):
        quantity, segment = segments.split(quantity)
        time += (segment - 1) * float(result.t[-1] - result.t[0])
    factor = 2.0 ** order_of_optima(module) - 1.0
    return DiscretisationError(states / factor, _relative(cost, result.cost) / factor, quantity, time)


def motion_error(
    module: SimulateModule, result: Result, other: Result | SimulateAttempt, steps: int
) -> DiscretisationError | None:
    """Return the estimated discretisation error of a simulation, from another one with a number of `steps`.

    This number is a part or a multiple of the steps of the simulation. Both store the states of every step, or of every
    k-th step with the same k. Return None if they have no common times other than the start, or if a difference is not
    finite.
    """
    ratio, multiple = max(1, result.steps // steps), max(1, steps // result.steps)
    times, others = result.t[::ratio], other.t[::multiple]
    count = min(times.size, others.size)
    span = abs(float(result.t[-1] - result.t[0]))
    common = np.flatnonzero(np.abs(times[:count] - others[:count]) <= SAME_TIME * span)
    if common.size < 2:
        return None
    table, compared = np.column_stack([result.q, result.p]), np.column_stack([other.q, other.p])
    names = [*result.names["q"], *result.names["p"]]
    largest = np.abs(table).max(axis=0)
    is_zero = largest <= ROUNDING * np.sqrt(result.steps) * largest.max()  # but for accumulated rounding errors
    scales = np.where(is_zero, largest.max() or 1.0, largest)
    changes = np.abs(compared[::multiple][common] - table[::ratio][common]) / scales
    if not np.isfinite(changes).all():
        return None
    node, column = np.unravel_index(int(np.argmax(changes)), changes.shape)
    order = float(module.metadata.order)
    part = 1.0 / (ratio**order - 1.0) if ratio > 1 else 1.0 / (1.0 - multiple**-order)
    states = max(part * float(changes[node, column]), float(np.finfo(float).eps))  # the states are rounded
    return DiscretisationError(states, None, names[column], float(times[common[node]]))
