"""The loop from grid to grid: solve, compare with the bisected grid, distribute nodes anew, until it is enough."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from codegen.loading import ControlModule, Matrix, Vector
from codegen.solutions.result import Accuracy, GridLevel, Result
from codegen.solving.accuracy.arcs import gaps
from codegen.solving.accuracy.estimate import Estimate, compared, interval_errors
from codegen.solving.accuracy.grids import bisected, equal, refined
from codegen.solving.refinement import order_of_optima, transferred

MOST_GRIDS = 30
"""Pairs of grids after which the best estimate must do."""
MOST_INTERVALS = 200_000
GROWTH = 4.0
"""By how much the number of intervals grows at most from one grid to the next."""
GROWTH_AT_SWITCHES = 1.2
"""The same while the error is largest at a switching time."""
AIM = 0.5
"""The part of the request that a grid aims at."""
NARROW = 2e-3
"""Part of its phase that a gap lasts whose switching time is told by its controls, and which is not cut any more."""
SHRINKAGE = 0.7
"""The same where fewer will do."""
STAGNANT = 0.8
"""Part of the last difference above which it counts as no smaller."""

Solve = Callable[[int, Vector | None, Matrix | None], Result]


def to_accuracy(solve: Solve, module: ControlModule, steps: int, request: float, warm: Vector | None) -> Result:
    """Solve on grids that fit the solution ever better, until its estimated relative error is below `request`.

    `solve` takes a number of intervals, a start and a grid, (phases, N); the first grid has `steps` equal intervals in
    every phase. Returned is the solution on the bisected grid of the last pair; where the request is not met, its
    status is "accuracy not reached", and `accuracy` says what the best estimate is, and why there is none better.
    """
    return _Search(solve, module, request).run(steps, warm)


@dataclass
class _Search:
    solve: Solve
    module: ControlModule
    request: float

    def run(self, steps: int, warm: Vector | None) -> Result:
        phases = self.module.metadata.get("phases", 1)
        grid, order = equal(phases, steps), order_of_optima(self.module)
        known = None if warm is None else transferred(self.module, warm, steps)
        levels: list[GridLevel] = []
        best: tuple[float, Result, Estimate] | None = None
        last: tuple[int, float] | None = None
        reason, stagnant = f"after {MOST_GRIDS} pairs of grids", 0
        for _ in range(MOST_GRIDS):
            coarse = self._solved(grid, known)
            if not coarse.solved:
                levels.append(_level(coarse, math.inf))
                if best is None and steps < 16 * self.module.metadata["steps"]:
                    steps, known = 2 * steps, None
                    grid = equal(phases, steps)
                    continue
                reason = f"the grid of {coarse.steps} intervals ended in: {coarse.message}"
                if best is None:
                    return replace(coarse, accuracy=Accuracy(self.request, math.inf, "", 0.0, reason, tuple(levels)))
                break
            halves = bisected(grid)
            fine = self._solved(halves, self._carried(coarse, halves))
            if not fine.solved:
                levels.append(_level(fine, math.inf))
                reason = f"the grid of {fine.steps} intervals ended in: {fine.message}"
                if best is None:
                    return replace(fine, accuracy=Accuracy(self.request, math.inf, "", 0.0, reason, tuple(levels)))
                break
            found = compared(self.module, coarse, fine)
            local = interval_errors(self.module, fine, order)
            observed = 1.0
            if last is not None and found.difference < last[1] and steps > last[0]:
                observed = float(np.clip(math.log(last[1] / found.difference) / math.log(steps / last[0]), 1.0, order))
            error = found.difference / (2.0**observed - 1.0)
            if local.max() > math.sqrt(self.request):  # something happens between nodes that they do not show
                error = max(error, float(local.max()))
            levels.append(_level(fine, error))
            if best is None or error < best[0]:
                best = error, fine, found
            if error <= self.request:
                return self._ended(fine, error, found, "", levels)
            stagnant = stagnant + 1 if last is not None and found.difference > STAGNANT * last[1] else 0
            if stagnant >= 3:
                reason = f"finer grids change the solution no less: its residual is {fine.residual:.1e}"
                break
            last = steps, found.difference
            between = gaps(self.module, fine)
            on_arcs = compared(self.module, coarse, fine, without=between)
            # What goes wrong at a switching time is felt on the arcs beside it, where finer grids do not help.
            growth = GROWTH if on_arcs.difference == found.difference else GROWTH_AT_SWITCHES
            ratio = on_arcs.difference / (2.0**observed - 1.0) / (AIM * self.request)
            grid = refined(grid, local, order, ratio, (SHRINKAGE * steps, growth * steps), between, NARROW)
            steps = grid.shape[1]
            if steps > MOST_INTERVALS:
                reason = f"it would take more than {MOST_INTERVALS} intervals"
                break
            known = self._carried(fine, grid)
        assert best is not None
        return self._ended(best[1], best[0], best[2], reason, levels)

    def _solved(self, grid: Matrix, known: Vector | None) -> Result:
        steps = grid.shape[1]
        return self.solve(steps, known, grid)

    def _carried(self, result: Result, grid: Matrix) -> Vector:
        assert result.unknowns is not None
        return transferred(self.module, result.unknowns, grid.shape[1], result.grid, grid)

    def _ended(self, result: Result, error: float, found: Estimate, reason: str, levels: list[GridLevel]) -> Result:
        accuracy = Accuracy(self.request, error, found.quantity, found.time, reason, tuple(levels))
        if not reason:
            return replace(result, accuracy=accuracy)
        message = f"accuracy {self.request:g} not reached, but {error:.2g}: {reason}"
        return replace(result, accuracy=accuracy, status="accuracy not reached", message=message)


def _level(result: Result, error: float) -> GridLevel:
    return GridLevel(result.steps, result.status, error, result.iterations, result.seconds_solve)
