"""The log of a search, which also tells when its time is up."""

import math
from time import perf_counter

import numpy as np

from codegen.runtime.stand_ins.example import SCALED


class Log:
    """The rows of all iterates; `watch`, if there is one, is called with the number of each and its row."""

    def __init__(self, time_limit=math.inf, watch=None):
        if not time_limit > 0.0:
            raise ValueError(f"time_limit is {time_limit!r}, expected a positive number of seconds")
        self.rows, self.watch, self.deadline = [], watch, perf_counter() + time_limit

    def append(self, grid, point, *others):
        """Keep a row about a point, in the problem's own units, and show it to whoever watches.

        Stationarity is the change of the cost with parts of sizes where the grid has them.
        """
        row = point.cost, point.residual, point.stationarity, *others
        if SCALED and grid.sizes.size:
            residual = np.abs(point.gradient / grid.forces)[grid.is_multiplier].max(initial=0.0)
            row = point.cost / grid.weight, residual, point.stationarity / grid.weight, *others
        self.rows.append(row)
        if self.watch is not None:
            self.watch(len(self.rows) - 1, row)

    def is_late(self):
        """Whether the time is up."""
        return perf_counter() > self.deadline
