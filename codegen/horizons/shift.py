"""The shifted solution: what a plan says of the time that follows, as the start of the next solve.

By a whole number of intervals values move to earlier nodes and intervals; by another, they are interpolated, linearly
between nodes, and in the mean where controls are constant. Beyond the end nodes follow the last interval's straight
line, and controls stay. Source: Diehl, Bock and Schloeder (2005), A real-time iteration scheme for nonlinear
optimization in optimal feedback control, SIAM J. Control Optim. 43.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.interfaces import Grid, Indices, Vector


@dataclass(frozen=True, eq=False)
class Shift:
    """A linear map of unknowns (n,): each is a sum of two others, `one` and `two`, with weights.

    `is_single` says that it is the first of them alone.
    """

    one: Indices
    two: Indices
    weight_one: Vector
    weight_two: Vector
    is_single: bool

    def __call__(self, unknowns: Vector) -> Vector:
        """The unknowns (n,) of the plan as it is at the next sampling time."""
        if self.is_single:
            return self.weight_one * unknowns.take(self.one)
        return self.weight_one * unknowns[self.one] + self.weight_two * unknowns[self.two]


def shift_by(module: Any, grid: Grid, intervals: float) -> Shift:
    """The shift by so many intervals of a grid, a number that need not be whole; intervals are equally long.

    What only the ends have, such as their velocities, stays where it is, since it is zero at inner nodes; so do
    unknowns that no node has.
    """
    numbers = np.arange(grid.is_multiplier.size, dtype=float)
    of_nodes, of_intervals = module.views(grid, numbers)
    one, two, first, second = numbers.copy(), numbers.copy(), np.ones(numbers.size), np.zeros(numbers.size)
    (one_node, one_interval), (two_node, two_interval) = (module.views(grid, indices) for indices in (one, two))
    (node_first, interval_first), (node_second, interval_second) = (
        module.views(grid, weights) for weights in (first, second)
    )
    # Nodes lie on the line through two neighbours, which beyond the end is that of the last interval.
    places, last = np.arange(grid.steps + 1) + intervals, grid.steps - 1
    left = np.minimum(places.astype(int), last)
    one_node[:], two_node[:] = of_nodes[:, left], of_nodes[:, left + 1]
    node_second[:] = (places - left)[:, None]
    node_first[:] = 1.0 - node_second
    # Intervals have the mean of what two of them have.
    places = places[:-1]
    left = places.astype(int)
    one_interval[:], two_interval[:] = (of_intervals[:, np.minimum(which, last)] for which in (left, left + 1))
    interval_second[:] = np.where(left < last, places - left, 0.0)[:, None]
    interval_first[:] = 1.0 - interval_second
    for only in module.problem.structure.only_at_ends:
        one_node[:, :, only] = of_nodes[:, :, only]
        node_first[:, :, only] = node_second[:, :, only] = 0.0
        node_first[:, [0, -1], only] = 1.0
    return Shift(one.astype(np.intp), two.astype(np.intp), first, second, not second.any())
