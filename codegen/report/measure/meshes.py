"""Costs of optima on ever finer grids, each found from the optimum on a coarser grid, so that all follow one optimum.

From a problem's own guess every grid may end in another local optimum, and long problems need finer grids than a guess
leads to. A mesh sequence starts from a coarse grid and doubles it; where bounds become active or inactive within the
motion, grids of other numbers of intervals are added, since the error then varies with the place of these times in
their intervals.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from codegen import solving
from codegen.errors import CodegenError
from codegen.interfaces import ControlModule, Vector
from codegen.report.measure.limits import limit_of
from codegen.report.measure.orders import measured_order
from codegen.report.store import Values
from codegen.runtime.search import callbacks
from codegen.solutions.control import bound_distances
from codegen.solutions.result import Result
from codegen.solving.refinement import order_of_optima

MOST_INTERVALS = 1_500_000
FINEST_SMOOTH, FINEST_SWITCHING, FINE = 1024, 128, 2000
"""How much finer than the first grid the last is at most where the optimum is smooth, and is where bounds become
active; there it has so many intervals at least."""
COLD = 16
"""The first grid may be so much finer than asked for, where coarser ones have no optimum."""
PARTS = 6
"""Grids per doubling where bounds become active."""
ENOUGH, ACCURATE = 0.005, 1e-10
"""Local orders that differ by no more are good enough, and so are limits with this relative error."""
NO_MORE = 1e-11
"""Relative differences of costs below which rounding is near."""


@dataclass
class _Sequence:
    """Optima by growing number of intervals, and the seconds of processor time that are left."""

    module: ControlModule
    seconds: float
    failure: str = ""
    """What became of the last solve that failed."""
    steps: list[int] = field(default_factory=list)
    results: list[Result] = field(default_factory=list)

    @property
    def costs(self) -> list[float]:
        return [float(result.cost or 0.0) for result in self.results]

    def solve(self, steps: int, warm: Vector | None) -> Result | None:
        """From an optimum on a coarser grid, at once or by way of one in between, else from the problem's own guess.

        None where nothing leads to an optimum.
        """
        begin = time.process_time()
        try:
            result = solving.solve(self.module, steps=steps, warm=warm)
            if not result.solved and warm is not None:
                between = solving.solve(self.module, steps=3 * steps // 4, warm=warm)
                if between.solved:
                    result = solving.solve(self.module, steps=steps, warm=between.unknowns)
            if not result.solved and warm is not None:
                result = solving.solve(self.module, steps=steps)
        except CodegenError as error:  # such as too little memory
            self.failure = str(error)
            return None
        finally:
            self.seconds -= time.process_time() - begin
        if result.solved:
            return result
        self.failure = f"N = {steps}: {result.message}"
        return None


def sequence(module: ControlModule, first: int, seconds: float) -> Values:
    """Numbers of intervals and costs of a mesh sequence, unknowns whose bounds become active or inactive.

    No grid is begun after so many seconds of processor time, of which a busy machine does not take more.
    """
    found = _Sequence(module, seconds)
    steps, changes = first, list[str]()
    while steps <= MOST_INTERVALS and found.seconds > 0.0:
        result = found.solve(steps, found.results[-1].unknowns if found.results else None)
        if result is None and (found.results or steps >= COLD * first):
            break
        if result is not None:
            found.steps.append(steps)
            found.results.append(result)
            changes = switching(module, result)
            if _is_finished(found, first, changes):
                break
        steps *= 2
    between = _between(found) if changes and len(found.steps) > 2 else []
    return {
        "order": module.metadata.order, "expected order": order_of_optima(module), "steps": found.steps,
        "costs": found.costs, "switching": changes, "more steps": [n for n, _ in between],
        "more costs": [cost for _, cost in between], "failure": found.failure, "seconds": seconds - found.seconds,
    }  # fmt: skip


def switching(module: ControlModule, result: Result) -> list[str]:
    """The unknowns of which a bound becomes active or inactive between two neighbouring nodes or intervals.

    A bound is active where its multiplier, the slope of the Lagrangian, exceeds the distance from it. Inequalities
    of the path have unknowns of their own, which are bounded.
    """
    if not module.metadata.inequalities:
        return []
    grid, unknowns = module.make_grid(result.steps), result.unknowns
    assert unknowns is not None
    below, above = bound_distances(module, grid, unknowns)
    active = np.zeros(unknowns.size)
    active[module.primal_unknowns(grid)] = np.abs(callbacks.stationarity(grid, unknowns)) > np.minimum(below, above)
    nodes, intervals = module.views(grid, active)
    names, phases = [*module.metadata.node, *module.metadata.interval], module.metadata.phases
    changes = np.zeros(len(names), dtype=bool)
    for first in range(0, phases * result.steps, result.steps):  # between phases lies a node, wherever it is
        inner = nodes[:, first + 1 : first + result.steps], intervals[:, first : first + result.steps]
        changes |= np.concatenate([np.diff(values, axis=1).any(axis=(0, 1)) for values in inner])
    return [name for name, changed in zip(names, changes, strict=True) if changed]


def _is_finished(found: _Sequence, first: int, changes: list[str]) -> bool:
    """Whether finer grids would tell nothing more."""
    steps = found.steps[-1]
    if changes:
        return steps >= max(FINEST_SWITCHING * first, FINE)
    return steps >= FINEST_SMOOTH * first or _has_settled(found)


def _has_settled(found: _Sequence) -> bool:
    """Whether local orders of differences agree and, from order 2 on, the limit is known well; or rounding is near."""
    costs, order = found.costs, order_of_optima(found.module)
    scale = max(abs(costs[-1]), 1e-300)
    differences: list[float | None] = [abs(b - a) / scale for a, b in pairwise(costs)]
    if len(costs) > 3 and all(d is not None and d < NO_MORE for d in differences[-2:]):
        return True
    settled = measured_order(found.steps[:-1], differences)
    if settled is None or settled.spread > ENOUGH or settled.finest < found.steps[-2]:
        return False
    return order < 2 or limit_of(costs, order).error < ACCURATE * scale


def _between(found: _Sequence) -> list[tuple[int, float]]:
    """Further grids, whose numbers of intervals are between those of the sequence, without a common factor."""
    added: list[tuple[int, float]] = []
    for (coarse, result), fine in zip(zip(found.steps, found.results, strict=True), found.steps[1:], strict=False):
        for part in range(1, PARTS):
            steps = round(coarse * 2.0 ** (part / PARTS))
            if coarse < steps < fine and (more := found.solve(steps, result.unknowns)) is not None:
                added.append((steps, float(more.cost or 0.0)))
    return added


def all_grids(values: Values) -> tuple[list[int], list[float]]:
    """Numbers of intervals of all grids, growing, and their costs."""
    pairs: Sequence[Any] = sorted(
        [*zip(values["steps"], values["costs"], strict=True),
         *zip(values["more steps"], values["more costs"], strict=True)]
    )  # fmt: skip
    return [n for n, _ in pairs], [cost for _, cost in pairs]
