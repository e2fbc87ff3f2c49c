"""The log of a search, which also tells when its time is up."""

import math
from time import perf_counter


class Log:
    """The rows of all iterates; `watch`, if there is one, is called with the number of each and its row."""

    def __init__(self, time_limit=math.inf, watch=None):
        if not time_limit > 0.0:
            raise ValueError(f"time_limit is {time_limit!r}, expected a positive number of seconds")
        self.rows, self.watch, self.deadline = [], watch, perf_counter() + time_limit
        self.weight = 1.0  # by which costs in rows are multiplied

    def append(self, row):
        """Keep a row, and show it to whoever watches."""
        if self.weight != 1.0:
            row = row[0] / self.weight, *row[1:]
        self.rows.append(row)
        if self.watch is not None:
            self.watch(len(self.rows) - 1, row)

    def is_late(self):
        """Whether the time is up."""
        return perf_counter() > self.deadline
