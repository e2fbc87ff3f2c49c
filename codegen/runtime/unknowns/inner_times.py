"""Inner times are nodes: the grid that has them."""

import numpy as np

from codegen.runtime.optimise.counts import checked_times
from codegen.runtime.stand_ins.example import BODIES, INNER_FIRST, INNER_PRESENT, INNER_TIMES

AT_NODE = 1e-9  # parts of the duration by which a node may miss an inner time


def inner_fractions(steps, duration, times, fractions):
    """The lengths (N,) of intervals in parts of the duration, with all `times` (INNER_TIMES,) among the nodes.

    `fractions`, if given, are those of the caller. ValueError where they miss a time, for too few steps, and for times
    that are not in order between start and end.
    """
    steps, duration = checked_times(steps, duration)
    ends = np.array([*times, duration], dtype=float) / duration
    lengths = np.diff(ends, prepend=0.0)
    if not (lengths > AT_NODE).all():
        raise ValueError(f"inner times must ascend from 0 to the duration, got {list(times)} in {duration:g}")
    if fractions is not None:
        nodes = np.cumsum(np.ravel(np.asarray(fractions, dtype=float)))
        missed = [time for time, end in zip(times, ends) if not (np.abs(nodes - end) < AT_NODE).any()]
        if missed:
            raise ValueError(f"grid must have a node at the inner time {missed[0]:g}")
        return fractions
    if steps < lengths.size:
        raise ValueError(f"steps must be at least {lengths.size}, as {len(times)} inner times are nodes, got {steps}")
    counts = shared_out(steps, lengths)
    return np.repeat(lengths / counts, counts)


def shared_out(steps, lengths):
    """How many of all intervals each segment gets, one at least: one after the other goes where they are longest."""
    counts = np.maximum(1, np.floor(steps * lengths * (1.0 + AT_NODE)).astype(np.int64))
    while counts.sum() > steps:
        counts[np.argmin(np.where(counts > 1, lengths / counts, np.inf))] -= 1
    while counts.sum() < steps:
        counts[np.argmax(lengths / counts)] += 1
    return counts


def with_inner_times(grid):
    """The grid with the numbers of the nodes at inner times, which it has; the times are those of the nodes exactly."""
    times = grid.parameters[0, INNER_FIRST : INNER_FIRST + INNER_TIMES]
    numbers = np.abs(grid.nodes[:, None] * grid.h - times).argmin(axis=0)
    grid.parameters[:, INNER_FIRST : INNER_FIRST + INNER_TIMES] = grid.nodes[numbers] * grid.h
    return grid._replace(inner=tuple(numbers.tolist()))


def through_inner_times(grid, values, numbers, wanted, at_start, at_end):
    """Values (BODIES, N + 1) at nodes, moved along straight lines to those that are `wanted` at some inner times.

    They stay as they are `at_start` and `at_end`, where that is true.
    """
    known, moved = [grid.inner[number] for number in numbers], values.copy()
    for body in range(BODIES):
        there = [np.ravel(value)[body % np.size(value)] for value in wanted]
        missing = np.array(there) - values[body, known]
        nodes = np.concatenate([[0] * at_start, known, [grid.steps] * at_end]).astype(np.int64)
        missing = np.concatenate([[0.0] * at_start, missing, [0.0] * at_end])
        moved[body] += np.interp(grid.nodes, grid.nodes[nodes], missing)
    return moved


def without_inner_unknown(grid, number):
    """Which nodes (N + 1,) do not have an unknown, the `number`th of those that belong to inner times."""
    absent = np.ones(grid.steps + 1, bool)
    absent[np.array(grid.inner)[INNER_PRESENT[:, number]]] = False
    return absent
