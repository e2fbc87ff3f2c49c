"""The loop from grid to grid: solve, compare with the bisected grid, distribute nodes anew, until it is enough.

Time grids as fractions of every phase: bisected, and distributed anew by how much error an interval makes. A grid is an
array (phases, N) of what its intervals last, in parts of their phase. Sources: de Boor (1973), Good approximation by
splines with variable knots, for equidistribution; Betts (2010), Practical methods for optimal control, section 4.7.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from codegen.solving.arcs import FAR, Estimate, Gap, around, compared, gaps, interval_errors, order_of_optima
from codegen.solving.loading import ControlModule, Matrix, Vector, few_steps, inner_places
from codegen.solving.results.result import Accuracy, GridLevel, Result
from codegen.solving.warm_start import transferred

LEAST_DENSITY = 0.1
"""Of the mean density of nodes, where nothing happens."""
GRADE = 0.5
"""By how much of the distance between them two intervals may differ in length."""
CUTS = 8
"""Intervals into which a gap between two arcs is cut."""
PIECES = 8
"""Parts of an interval on each of which new intervals have one length."""
SHORTEST = 1e-9
"""Part of a phase that an interval has at least."""


def equal(phases: int, steps: int) -> Matrix:
    """N = `steps` equal intervals in every phase."""
    return np.full((phases, steps), 1.0 / steps)


def bisected(grid: Matrix) -> Matrix:
    """The grid with every interval cut in two."""
    return np.repeat(grid / 2.0, 2, axis=1)


def refined(
    grid: Matrix,
    errors: Matrix,
    order: int,
    ratio: float,
    limits: tuple[float, float],
    gaps: Sequence[Gap],
    narrow: float = SHORTEST,
) -> Matrix:
    """A grid whose intervals on arcs make equal errors, `ratio` times smaller in all, and whose gaps are cut.

    `errors` (phases, N) are those of the intervals of `grid`, of the order p + 1, p = `order`, in their length. The
    number of intervals on the arcs of a phase is between the two `limits`. Lengths of neighbours do not differ by much.
    A gap that is `narrow` is not cut any more, and where its switching time is known, a node is moved there.
    """
    amounts = _amounts(grid, errors, order, gaps)
    total = float((amounts ** (order + 1)).sum())
    wished = (ratio * (amounts.sum(axis=1) ** (order + 1)).sum() / total) ** (1.0 / order) if total > 0.0 else LEAST
    count = float(np.clip(wished, max(LEAST, limits[0]), limits[1]))
    lengths = [
        _lengths(own, amount, count, [gap for gap in gaps if gap.phase == phase], narrow)
        for phase, (own, amount) in enumerate(zip(grid, amounts, strict=True))
    ]
    steps = max(int(np.ceil((pieces / wanted).sum())) for pieces, wanted in lengths)
    times = [[gap.switch for gap in gaps if gap.phase == phase] for phase in range(len(grid))]
    return np.array([_placed(*own, steps, known) for own, known in zip(lengths, times, strict=True)])


def through(grid: Matrix, places: Sequence[float]) -> Matrix:
    """A grid of one phase whose nodes are moved so that some of them are at given places, in parts of the whole."""
    if not places:
        return grid
    nodes, count = np.append(0.0, np.cumsum(grid[0])), len(places)
    chosen = [0]
    for number, place in enumerate(places):
        nearest = int(np.argmin(np.abs(nodes - place)))
        chosen.append(min(max(nearest, chosen[-1] + 1), nodes.size - 1 - (count - number)))
    moved = np.interp(nodes, nodes[[*chosen, -1]], [0.0, *places, nodes[-1]])
    return np.asarray(np.diff(moved)[None] / nodes[-1], dtype=float)


def _amounts(grid: Matrix, errors: Matrix, order: int, gaps: Sequence[Gap]) -> Matrix:
    """How many intervals each interval is worth, up to a factor; in gaps and beside them as many as farther away."""
    amounts = np.maximum(errors, 0.0) ** (1.0 / (order + 1))
    for phase, lengths in enumerate(grid):
        known = np.ones(lengths.size, bool)
        for gap in gaps:
            if gap.phase == phase:
                known[around(np.cumsum(lengths), gap, FAR)] = False
        if known.any():
            middles = np.cumsum(lengths) - lengths / 2.0
            density = amounts[phase, known] / lengths[known]
            amounts[phase, ~known] = np.interp(middles[~known], middles[known], density) * lengths[~known]
    return amounts


LEAST = 10.0
"""Intervals of a phase at least."""


def _lengths(
    lengths: Vector, amounts: Vector, count: float, gaps: Sequence[Gap], narrow: float
) -> tuple[Vector, Vector]:
    """The pieces of a phase, and how long intervals on each of them shall be."""
    mean = amounts.sum() / count
    longest = 1.0 / (LEAST_DENSITY * count)
    wanted = np.minimum(lengths * mean / np.maximum(amounts, 1e-3 * mean * lengths + 1e-300), longest)
    nodes = np.concatenate([[0.0], np.cumsum(np.repeat(lengths / PIECES, PIECES))])
    cuts = [np.linspace(gap.begin, gap.end, CUTS + 1) for gap in gaps]
    nodes = np.unique(np.clip(np.concatenate([nodes, *cuts]), 0.0, nodes[-1]))
    nodes = nodes[np.append(True, np.diff(nodes) > 1e-14)]
    pieces, middles = np.diff(nodes), 0.5 * (nodes[:-1] + nodes[1:])
    own = np.searchsorted(np.cumsum(lengths), middles)
    fine = wanted[np.minimum(own, lengths.size - 1)]
    for gap in gaps:
        inside = (middles > gap.begin) & (middles < gap.end)
        fine[inside] = np.minimum(fine[inside], max((gap.end - gap.begin) / CUTS, narrow / 4.0))
    # Lengths, no longer than those that are wanted, that change no faster than GRADE times the distance.
    out, distance = fine.copy(), GRADE * np.diff(middles)
    for k in range(1, out.size):
        out[k] = min(out[k], out[k - 1] + distance[k - 1])
    for k in range(out.size - 2, -1, -1):
        out[k] = min(out[k], out[k + 1] + distance[k])
    return pieces, out


def _placed(pieces: Vector, wanted: Vector, steps: int, switches: Sequence[float | None]) -> Vector:
    """N = `steps` intervals whose lengths are in proportion to those that are wanted, with nodes at switching times."""
    share = np.concatenate([[0.0], np.cumsum(pieces / wanted)])
    nodes = np.interp(np.linspace(0.0, share[-1], steps + 1), share, np.concatenate([[0.0], np.cumsum(pieces)]))
    for switch in switches:
        if switch is not None:
            nodes[1 + int(np.argmin(np.abs(nodes[1:-1] - switch)))] = switch
    new = np.maximum(np.diff(nodes), SHORTEST / 4.0)
    return np.asarray(new / new.sum(), dtype=float)


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


def refine(
    solve: Callable[[int, Vector | None], Result],
    module: ControlModule,
    steps: int,
    doublings: int,
    warm: Vector | None = None,
) -> Result:
    """Solve on N, 2N, 4N, ... intervals, each from the solution before; the last result, with an error estimate.

    `solve` takes a number of intervals and a start; `warm` is the first one. A grid that fails leaves the next one to
    start from the last solution, or from the problem's own guess where there is none: a grid may be too coarse for a
    solution. How each ended is told in `levels`. The summary gains, where the last two or more were solved, the cost
    extrapolated by the order of optima and its distance from the last one as an error estimate, and the order that
    three grids show.
    """
    known, results = warm, list[Result]()
    for number in [steps * 2**k for k in range(doublings + 1)]:
        results.append(solve(number, None if known is None else transferred(module, known, number)))
        known = results[-1].unknowns if results[-1].solved else known
    costs = [result.cost for result in _solved_to_the_end(results) if result.cost is not None]
    # What the first solve alone knows, such as how many guesses it tried, stays.
    summary = {**results[0].summary, **results[-1].summary, **_estimates(module, costs)}
    return replace(results[-1], summary=summary, attempts=results[0].attempts, levels=tuple(results))


def _solved_to_the_end(results: Sequence[Result]) -> Sequence[Result]:
    """Those behind the last failure."""
    failed = [index for index, result in enumerate(results) if not result.solved]
    return results[failed[-1] + 1 if failed else 0 :]


def _estimates(module: ControlModule, costs: list[float]) -> dict[str, float]:
    """What a sequence of costs on halved steps tells of their limit."""
    order = order_of_optima(module)
    summary: dict[str, float] = {}
    if len(costs) > 1:
        error = (costs[-1] - costs[-2]) / (2**order - 1)
        summary |= {"cost_extrapolated": costs[-1] + error, "cost_error_estimate": abs(error)}
    if len(costs) > 2:
        before, last = costs[-2] - costs[-3], costs[-1] - costs[-2]
        # Differences at rounding level show no order.
        if min(abs(before), abs(last)) > 1e-12 * max(1.0, abs(costs[-1])) and before / last > 0.0:
            summary["observed_order"] = float(np.log2(before / last))
    return summary
