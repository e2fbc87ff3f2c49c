"""What a solve is worth within a sampling time: its equations evaluated again, and which of two plans is applied."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from codegen.interfaces import Grid, Vector
from codegen.solutions.control import control_verdict
from codegen.solutions.result import ControlAttempt, Run

ALLOWED = 10.0
"""Times the tolerance that residual and slopes of a solution may be, as in `control_verdict`."""


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

    The best is the cheapest whose equations hold to `feasible`. It takes the place of a module's own log, which keeps a
    row for each; points are in the problem's own units. After `limit` seconds by the clock no iteration begins, nor
    after the search has `asked` so often whether it is late as `most` says, at iterates and steps of restorations.
    """

    def __init__(
        self, limit: float, feasible: float, clock: Callable[[], float] = perf_counter, most: float = np.inf
    ) -> None:
        self.limit, self._feasible, self._clock, self._most = limit, feasible, clock, most
        self.asked = 0
        self._begin = clock()
        self._end = self._begin + limit
        self._reached: float | None = None
        self._went_on: float | None = None
        self._led: float | None = None
        self.beginning: float | None = None
        self.was_late = limit <= 0.0
        self.best: Any = None

    def append(self, _grid: Grid, point: Any, *_others: float) -> None:
        """Look at an iterate."""
        self._led = self._reached if self._went_on is None else self._went_on
        self._went_on = None
        if self._reached is None:
            self._reached = self._clock()
            self.beginning = self._reached - self._begin
        if point.residual <= self._feasible and (self.best is None or point.cost < self.best.cost):
            self.best = point

    def is_late(self) -> bool:
        """Whether the time is up, or the number of iterations."""
        self.asked += not self.is_exhausted
        if self.is_exhausted:
            return True
        now = self._clock()
        if now > self._end:
            self.was_late = True
            return True
        if self._went_on is None:
            self._went_on = now
        return False

    @property
    def is_exhausted(self) -> bool:
        """Whether the search would have gone on had its number of iterations not been limited."""
        return self.asked > self._most

    def rest(self, now: float) -> float | None:
        """The seconds since the search went on from the iterate before the last one; None where there is none.

        A linear search never asks whether it is late: those since its first iterate.
        """
        return None if self._led is None else now - self._led


def candidate(module: Any, grid: Grid, unknowns: Vector) -> Candidate:
    """A plan with its equations evaluated."""
    point = module.evaluate(grid, unknowns)
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
    if not steep.size or not module.metadata["inequalities"]:
        return not steep.size
    slopes, unknowns = found.gradient[steep], found.unknowns[steep]
    lower, upper = module.bounds_of(grid)
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
