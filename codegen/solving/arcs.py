"""Arcs of a solution, on which the same bounds and inequalities are active, and the gaps between them.

Between two arcs lies a switching time. On an interval that contains it a control is a mean of two, and everything after
it is off by as much; so intervals are made short there, until the gap does not matter.

How large the error of a solution is: compared with one on the bisected grid, as a whole and interval by interval.
Quantities are coordinates, momenta, and the cost up to each node; each is measured in parts of its own largest value.

The discretisation error of a solution, estimated on double steps: two intervals in one. On the grid of double steps the
solution leaves residuals, the defects of its steps. Newton's method with the same active bounds turns them into
changes: of states by the KKT matrix, and of the cost by the Lagrangian, where each defect has the multiplier of its
equation as weight. Both changes are 2^p - 1 times the error; p is the order of the optima. A step or two of Newton's
method, on half as many intervals, take no longer than one iteration of the solve. Where active bounds differ on the two
grids, or the solution is no minimum on the coarser one, the optimum on double steps is searched for. Sources:
Richardson (1911); Becker and Rannacher (2001), An optimal control approach to a posteriori error estimation in finite
element methods, Acta Numerica 10, section 2; Hairer, Norsett and Wanner (1993), Solving ordinary differential equations
I, II.4, for double steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.runtime.record import Kind, Sites
from codegen.runtime.search import callbacks
from codegen.runtime.search.linear_system import allocate_system, factor_kkt
from codegen.runtime.search.parts import interval_parts
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import corrected_cost
from codegen.solving.loading import ControlModule, Grid, Indices, Matrix, Vector, time_grid
from codegen.solving.results.control import bound_distances, held_at_bounds
from codegen.solving.results.result import DiscretisationError, Result
from codegen.solving.results.segments import segments_of

LEAST_ARC = 4
"""Intervals of an arc; what is shorter is part of a gap."""
SECANTS = 8
"""Iterations for a switching time."""
LEAST_JUMP = 0.05
"""Part of the range of a control that it jumps by at least where its switching time is looked for."""
BESIDE, FAR = 3, 12
"""Nodes beside a gap to which its errors reach, as far as they matter for lengths, or are seen at all."""
MOST_GAPS = 40
"""Gaps of a phase: where there are more, controls chatter, and there are no arcs to be told apart."""

Kinds = NDArray[np.int8]


@dataclass(frozen=True)
class Gap:
    """Where a switching time lies: a phase, places from zero to one in it, and the time itself if it could be told."""

    phase: int
    begin: float
    end: float
    switch: float | None = None


def gaps(module: ControlModule, result: Result) -> list[Gap]:
    """Where the arcs of any unknown with bounds end; none in a phase in which there are too many."""
    found: list[Gap] = []
    for phase, places, runs in _all_runs(module, result):
        own = []
        for (_, last, one), (first, _, other) in pairwise(runs):
            if one != other or first - last > 1:
                own.append(Gap(phase, float(places[last]), float(places[min(first + 1, places.size - 1)])))
        found += own
    merged = _merged(found)
    few = [gap for gap in merged if sum(other.phase == gap.phase for other in merged) <= MOST_GAPS]
    grid = time_grid(module, result.steps, result.grid)
    return [replace(gap, switch=_switching_time(result, grid, gap)) for gap in few]


def _switching_time(result: Result, grid: Grid, gap: Gap) -> float | None:
    """When a control jumps from its course before a gap to that after it, such that its integral is what it is.

    Both courses are straight lines through two intervals that lie farther away; the control is that which jumps most.
    """
    u, steps = result.u, result.steps
    if u is None or len(u) != result.t.size - 1:
        return None
    nodes = grid.nodes[gap.phase * steps : (gap.phase + 1) * steps + 1] / steps - gap.phase
    window = around(nodes, gap, BESIDE)
    first, last = window.start, window.stop - 1
    if first < 2 or last > steps - 2:
        return None
    own, middles, lengths = u[gap.phase * steps :][:steps], 0.5 * (nodes[:-1] + nodes[1:]), np.diff(nodes)
    jumps = np.abs(own[first - 1] - own[last])
    column = int(np.argmax(jumps / np.maximum(np.ptp(own, axis=0), 1e-300)))
    values = own[:, column]
    before = _line(middles[first - 2 : first], values[first - 2 : first])
    after = _line(middles[last : last + 2], values[last : last + 2])
    left, right = float(nodes[first]), float(nodes[last])
    total = float(values[first:last] @ lengths[first:last])
    time = 0.5 * (left + right)
    for _ in range(SECANTS):
        jump = np.polyval(before, time) - np.polyval(after, time)
        if abs(jump) < LEAST_JUMP * np.ptp(values):
            return None
        found = np.polyint(before), np.polyint(after)
        area = np.polyval(found[0], time) - np.polyval(found[0], left)
        area += np.polyval(found[1], right) - np.polyval(found[1], time)
        time = float(np.clip(time + (total - area) / jump, left, right))
    return time if left < time < right else None


def _line(times: Vector, values: Vector) -> Vector:
    slope = (values[1] - values[0]) / (times[1] - times[0])
    return np.array([slope, values[0] - slope * times[0]])


def around(nodes: Vector, gap: Gap, margin: int) -> slice:
    """The nodes of a phase, of which the places are given, in a gap and beside it: errors there say little of arcs."""
    first, last = np.searchsorted(nodes, [gap.begin + 1e-12, gap.end - 1e-12])
    return slice(max(0, int(first) - margin), int(last) + margin + 1)


def _merged(found: list[Gap]) -> list[Gap]:
    """Gaps that overlap as one."""
    out: list[Gap] = []
    for gap in sorted(found, key=lambda gap: (gap.phase, gap.begin)):
        if out and out[-1].phase == gap.phase and gap.begin <= out[-1].end:
            out[-1] = Gap(gap.phase, out[-1].begin, max(out[-1].end, gap.end))
        else:
            out.append(gap)
    return out


def _all_runs(module: ControlModule, result: Result) -> Iterator[tuple[int, Vector, list[tuple[int, int, int]]]]:
    grid = time_grid(module, result.steps, result.grid)
    for phase, kinds in _kinds(module, result):
        places = grid.nodes[phase * result.steps : (phase + 1) * result.steps + 1] / result.steps - phase
        # First and last interval, and kind, of all runs that are no gaps.
        ends = np.flatnonzero(np.diff(kinds)) + 1
        runs = [(int(part[0]), int(part[-1]), int(kinds[part[0]])) for part in np.split(np.arange(kinds.size), ends)]
        long = [run for run in runs if run[1] - run[0] + 1 >= LEAST_ARC]
        yield phase, places, (long or [(0, kinds.size - 1, 0)])


def _kinds(module: ControlModule, result: Result) -> Iterator[tuple[int, Kinds]]:
    """What is active of every unknown with bounds, on all intervals of a phase, of every body."""
    if not module.metadata.inequalities or result.unknowns is None:
        return
    generated: Any = module
    grid = time_grid(module, result.steps, result.grid)
    primal, bounded = module.primal_unknowns(grid), np.zeros(result.unknowns.size, bool)
    below, above = bound_distances(module, grid, result.unknowns)
    slopes = callbacks.stationarity(grid, result.unknowns)
    lower, upper = module.variable_bounds(grid)
    width = (upper - lower)[primal]
    close = np.minimum(below, above)
    # Between two bounds the distance tells, beside one the slope that it holds.
    active = np.where(np.isfinite(width), close < CLOSE * width, np.abs(slopes) > close)
    kind = np.zeros(result.unknowns.size, np.int8)
    kind[primal] = np.where(active, np.where(below < above, -1, 1), 0)
    bounded[primal] = np.isfinite(close)
    (nodes, intervals), (at_nodes, inside) = (generated.views(grid, table.astype(float)) for table in (kind, bounded))
    own = np.concatenate([nodes[:, 1:], intervals], axis=2)
    has = np.concatenate([at_nodes[:, 1:], inside], axis=2).any(axis=1)
    for phase in range(module.metadata.phases):
        rows = slice(phase * result.steps, (phase + 1) * result.steps)
        for body, column in zip(*np.nonzero(has), strict=True):
            yield phase, own[body, rows, column].astype(np.int8)


CLOSE = 1e-3
"""Part of the distance between two bounds within which one is active."""


NEGLIGIBLE = 1e-12
"""A quantity that is no larger counts as zero."""


@dataclass(frozen=True)
class Estimate:
    """The largest relative difference between two solutions: of which quantity, and at what time."""

    difference: float
    quantity: str
    time: float


def trajectories(module: ControlModule, result: Result) -> tuple[Matrix, tuple[str, ...]]:
    """Coordinates, momenta and the cost so far at all nodes, (nodes, quantities), in parts of sizes; their names."""
    # The discrete cost up to each node, of all bodies together, without ends, and without samples, where it jumps.
    grid: Any = time_grid(module, result.steps, result.grid)
    if module.metadata.observations is not None:
        first = module.problem.structure.first_sample
        grid = grid._replace(parameters=np.ascontiguousarray(grid.parameters[:, :first]))
    costs = interval_parts(grid, result.unknowns)[..., -1]
    table = np.column_stack([result.q, result.p, np.concatenate([[0.0], np.cumsum(costs.sum(axis=0))])])
    names = [*result.names["q"], *result.names["p"], "the cost"]
    kept = [i for i in range(table.shape[1]) if np.isfinite(table[:, i]).all()]
    return table[:, kept], tuple(names[i] for i in kept)


def sizes_of(table: Matrix) -> Vector:
    """The largest value of every quantity; one where it is next to zero."""
    sizes = np.abs(table).max(axis=0)
    return np.where(sizes > NEGLIGIBLE, sizes, 1.0)


def compared(module: ControlModule, coarse: Result, fine: Result, without: Sequence[Gap] = ()) -> Estimate:
    """The largest relative difference of two results at nodes of the coarser grid, and of costs and parameters.

    Nodes in the gaps `without`, and beside them, do not count.
    """
    table, names = trajectories(module, fine)
    before, _ = trajectories(module, coarse)
    if before.shape[1] != table.shape[1]:
        return Estimate(np.inf, "a state", 0.0)
    differences = np.abs(table[::2] - before) / sizes_of(table)
    for gap in without:
        first = gap.phase * coarse.steps
        touched = around(
            time_grid(module, coarse.steps, coarse.grid).nodes[first:] / coarse.steps - gap.phase, gap, FAR
        )
        differences[first : first + coarse.steps + 1][touched] = 0.0
    node, column = np.unravel_index(int(np.argmax(differences)), differences.shape)
    worst = Estimate(float(differences[node, column]), names[column], float(fine.t[::2][node]))
    for name, (old, new) in _numbers(module, coarse, fine).items():
        difference = abs(new - old) / (abs(new) if abs(new) > NEGLIGIBLE else 1.0)
        if difference > worst.difference:
            worst = Estimate(difference, name, float(fine.t[-1]))
    return worst


def _numbers(module: ControlModule, coarse: Result, fine: Result) -> dict[str, tuple[float, float]]:
    """Cost, duration and free parameters of both."""
    names = ("duration", *module.metadata.free_parameters)
    pairs = {name: (coarse.summary[name], fine.summary[name]) for name in names}
    if coarse.cost is not None and fine.cost is not None:
        pairs["the cost"] = coarse.cost, fine.cost
    return pairs


def interval_errors(module: ControlModule, fine: Result, order: int) -> Matrix:
    """What every interval of the coarser grid errs by: (phases, N), from a solution on the bisected grid.

    It is the distance of the inner node from a polynomial of degree p = `order` through nodes of the coarser grid
    around it, of the order p + 1 as the error of a step. Of several polynomials, more to the left or to the right, the
    closest counts, so that a kink at a node is none of its neighbours' business.
    """
    table, _ = trajectories(module, fine)
    table = table / sizes_of(table)
    phases = module.metadata.phases
    steps = fine.steps // 2
    out = np.empty((phases, steps))
    for phase in range(phases):
        first = phase * fine.steps
        times, own = fine.t[first : first + fine.steps + 1], table[first : first + fine.steps + 1]
        skipped = min(phase, 1)  # the node at a switch has the values before a jump
        out[phase, skipped:] = _departures(times[2 * skipped :], own[2 * skipped :], order)
        if skipped:
            out[phase, 0] = out[phase, min(1, steps - 1)]
    return out


def _departures(times: Vector, table: Matrix, order: int) -> Vector:
    """How far every second row is from the closest polynomial through its neighbours."""
    nodes, values = times[::2], table[::2]
    between, truth = times[1::2], table[1::2]
    count = min(order + 1, nodes.size)
    best = np.full(between.size, np.inf)
    intervals = np.arange(between.size)
    for left in range(count - 1):  # how many nodes of the stencil lie left of the interval's left node
        starts = np.clip(intervals - left, 0, nodes.size - count)
        indices = starts[:, None] + np.arange(count)
        weights = _lagrange(nodes[indices], between)
        guess = np.einsum("ki,kij->kj", weights, values[indices])
        best = np.minimum(best, np.abs(guess - truth).max(axis=1))
    return best


def _lagrange(nodes: Matrix, at: Vector) -> Matrix:
    """The values (K, m) of the Lagrange polynomials of K sets of nodes (K, m), each at an index of its own."""
    weights = np.ones_like(nodes)
    for i in range(nodes.shape[1]):
        for j in range(nodes.shape[1]):
            if i != j:
                weights[:, i] *= (at - nodes[:, j]) / (nodes[:, i] - nodes[:, j])
    return weights


STEPS, CONTRACTION, SETTLED = 4, 0.5, 0.1
"""The most Newton steps; the least factor by which they shrink; the largest share of the last one in the change."""
HELD, LOOSE = 1e8, 1e-12
"""Curvatures, in parts of sizes, of unknowns on bounds that hold them, and of others with bounds."""
BEYOND = 0.01
"""Part of its size by which an unknown leaves its bounds where these do not hold as they did."""

Search = Callable[[int, Vector, Vector | None], Vector | None]
"""The optimum for a number of intervals, a start and fractions of the duration; None where none was found."""


def discretisation_error(module: ControlModule, result: Result, search: Search) -> DiscretisationError | None:
    """Estimate the error of a solution, relative to the largest value of every state, and of the cost.

    Newton's method is tried before `search`. None where there is no pair of intervals, and where no optimum was found
    on double steps, so that nothing is known of the error.
    """
    assert result.unknowns is not None
    fine = time_grid(module, result.steps, result.grid)
    kept = _kept(result.steps, _inner(module, fine))
    phases, steps = module.metadata.phases, kept.size - 1
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
    return tuple(map(int, grid.inner)) if module.metadata.inner_times else ()


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


def _carried_on(module: Any, fine: Grid, grid: Grid, rows: Indices, unknowns: Vector, start: Vector) -> Vector | None:
    """The optimum on double steps by Newton's method, with bounds that hold as on the finer grid.

    None where steps do not settle, the reduced Hessian is not positive definite, or other bounds would have to hold.
    """
    scaled = scaled_grid(grid, start)
    sizes = scaled.sizes if scaled.sizes.size else np.ones(start.size)
    held = bounded = np.zeros(start.size, dtype=bool)
    if module.metadata.inequalities:
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
    free = module.metadata.free_parameters
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


def order_of_optima(module: ControlModule) -> int:
    """The order at which costs converge: the scheme's own, but 2 at most where there are controls.

    A control that is constant on each interval, or linear between nodes, approximates a smooth one at order 2, and the
    cost at its minimum no better, whatever the scheme of the motion. With controls at stages it has the scheme's order.
    """
    order, metadata = int(module.metadata.order), module.metadata
    return min(order, 2) if metadata.control_names and metadata.controls != Sites.STAGES else order
