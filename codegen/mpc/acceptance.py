"""What a solve is worth within a sampling time: its equations evaluated again, and which of two plans is applied.

What the parts of a sampling time take, learned from those that were measured, so that deadlines are kept. A search that
a deadline ends asks at every iterate whether there is time for what comes next: an iteration, and the verdict on what
it leads to. What that takes differs from problem to problem, and from hour to hour on a busy machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.descent import COST, ITERATIONS, RESIDUAL
from codegen.runtime.search.iterates import stored
from codegen.runtime.search.point import evaluate
from codegen.solving.loading import Grid, Matrix, Vector
from codegen.solving.results.control import control_verdict
from codegen.solving.results.result import ControlAttempt, Run

ALLOWED = 10.0
"""Times the tolerance that residual and slopes of a solution may be, as in `control_verdict`."""
PART, SHORTEST = 0.5, 1e-9
"""Part of the time left after which a search with a deadline returns; seconds that an iteration takes at least."""


@dataclass(frozen=True, eq=False, slots=True)
class Candidate:
    """A plan, `unknowns` (n,), with what is evaluated there outside the solver.

    That are the gradient (n,) of the Lagrangian, cost, residual, and stationarity, the largest slope.
    """

    unknowns: Vector
    gradient: Vector
    cost: float
    residual: float
    stationarity: float


class BestIterate:
    """The log of a search for a plan: the `best` iterate, and what of the time has passed.

    It takes the place of the log that `solve` keeps. With a `limit`, the seconds by the clock after which no iteration
    begins, the compiled search returns after a part of the time that is left, by what an iteration has taken, at first
    `expected` seconds; the best is the cheapest of the iterates there whose equations hold to `feasible`, in the
    problem's own units. Nor does an iteration begin after `most` of them and of steps of restorations.
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
        self.best: Any = None

    def iterations_per_call(self, done: int, most: int, affordable: int) -> int:
        """Return after how many iterations the compiled search, which is about to be called, is to return.

        Where time or iterations are used up, it only looks whether it has come to an end.
        """
        self._called = now = self._clock()
        self._count_up_to(done)
        if self.beginning is None:
            self.beginning = now - self._begin
        count = min(most, affordable, max(0.0, self._most - self.count))
        if self.limit < math.inf:
            left = self._end - now
            count = min(count, 1.0 + PART * left // max(self._iteration, SHORTEST)) if left >= 0.0 else 0
        return int(count)

    def extend(self, search: Any, rows: Matrix) -> None:
        """Look at the iterate with which the compiled search returns; `rows` (k, 6) are those that it left behind.

        The last one is among them where the search is over.
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

    def add(self, point: Any, _length: float) -> None:
        """Look at an iterate of a linear search, which never asks whether it is late."""
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
        """Return True if the time is up, or the number of iterations; restorations ask at each of their steps."""
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
        """Count the iterations of a search that has made so many; return how many there were since it was looked at."""
        new = done - self._before if done >= self._before else done  # fewer are those of another search
        self._iterations, self._before = self._iterations + new, done
        return new

    @property
    def count(self) -> int:
        """Iterations and steps of restorations up to now."""
        return self._iterations + self._restorations

    def rest(self, now: float) -> float | None:
        """Return the seconds of the last iteration and of all after it; None where there was none."""
        return self._iteration + now - self._returned if self._iterations else None


def candidate(grid: Grid, unknowns: Vector) -> Candidate:
    """A plan with its equations evaluated."""
    point = evaluate(grid, unknowns)
    return Candidate(unknowns, point.gradient, point.cost, point.residual, point.stationarity)


def holds(module: Any, grid: Grid, found: Candidate, tolerance: float) -> bool:
    """Whether residual and slopes are within the tolerance as they stand, as they most often are."""
    most = ALLOWED * tolerance
    return found.residual <= most and (found.stationarity <= most or _is_flat(module, grid, found, most))


def is_solution(module: Any, grid: Grid, found: Candidate, run: Run, iterations: int, tolerance: float) -> bool:
    """Whether all equations hold at what a solver calls solved, as for every driver.

    Sizes, rounding and large multipliers decide, which takes ten times as long as `holds`.
    """
    claim = ControlAttempt("solved", "", iterations, found.unknowns, tolerance)
    return control_verdict(module, "newton", run, claim, grid).status == "solved"


def _is_flat(module: Any, grid: Grid, found: Candidate, most: float) -> bool:
    """Whether slopes of the Lagrangian are small, each times the distance to the bound that it leads to, one if far."""
    (steep,) = ((np.abs(found.gradient) > most) & ~grid.is_multiplier).nonzero()
    if not steep.size or not module.metadata.inequalities:
        return not steep.size
    slopes, unknowns = found.gradient[steep], found.unknowns[steep]
    lower, upper = bounds_of(grid)
    distances = np.where(slopes > 0.0, unknowns - lower[steep], upper[steep] - unknowns)
    return bool((np.abs(slopes) * np.clip(distances, 0.0, 1.0) <= most).all())


def better(one: Any, other: Any, feasible: float) -> Any:
    """The first of two plans unless the other is better, candidates or points of a search.

    That is one whose equations hold to `feasible` where those of the first do not; of two that do, the cheaper one; of
    two that do not, the one with the smaller residual.
    """
    violations = max(one.residual, feasible), max(other.residual, feasible)
    if not violations[0] < np.inf or violations[1] < violations[0]:
        return other
    return other if violations[1] == violations[0] and other.cost < one.cost else one


MOST = 0.75
"""Part of what is measured that stays below what is expected: a larger one follows what others do on a busy machine."""
MARGIN = 1.05
"""Times what is expected is the time without which no iteration begins: as much as most of the others take."""
RATE = 0.02
"""By which an expectation changes with a measurement: a fall is 1 - MOST of it, a rise MOST of it."""
IN_TURN = 4
"""Measurements above what is expected that may follow each other by chance, or after a push; each that follows counts
once more than the one before it, as on a machine that has become slower."""
FORGOTTEN = 0.02
"""Part of its distance from the quickest by which an expectation falls where nothing was measured for lack of time."""


class Expectation:
    """What a part of a step takes: `seconds` that most of those measured lately stay below.

    It is a quantile followed by steps in the logarithm whose size does not depend on how far measurements are away, so
    that one without limit, as of a process that had to wait, counts no more than another. Source: Robbins and Monro
    (1951), A stochastic approximation method. `least` is the quickest ever.
    """

    def __init__(self, measured: Iterable[float]) -> None:
        measured = tuple(measured)
        self.seconds, self.least = median(measured), min(measured)
        self._above = 0

    def learn(self, seconds: float) -> None:
        """Take account of a measurement."""
        self.least = min(self.least, seconds)
        self._above = self._above + 1 if seconds > self.seconds else 0
        rise = MOST * max(1, self._above - IN_TURN)
        self.seconds *= math.exp(RATE * (rise if self._above else MOST - 1.0))

    def forget(self) -> None:
        """There was no time, and so no measurement: come closer to the quickest, or there never would be one again.

        Measurements that follow each other above what is expected still do so: each time more time passes until the
        next.
        """
        self.seconds += FORGOTTEN * (self.least - self.seconds)


class Pace:
    """What is expected of steps: of their `beginning`, up to the first iterate, and of an iteration with the `rest`.

    That is all up to the inputs. Both are made of what was `measured`: pairs of their seconds.
    """

    def __init__(self, measured: Iterable[tuple[float, float]]) -> None:
        beginnings, rests = zip(*measured, strict=True)
        self.beginning, self.rest = Expectation(beginnings), Expectation(rests)

    def limit(self, seconds: float) -> float:
        """How long a search may begin iterations if there are so many `seconds`; negative where it is not to begin."""
        limit = seconds - MARGIN * self.rest.seconds
        return limit if limit >= self.beginning.seconds else -math.inf

    def learn(self, beginning: float | None, rest: float | None, was_late: bool) -> None:
        """Take account of a step, of parts that it had: `was_late` where others lacked for want of time."""
        for expectation, seconds in ((self.beginning, beginning), (self.rest, rest)):
            if seconds is not None:
                expectation.learn(seconds)
            elif was_late:
                expectation.forget()
