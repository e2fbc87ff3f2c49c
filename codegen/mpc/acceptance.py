"""The choice of the plan that a controller applies, and the time limits of its searches.

A plan is evaluated outside the solver, and the better of two plans is applied. With a deadline, an iteration begins
only if there is time for the iteration and for the evaluation of its result. The expected times are learned from
measurements, because they depend on the problem and on the load of the machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from statistics import median
from time import perf_counter

import numpy as np

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.iterates import Search, stored
from codegen.runtime.search.point import Point
from codegen.runtime.search.workspace import COST, ITERATIONS, RESIDUAL
from codegen.solving.loading import ControlModule, Grid, Matrix

ALLOWED = 10.0
"""Largest residual and gradient of the Lagrangian at a solution, relative to the tolerance, as in `control_verdict`."""
PART, SHORTEST = 0.5, 1e-9
"""Part of the remaining time after which the compiled search returns its iterate; least seconds of an iteration."""


class BestIterate:
    """The log of a search for a plan, which keeps the `best` iterate and ends the search in time.

    The search calls the methods of its log. No iteration begins after `limit` seconds of `clock`, or after `most`
    iterations and restoration steps. With a limit, each call of the compiled search takes a part of the remaining time;
    the first iteration is assumed to take `expected` seconds. The best iterate is the cheapest iterate with a residual
    up to `feasible`, in the problem's own units.
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
        """Return the number of iterations for the next call of the compiled search, at most `most` and `affordable`.

        `done` iterations are finished. Without time or iterations left the number is 0, for a convergence test alone.
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
        """Record the iterate at which the compiled search has returned; `rows` (k, 6) are the logged iterates.

        The rows include the last iterate only if the search is over.
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
        """Record an iterate of a linear-quadratic problem, whose search has no time limit."""
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
        """Return True if time or iterations are used up; feasibility restorations call this at each step."""
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
        """Add the new iterations of a search that has finished `done` iterations; return the number of new ones."""
        new = done - self._before if done >= self._before else done  # a smaller number belongs to a new search
        self._iterations, self._before = self._iterations + new, done
        return new

    @property
    def count(self) -> int:
        """Number of iterations and restoration steps."""
        return self._iterations + self._restorations

    def rest(self, now: float) -> float | None:
        """Return the seconds of the last iteration plus the time since, up to `now`, or None without an iteration."""
        return self._iteration + now - self._returned if self._iterations else None


def holds(module: ControlModule, grid: Grid, plan: Point, tolerance: float) -> bool:
    """Return True if residual and gradient of the Lagrangian of a plan are within ALLOWED * tolerance, without scaling.

    Derivatives with respect to variables near a bound are multiplied by the distance from the bound, at most one.
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
    """Return the better of two points of a search.

    A point is feasible if its residual is at most `feasible`. A feasible point is better than an infeasible point. Of
    two feasible points the cheaper one is better, and of two others the one with the smaller residual. If both are
    equal, `one` is returned.
    """
    violations = max(one.residual, feasible), max(other.residual, feasible)
    if not violations[0] < np.inf or violations[1] < violations[0]:
        return other
    return other if violations[1] == violations[0] and other.cost < one.cost else one


MOST = 0.75  # quantile of the measured times that is expected; longer times are outliers of a busy machine
MARGIN = 1.05  # safety factor: an iteration begins only if this multiple of its expected time remains
RATE = 0.02
"""Relative change of an expectation by a measurement: it rises by RATE * MOST, or falls by RATE * (1 - MOST)."""
IN_TURN = 4
"""The k-th successive measurement above the expectation counts k - IN_TURN times, at least once.

After many such measurements the machine has become slower, and the expectation must rise fast.
"""
FORGOTTEN = 0.02
"""Relative step of an expectation towards the quickest time, after a sampling time that was too short to measure."""


class Expectation:
    """The expected `seconds` of a part of `Controller.step`, a quantile of recent measurements.

    Each measurement moves the logarithm of the quantile up or down by a fixed step, whatever its distance. So an
    outlier, such as a process that had to wait, counts like any other measurement. `least` is the quickest time.
    Source: Robbins and Monro (1951), A stochastic approximation method.
    """

    def __init__(self, measured: Iterable[float]) -> None:
        measured = tuple(measured)
        self.seconds, self.least = median(measured), min(measured)
        self._above = 0

    def learn(self, seconds: float) -> None:
        """Update the expectation by a measured time."""
        self.least = min(self.least, seconds)
        self._above = self._above + 1 if seconds > self.seconds else 0
        rise = MOST * max(1, self._above - IN_TURN)
        self.seconds *= math.exp(RATE * (rise if self._above else MOST - 1.0))

    def forget(self) -> None:
        """Move the expectation towards the quickest time, after a step without time for a measurement.

        Otherwise a too long expectation would prevent all further measurements. The count of successive slow
        measurements is kept, so that the next attempt is later each time.
        """
        self.seconds += FORGOTTEN * (self.least - self.seconds)


class Pace:
    """The expected times of `Controller.step`: the `beginning` up to the first iterate, and the `rest`.

    The rest is one iteration and all work after the search. `measured` are pairs of first measurements in seconds.
    """

    def __init__(self, measured: Iterable[tuple[float, float]]) -> None:
        beginnings, rests = zip(*measured, strict=True)
        self.beginning, self.rest = Expectation(beginnings), Expectation(rests)

    def limit(self, seconds: float) -> float:
        """Return the seconds in which a search may begin iterations if `seconds` remain; -inf if it must not begin."""
        limit = seconds - MARGIN * self.rest.seconds
        return limit if limit >= self.beginning.seconds else -math.inf

    def learn(self, beginning: float | None, rest: float | None, was_late: bool) -> None:
        """Update both expectations by the times of a step; `was_late` is True if a time is None for lack of time."""
        for expectation, seconds in ((self.beginning, beginning), (self.rest, rest)):
            if seconds is not None:
                expectation.learn(seconds)
            elif was_late:
                expectation.forget()
