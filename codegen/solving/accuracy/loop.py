"""The loop from grid to grid: solve, compare with the bisected grid, distribute nodes anew, until it is enough."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from codegen.interfaces import ControlModule, Matrix, Vector, few_steps, inner_places
from codegen.solutions.result import Accuracy, GridLevel, Result
from codegen.solving.accuracy.arcs import gaps
from codegen.solving.accuracy.estimate import Estimate, compared, interval_errors
from codegen.solving.accuracy.grids import bisected, equal, refined, through
from codegen.solving.refinement import order_of_optima, transferred

MOST_GRIDS = 30
"""Pairs of grids after which the best estimate must do."""
MOST_INTERVALS = 200_000
FIRST_GRIDS = 5
"""Numbers of intervals, each twice the last, on which the first grid may fail."""
GROWTH = 4.0
"""By how much the number of intervals on arcs grows at most from one grid to the next."""
GROWTH_AT_SWITCHES = 1.2
"""The same while the error is largest at a switching time: it is felt beside it, where finer grids do not help."""
SHRINKAGE = 0.7
"""The same where fewer will do."""
AIM = 0.5
"""The part of the request that a grid aims at."""
NARROW = 2e-3
"""Part of its phase that a gap lasts whose switching time is told by its controls, and which is not cut any more."""
STAGNANT, PATIENCE = 0.8, 3
"""Part of the last difference above which one is no smaller, and how often in a row that may be."""

Solve = Callable[[int, Vector | None, Matrix | None], Result]


def to_accuracy(solve: Solve, module: ControlModule, steps: int, request: float, warm: Vector | None) -> Result:
    """Solve on grids that fit the solution ever better, until its estimated relative error is below `request`.

    `solve` takes a number of intervals, a start and a grid, (phases, N); the first grid has `steps` equal intervals in
    every phase. Returned is the solution on the bisected grid of the last pair; where the request is not met, its
    status is "accuracy not reached", and `accuracy` says what the best estimate is, and why there is none better.
    """
    return _Search(solve, module, request, order_of_optima(module)).run(steps, warm)


@dataclass(frozen=True)
class _Pair:
    """Solutions on a grid and on the bisected one, how they differ, and the errors of single intervals (phases, N).

    `error` is the estimate for the finer one, at the `order` that was observed.
    """

    coarse: Result
    fine: Result
    found: Estimate
    local: Matrix
    order: float
    error: float


@dataclass(frozen=True)
class _Search:
    """What is asked, and the grids so far."""

    solve: Solve
    module: ControlModule
    request: float
    order: int
    levels: list[GridLevel] = field(default_factory=list)

    def run(self, steps: int, warm: Vector | None) -> Result:
        """The loop; a failure of the first grids is returned as it is."""
        pair = self._first(steps, warm)
        if isinstance(pair, Result):
            return replace(pair, accuracy=self._accuracy(math.inf, Estimate(math.inf, "", 0.0), pair.message))
        best, stagnant, reason = pair, 0, ""
        while pair.error > self.request and not reason:
            grid = self._next(pair)
            if grid.shape[1] > MOST_INTERVALS:
                reason = f"it would take more than {MOST_INTERVALS} intervals"
                break
            following = self._pair(grid, self._carried(pair.fine, grid), pair)
            if isinstance(following, Result):
                reason = f"the grid of {following.steps} intervals ended in: {following.message}"
                break
            is_smaller = following.found.difference <= STAGNANT * pair.found.difference
            stagnant = 0 if is_smaller else stagnant + 1
            pair = following
            best = min(best, pair, key=lambda one: one.error)
            if stagnant == PATIENCE:
                reason = f"finer grids change the solution no less, with a residual of {pair.fine.residual:.1e}"
            elif len(self.levels) >= MOST_GRIDS:
                reason = f"after {MOST_GRIDS} grids"
        return self._ended(best, "" if best.error <= self.request else reason)

    def _first(self, steps: int, warm: Vector | None) -> _Pair | Result:
        """The first pair that is solved: of equal intervals, of which there may be too few."""
        phases, pair = self.module.metadata.phases, None
        for doubling in range(FIRST_GRIDS):
            count = few_steps(self.module, steps) * 2**doubling
            known = None if warm is None else transferred(self.module, warm, count)
            pair = self._pair(through(equal(phases, count), inner_places(self.module)), known, None)
            if isinstance(pair, _Pair):
                break
        assert pair is not None
        return pair

    def _pair(self, grid: Matrix, known: Vector | None, before: _Pair | None) -> _Pair | Result:
        """Solutions on a grid and on the bisected one, or the first that failed."""
        coarse = self.solve(grid.shape[1], known, grid)
        if not coarse.solved:
            return self._noted(coarse, math.inf)
        halves = bisected(grid)
        fine = self.solve(halves.shape[1], self._carried(coarse, halves), halves)
        if not fine.solved:
            return self._noted(fine, math.inf)
        found, local = compared(self.module, coarse, fine), interval_errors(self.module, fine, self.order)
        order = self._observed(found, grid, before)
        error = found.difference / (2.0**order - 1.0)
        if local.max() > math.sqrt(self.request):  # something happens between nodes that they do not show
            error = max(error, float(local.max()))
        self._noted(fine, error)
        return _Pair(coarse, fine, found, local, order, error)

    def _observed(self, found: Estimate, grid: Matrix, before: _Pair | None) -> float:
        """The order at which differences fell from the pair before to this one; one where that tells nothing."""
        if before is None or not 0.0 < found.difference < before.found.difference:
            return 1.0
        finer = grid.shape[1] / before.coarse.steps
        if finer <= 1.0:
            return 1.0
        return float(np.clip(math.log(before.found.difference / found.difference) / math.log(finer), 1.0, self.order))

    def _next(self, pair: _Pair) -> Matrix:
        """The grid that is to meet the request."""
        between = gaps(self.module, pair.fine)
        on_arcs = compared(self.module, pair.coarse, pair.fine, without=between)
        growth = GROWTH if on_arcs.difference == pair.found.difference else GROWTH_AT_SWITCHES
        ratio = on_arcs.difference / (2.0**pair.order - 1.0) / (AIM * self.request)
        steps = pair.coarse.steps
        assert pair.coarse.grid is not None, "grids are given to all solves"
        limits = SHRINKAGE * steps, growth * steps
        grid = refined(pair.coarse.grid, pair.local, self.order, ratio, limits, between, NARROW)
        return through(grid, inner_places(self.module))

    def _carried(self, result: Result, grid: Matrix) -> Vector:
        assert result.unknowns is not None
        return transferred(self.module, result.unknowns, grid.shape[1], result.grid, grid)

    def _noted(self, result: Result, error: float) -> Result:
        level = GridLevel(result.steps, result.status, error, result.iterations, result.seconds_solve)
        self.levels.append(level)
        return result

    def _accuracy(self, error: float, found: Estimate, reason: str) -> Accuracy:
        return Accuracy(self.request, error, found.quantity, found.time, reason, tuple(self.levels))

    def _ended(self, pair: _Pair, reason: str) -> Result:
        accuracy = self._accuracy(pair.error, pair.found, reason)
        if not reason:
            return replace(pair.fine, accuracy=accuracy)
        message = f"accuracy {self.request:g} not reached, but {pair.error:.2g}: {reason}"
        return replace(pair.fine, accuracy=accuracy, status="accuracy not reached", message=message)
