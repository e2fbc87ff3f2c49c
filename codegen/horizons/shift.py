"""The shifted solution: what a plan says of the time that follows, as the start of the next solve.

By a whole number of intervals values move to earlier nodes and intervals; by another, they are interpolated, linearly
between nodes, and in the mean where controls are constant. Beyond the end nodes follow the last interval's straight
line, and controls stay. Source: Diehl, Bock and Schloeder (2005), A real-time iteration scheme for nonlinear
optimization in optimal feedback control, SIAM J. Control Optim. 43, section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.loading import Grid, Indices, Vector


@dataclass(frozen=True, eq=False)
class Shift:
    """A linear map of unknowns (n,): each is a sum of two others, `one` and `two`, with weights."""

    one: Indices
    two: Indices
    weight_one: Vector
    weight_two: Vector

    def __call__(self, unknowns: Vector) -> Vector:
        """The unknowns (n,) of the plan as it is at the next sampling time."""
        return self.weight_one * unknowns[self.one] + self.weight_two * unknowns[self.two]


def shift_by(module: Any, grid: Grid, intervals: float) -> Shift:
    """The shift by so many intervals of a grid, a number that need not be whole; intervals are equally long.

    What only the ends have, such as their velocities, stays where it is, since it is zero at inner nodes; so do
    unknowns that no node has.
    """
    size = grid.is_multiplier.size
    numbers = np.arange(size, dtype=float)
    one, two = numbers.copy(), numbers.copy()
    weights = np.ones(size), np.zeros(size)
    last = grid.steps
    own = [module.views(grid, numbers), module.views(grid, one), module.views(grid, two)]
    shares = [module.views(grid, weight) for weight in weights]
    # Nodes: on the line through two neighbours, which beyond the end is that of the last interval.
    places = np.arange(last + 1) + intervals
    left = np.minimum(places.astype(int), last - 1)
    own[1][0][:], own[2][0][:] = own[0][0][:, left], own[0][0][:, left + 1]
    shares[0][0][:], shares[1][0][:] = (1.0 - (places - left))[:, None], (places - left)[:, None]
    # Intervals: the mean of what two of them have.
    places = np.arange(last) + intervals
    left = places.astype(int)
    part = np.where(left < last - 1, places - left, 0.0)[:, None]
    own[1][1][:] = own[0][1][:, np.minimum(left, last - 1)]
    own[2][1][:] = own[0][1][:, np.minimum(left + 1, last - 1)]
    shares[0][1][:], shares[1][1][:] = 1.0 - part, part
    for only in getattr(module, "ONLY_AT_ENDS", ()):
        own[1][0][:, :, only] = own[0][0][:, :, only]
        shares[0][0][:, :, only], shares[1][0][:, :, only] = 0.0, 0.0
        shares[0][0][:, [0, -1], only] = 1.0
    return Shift(one.astype(np.intp), two.astype(np.intp), *weights)
