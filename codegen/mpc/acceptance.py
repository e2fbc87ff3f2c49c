"""The acceptance of plans within a sampling time, and the time limits of searches.

A plan is evaluated outside the solver, and the better one of two plans is applied. A search with a deadline asks at
every iterate if there is time for another iteration and for the evaluation of its result. The expected times are
learned from measurements, because they depend on the problem and on the load of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from statistics import median
from time import perf_counter

import numpy as np

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.descent import COST, ITERATIONS, RESIDUAL
from codegen.runtime.search.iterates import Search, stored
from codegen.runtime.search.point import Point
from codegen.solving.loading import ControlModule, Grid, Matrix

ALLOWED = 10.0
"""Largest residual and slope of a solution, relative to the tolerance, as in `control_verdict`."""
PART, SHORTEST = 0.5, 1e-9
"""Part of the remaining time after which a search with a deadline returns; least seconds of an iteration."""


class BestIterate:
    """The log of a search for a plan: the `best` iterate and the elapsed time.

    It replaces the log of `solve`. `limit` is the number of seconds by `clock` after which no iteration begins. The
    compiled search then returns after a part of the remaining time, which follows from the time of an iteration, at
    first `expected` seconds. The best iterate is the cheapest one with a residual up to `feasible`, in the problem's
    own units. No iteration begins after `most` iterations and restoration steps.
    """

    def __init__(
        self,
        limit: float,
        feasible: float,
        clock: Callable[[], float] = perf_counter,
        most: float = math.inf,
        expected: float = 0.0,
    ) -> None:
        self.limit, self._feasible, self._clock, self._most, self._iteration = limit, feasible, clock, most, expected
        self._restorations = self._iterations = self._before = 0
        self._begin = clock()
        self._end = self._begin + limit
        self._called = self._returned = self._begin
        self._is_asked_by_restoration = self._is_over = False
        self.beginning: float | None = None
        self.was_late, self.is_exhausted = limit <= 0.0, False
        self.best: Point | None = None

    def iterations_per_call(self, done: int, most: int, affordable: int) -> int:
        """Return the number of iterations after which the compiled search is to return.

        With no time or iterations left the search only tests for convergence.
        """
        self._called = now = self._clock()
        self._count_up_to(done)
        if self.beginning is None:
            self.beginning = now - self._begin
        count = min(most, affordable, max(0.0, self._most - self.count))
        if self.limit < math.inf:
            remaining = self._end - now
            count = min(count, 1.0 + PART * remaining // max(self._iteration, SHORTEST)) if remaining >= 0.0 else 0
        return int(count)

    def extend(self, search: Search, rows: Matrix) -> None:
        """Record the iterate at which the compiled search returns; `rows` (k, 6) are the iterates that it logged.

        They include the last one if the search is over.
        """
        self._returned = self._clock()
        work = search.work
        done = self._count_up_to(int(work.integers[ITERATIONS]))
        if done:
            self._iteration = (self._returned - self._called) / done
        self._is_asked_by_restoration, self._is_over = False, len(rows) > done
        if self.limit < math.inf and not search.grid.sizes.size:
            cost, residual = work.reals[COST], work.reals[RESIDUAL]
            if residual <= self._feasible and (self.best is None or cost < self.best.cost):
                self.best = stored(search).point

    def add(self, point: Point, _length: float) -> None:
        """Record an iterate of a linear search, which has no time limit."""
        now = self._clock()
        if self.beginning is None:
            self.beginning = now - self._begin
        else:
            self._iteration = now - self._returned
            self._iterations += 1
        self._returned = now
        if point.residual <= self._feasible and (self.best is None or point.cost < self.best.cost):
            self.best = point

    def is_late(self) -> bool:
        """Return True if time or iterations are used up; restorations ask at each step."""
        self._restorations += self._is_asked_by_restoration and not self.is_exhausted
        self._is_asked_by_restoration = True
        if self.count >= self._most and not self._is_over:
            self.is_exhausted = True
        self._is_over = False
        if self.is_exhausted:
            return True
        if self._clock() > self._end:
            self.was_late = True
            return True
        return False

    def _count_up_to(self, done: int) -> int:
        """Count the iterations of a search that has made `done` of them; return the number of new ones."""
        new = done - self._before if done >= self._before else done  # a smaller number belongs to a new search
        self._iterations, self._before = self._iterations + new, done
        return new

    @property
    def count(self) -> int:
        """Number of iterations and restoration steps."""
        return self._iterations + self._restorations

    def rest(self, now: float) -> float | None:
        """Return the seconds of the last iteration and all work after it, or None without an iteration."""
        return self._iteration + now - self._returned if self._iterations else None


def holds(module: ControlModule, grid: Grid, plan: Point, tolerance: float) -> bool:
    """Return True if residual and slopes are within the tolerance, without scaling.

    The slope of a variable near its bound counts times the distance from the bound, at most one.
    """
    most = ALLOWED * tolerance
    if not plan.residual <= most:  # also for NaN
        return False
    if plan.stationarity <= most:
        return True
    (steep,) = ((np.abs(plan.gradient) > most) & ~grid.is_multiplier).nonzero()
    if not steep.size or not module.metadata.inequalities:
        return not steep.size
    slopes, unknowns = plan.gradient[steep], plan.unknowns[steep]
    lower, upper = bounds_of(grid)
    distances = np.where(slopes > 0.0, unknowns - lower[steep], upper[steep] - unknowns)
    return bool((np.abs(slopes) * np.clip(distances, 0.0, 1.0) <= most).all())


def better(one: Point, other: Point, feasible: float) -> Point:
    """Return the better one of two points of a search.

    A plan with a residual up to `feasible` is better than one without. Of two such plans the cheaper one is better, of
    two others the one with the smaller residual. The first one is returned if they are equal.
    """
    violations = max(one.residual, feasible), max(other.residual, feasible)
    if not violations[0] < np.inf or violations[1] < violations[0]:
        return other
    return other if violations[1] == violations[0] and other.cost < one.cost else one


MOST = 0.75
"""Quantile of measured times that an expectation follows; longer times are outliers of a busy machine."""
MARGIN = 1.05
"""Factor on the expected time without which no iteration begins."""
RATE = 0.02
"""Step of an expectation for a measurement: a fall is 1 - MOST of the rate, a rise MOST of it."""
IN_TURN = 4
"""Number of successive measurements above the expectation that count once each.

Every further one counts once more than the one before, because the machine has become slower.
"""
FORGOTTEN = 0.02
"""Relative step towards the quickest time after a step without a measurement for lack of time."""


class Expectation:
    """The expected `seconds` of a part of a step, a quantile of recent measurements.

    The quantile changes by steps in the logarithm that do not depend on the distance of measurements. So an outlier,
    such as a process that had to wait, counts like any other measurement. `least` is the quickest time. Source: Robbins
    and Monro (1951), A stochastic approximation method.
    """

    def __init__(self, measured: Iterable[float]) -> None:
        measured = tuple(measured)
        self.seconds, self.least = median(measured), min(measured)
        self._above = 0

    def learn(self, seconds: float) -> None:
        """Update the expectation by a measurement."""
        self.least = min(self.least, seconds)
        self._above = self._above + 1 if seconds > self.seconds else 0
        rise = MOST * max(1, self._above - IN_TURN)
        self.seconds *= math.exp(RATE * (rise if self._above else MOST - 1.0))

    def forget(self) -> None:
        """Move the expectation towards the quickest time, after a step without time for a measurement.

        Without this there would never be a measurement again. The count of successive slow measurements is kept, so the
        next one is later each time.
        """
        self.seconds += FORGOTTEN * (self.least - self.seconds)


class Pace:
    """The expected times of steps: the `beginning` up to the first iterate, and an iteration with the `rest` of the
    step.

    Both start from `measured` pairs of seconds.
    """

    def __init__(self, measured: Iterable[tuple[float, float]]) -> None:
        beginnings, rests = zip(*measured, strict=True)
        self.beginning, self.rest = Expectation(beginnings), Expectation(rests)

    def limit(self, seconds: float) -> float:
        """Return the seconds in which a search may begin iterations, negative if it is not to begin."""
        limit = seconds - MARGIN * self.rest.seconds
        return limit if limit >= self.beginning.seconds else -math.inf

    def learn(self, beginning: float | None, rest: float | None, was_late: bool) -> None:
        """Update the expectations by a step; `was_late` if a missing part had no time."""
        for expectation, seconds in ((self.beginning, beginning), (self.rest, rest)):
            if seconds is not None:
                expectation.learn(seconds)
            elif was_late:
                expectation.forget()
