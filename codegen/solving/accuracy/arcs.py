"""Arcs of a solution, on which the same bounds and inequalities are active, and the gaps between them.

Between two arcs lies a switching time. On an interval that contains it a control is a mean of two, and everything after
it is off by as much; so intervals are made short there, until the gap does not matter.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.interfaces import ControlModule, Grid, Vector, time_grid
from codegen.runtime.search import callbacks
from codegen.solutions.control import bound_distances
from codegen.solutions.result import Result

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
    """Coefficients, the highest power first, of the straight line through two points."""
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
        yield phase, places, _runs(kinds)


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


def _runs(kinds: Kinds) -> list[tuple[int, int, int]]:
    """First and last interval, and kind, of all runs that are no gaps."""
    ends = np.flatnonzero(np.diff(kinds)) + 1
    runs = [(int(part[0]), int(part[-1]), int(kinds[part[0]])) for part in np.split(np.arange(kinds.size), ends)]
    long = [run for run in runs if run[1] - run[0] + 1 >= LEAST_ARC]
    return long or [(0, kinds.size - 1, 0)]
