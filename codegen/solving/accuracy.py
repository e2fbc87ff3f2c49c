"""Refinement of grids: to a requested accuracy by equidistribution of errors, or by doubling the number of intervals.

A grid is an array (phases, N) with the lengths of all intervals, relative to the duration of their phase. Sources: de
Boor (1973), Good approximation by splines with variable knots, for equidistribution; Betts (2010), Practical methods
for optimal control, section 4.7, for mesh refinement; Richardson (1911) for the extrapolation.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from codegen.errors import NumericsError
from codegen.solving.arcs import (
    FAR,
    Estimate,
    Gap,
    around,
    compared,
    gaps,
    interval_errors,
    motion_error,
    order_of_optima,
)
from codegen.solving.loading import ControlModule, Matrix, SimulateModule, Vector, few_steps, inner_places
from codegen.solving.results.result import Accuracy, DiscretisationError, GridLevel, Result
from codegen.solving.warm_start import transferred

LEAST_DENSITY = 0.1
"""Least density of nodes in a phase, relative to the mean density."""
GRADE = 0.5
"""Largest difference between the lengths of two intervals, relative to the distance between the intervals."""
CUTS = 8
"""Number of intervals into which a gap between two arcs is divided."""
PIECES = 8
"""Number of pieces into which an interval of the old grid is divided; each piece has a wanted length of intervals."""
SHORTEST = 1e-9
"""Four times the least length of an interval, relative to the duration of its phase."""
LEAST = 10.0
"""Least number of intervals of a phase."""
MOST_GRIDS = 30
"""Largest number of pairs of grids; the refinement then ends with the best estimate."""
MOST_INTERVALS = 200_000
"""Largest number of intervals of a phase."""
FIRST_GRIDS = 5
"""Largest number of attempts to solve on a first grid; each attempt has twice as many intervals as the one before."""
GROWTH = 4.0
"""Largest factor by which the number of intervals on arcs grows from one grid to the next."""
GROWTH_AT_SWITCHES = 1.2
"""The same factor if the error is largest at a switching time, because more intervals on arcs do not reduce it."""
SHRINKAGE = 0.7
"""Least ratio of the number of intervals on arcs to this number on the grid before."""
AIM = 0.5
"""Error for which a new grid is designed, relative to the requested error."""
NARROW = 2e-3
"""Four times the least length of the intervals of a gap, relative to the duration of its phase."""
STAGNANT, PATIENCE = 0.8, 3
"""Ratio of successive differences above which a grid is no progress; number of such grids that ends the refinement."""
MOST_STEPS = 20_000_000
"""Largest number of steps of a simulation whose accuracy is requested."""
FASTEST_GROWTH = 16
"""Largest ratio of successive numbers of steps of such a simulation."""

Solve = Callable[[int, Vector | None, Matrix | None], Result]
"""A function that solves the problem for a number of intervals per phase, an initial guess (n,) and a grid."""


def to_accuracy(solve: Solve, module: ControlModule, steps: int, request: float, warm: Vector | None) -> Result:
    """Solve on successively adapted grids until the estimated relative error is below `request`; return the result.

    The first grid has `steps` equal intervals in every phase, and starts from the unknowns `warm`, if given. The
    problem is solved on each grid and on the bisected grid. The result on the bisected grid of the best pair is
    returned. If the accuracy is not reached, the status is "accuracy not reached", and the attribute `accuracy` of the
    result has the best estimate and the reason. If all first grids fail, the last failure is returned.
    """
    search = _Search(solve, module, request, order_of_optima(module))
    pair: _Pair | Result | None = None
    for doubling in range(FIRST_GRIDS):  # a grid may be too coarse for a solution
        count = few_steps(module, steps) * 2**doubling
        start = None if warm is None else transferred(module, warm, count)
        pair = search.pair(through(equal(module.metadata.phases, count), inner_places(module)), start, None)
        if isinstance(pair, _Pair):
            break
    assert pair is not None
    if isinstance(pair, Result):
        return replace(pair, accuracy=search.accuracy(math.inf, Estimate(math.inf, "", 0.0), pair.message))
    best, stagnant, reason = pair, 0, ""
    while pair.error > request and not reason:
        grid = search.next_grid(pair)
        if grid.shape[1] > MOST_INTERVALS:
            reason = f"it would take more than {MOST_INTERVALS} intervals"
            break
        following = search.pair(grid, search.carried(pair.fine, grid), pair)
        if isinstance(following, Result):
            reason = f"the grid of {following.steps} intervals ended in: {following.message}"
            break
        stagnant = 0 if following.estimate.difference <= STAGNANT * pair.estimate.difference else stagnant + 1
        pair = following
        best = min(best, pair, key=lambda pair: pair.error)
        if stagnant == PATIENCE:
            reason = f"finer grids change the solution no less, with a residual of {pair.fine.residual:.1e}"
        elif len(search.levels) >= MOST_GRIDS:
            reason = f"after {MOST_GRIDS} grids"
    reason = "" if best.error <= request else reason
    return _with_accuracy(best.fine, search.accuracy(best.error, best.estimate, reason))


def simulated_to_accuracy(
    simulate: Callable[[int], Result], module: SimulateModule, steps: int, request: float
) -> Result:
    """Simulate with more and more steps until the estimated relative error is below `request`.

    The first number of steps is `steps`, or one more if it is odd. The error follows from the motion with half as many
    steps, and the next number of steps from the error and the order of the scheme. If the accuracy is not reached, the
    motion with the least error is returned. Its status is "accuracy not reached", and the reason is in `accuracy`.
    """
    levels, failures, stagnant, reason = list[GridLevel](), 0, 0, ""
    best, least = None, DiscretisationError(math.inf, None, "", 0.0)
    count = steps + steps % 2
    while True:
        try:
            coarse, fine = simulate(count // 2), simulate(count)
        except NumericsError as failure:
            if best is None:
                raise
            reason = str(failure)
            break
        error = motion_error(module, fine, coarse, count // 2) if coarse.solved and fine.solved else None
        reached = math.inf if error is None else error.states
        levels.append(GridLevel(count, fine.status, reached, fine.iterations, fine.seconds_solve))
        failures = failures + 1 if error is None else 0
        stagnant = stagnant + 1 if error is not None and reached > STAGNANT * least.states else 0
        if best is None or (error is not None and reached < least.states):
            best, least = fine, error or least
        if reached <= request:
            break
        growth = 2.0 if error is None else (reached / (AIM * request)) ** (1.0 / module.metadata.order)
        following = 2 * math.ceil(0.5 * count * min(max(growth, 2.0), FASTEST_GROWTH))
        if failures == FIRST_GRIDS:
            reason = f"no error can be estimated with {count} steps: {fine.message}"
        elif stagnant == PATIENCE:
            reason = f"more steps change the motion no less, with a residual of {fine.residual:.1e}"
        elif following > MOST_STEPS:
            reason = f"it would take more than {MOST_STEPS} steps"
        if reason:
            break
        count = following
    accuracy = Accuracy(request, least.states, least.quantity, least.time, reason, tuple(levels))
    return _with_accuracy(best, accuracy)


def _with_accuracy(result: Result, accuracy: Accuracy) -> Result:
    """Return a result with the outcome of its refinement; a solution that is too inaccurate gets another status."""
    result = replace(result, accuracy=accuracy)
    if not (accuracy.reason and result.solved):
        return result
    message = f"accuracy {accuracy.request:g} not reached, but {accuracy.estimate:.2g}: {accuracy.reason}"
    return replace(result, status="accuracy not reached", message=message)


@dataclass(frozen=True)
class _Pair:
    """Solutions on a grid and on the bisected grid, with estimates of their errors.

    `estimate` is the difference of the solutions. `local` (phases, N) has the errors of all intervals of the coarse
    grid. `error` is the estimated error of the fine solution, from the difference and the observed `order`.
    """

    coarse: Result
    fine: Result
    estimate: Estimate
    local: Matrix
    order: float
    error: float


@dataclass(frozen=True)
class _Search:
    """The refinement of a problem to the relative error `request`, with a record of the grids that were solved.

    `order` is the order at which costs converge.
    """

    solve: Solve
    module: ControlModule
    request: float
    order: int
    levels: list[GridLevel] = field(default_factory=list)

    def pair(self, grid: Matrix, start: Vector | None, before: _Pair | None) -> _Pair | Result:
        """Return the pair of solutions on a grid and on the bisected grid, or the first failed result.

        `start` (n,) is the initial guess on the grid, and `before` the pair on the grid before.
        """
        coarse = self.solve(grid.shape[1], start, grid)
        if not coarse.solved:
            return self._recorded(coarse, math.inf)
        halves = bisected(grid)
        fine = self.solve(halves.shape[1], self.carried(coarse, halves), halves)
        if not fine.solved:
            return self._recorded(fine, math.inf)
        estimate, local = compared(self.module, coarse, fine), interval_errors(self.module, fine, self.order)
        order = 1.0  # the order is observed only if the difference is smaller than on the grid before
        if before is not None and 0.0 < estimate.difference < before.estimate.difference:
            ratio = grid.shape[1] / before.coarse.steps
            if ratio > 1.0:
                observed = math.log(before.estimate.difference / estimate.difference) / math.log(ratio)
                order = float(np.clip(observed, 1.0, self.order))
        error = estimate.difference / (2.0**order - 1.0)
        if local.max() > math.sqrt(self.request):  # the motion changes quickly between two nodes
            error = max(error, float(local.max()))
        self._recorded(fine, error)
        return _Pair(coarse, fine, estimate, local, order, error)

    def next_grid(self, pair: _Pair) -> Matrix:
        """Return a grid that is designed for the requested accuracy, from the errors of the last pair."""
        between = gaps(self.module, pair.fine)
        on_arcs = compared(self.module, pair.coarse, pair.fine, without=between)
        growth = GROWTH if on_arcs.difference == pair.estimate.difference else GROWTH_AT_SWITCHES
        ratio = on_arcs.difference / (2.0**pair.order - 1.0) / (AIM * self.request)
        steps = pair.coarse.steps
        assert pair.coarse.grid is not None, "grids are given to all solves"
        limits = SHRINKAGE * steps, growth * steps
        grid = refined(pair.coarse.grid, pair.local, self.order, ratio, limits, between, NARROW)
        return through(grid, inner_places(self.module))

    def carried(self, result: Result, grid: Matrix) -> Vector:
        """Return the unknowns of a result, interpolated on another grid."""
        assert result.unknowns is not None
        return transferred(self.module, result.unknowns, grid.shape[1], result.grid, grid)

    def accuracy(self, error: float, estimate: Estimate, reason: str) -> Accuracy:
        """Return the outcome of the refinement; `reason` states why the accuracy was not reached, or is empty."""
        return Accuracy(self.request, error, estimate.quantity, estimate.time, reason, tuple(self.levels))

    def _recorded(self, result: Result, error: float) -> Result:
        self.levels.append(GridLevel(result.steps, result.status, error, result.iterations, result.seconds_solve))
        return result


def equal(phases: int, steps: int) -> Matrix:
    """Return the grid of N = `steps` equal intervals in every phase."""
    return np.full((phases, steps), 1.0 / steps)


def bisected(grid: Matrix) -> Matrix:
    """Return the grid with every interval halved."""
    return np.repeat(grid / 2.0, 2, axis=1)


def through(grid: Matrix, times: Sequence[float]) -> Matrix:
    """Return a grid of one phase with its nearest nodes moved to given `times`, which are fractions of the duration.

    Without times the grid is returned unchanged, and may have several phases.
    """
    if not times:
        return grid
    nodes, count = np.append(0.0, np.cumsum(grid[0])), len(times)
    chosen = [0]
    for number, time in enumerate(times):
        nearest = int(np.argmin(np.abs(nodes - time)))
        chosen.append(min(max(nearest, chosen[-1] + 1), nodes.size - 1 - (count - number)))
    moved = np.interp(nodes, nodes[[*chosen, -1]], [0.0, *times, nodes[-1]])
    return np.asarray(np.diff(moved)[None] / nodes[-1], dtype=float)


def refined(
    grid: Matrix,
    errors: Matrix,
    order: int,
    ratio: float,
    limits: tuple[float, float],
    gaps: Sequence[Gap],
    narrow: float = SHORTEST,
) -> Matrix:
    """Return a grid whose intervals on arcs have equal errors, and whose gaps are divided into short intervals.

    `errors` (phases, N) are the errors of the intervals of `grid`. They are proportional to h^(p + 1) for the length h
    of an interval and p = `order`. The number of new intervals is chosen such that the error decreases by the factor
    `ratio`, and is within `limits`. Lengths of neighbours differ little. Gaps are divided into CUTS intervals, or fewer
    if these were shorter than a quarter of `narrow`. A known switching time becomes a node.
    """
    # `amounts` is proportional to the number of new intervals that replace each interval. The errors in gaps and close
    # to gaps are not used: the density of nodes there is interpolated from nodes farther away.
    amounts = np.maximum(errors, 0.0) ** (1.0 / (order + 1))
    for phase, lengths in enumerate(grid):
        on_arc = np.ones(lengths.size, bool)
        for gap in gaps:
            if gap.phase == phase:
                on_arc[around(np.cumsum(lengths), gap, FAR)] = False
        if on_arc.any():
            middles = np.cumsum(lengths) - lengths / 2.0
            density = amounts[phase, on_arc] / lengths[on_arc]
            amounts[phase, ~on_arc] = np.interp(middles[~on_arc], middles[on_arc], density) * lengths[~on_arc]
    total = float((amounts ** (order + 1)).sum())
    wished = (ratio * (amounts.sum(axis=1) ** (order + 1)).sum() / total) ** (1.0 / order) if total > 0.0 else LEAST
    count = float(np.clip(wished, max(LEAST, limits[0]), limits[1]))
    of_phases = [[gap for gap in gaps if gap.phase == phase] for phase in range(len(grid))]
    pieces = [_pieces(grid[k], amounts[k], count, own, narrow) for k, own in enumerate(of_phases)]
    steps = max(int(np.ceil((lengths / wanted).sum())) for lengths, wanted in pieces)
    new = np.empty((len(grid), steps))
    for phase, (lengths, wanted) in enumerate(pieces):  # new intervals are proportional to the wanted lengths
        share = np.concatenate([[0.0], np.cumsum(lengths / wanted)])
        nodes = np.interp(np.linspace(0.0, share[-1], steps + 1), share, np.concatenate([[0.0], np.cumsum(lengths)]))
        for gap in of_phases[phase]:
            if gap.switch is not None:
                nodes[1 + int(np.argmin(np.abs(nodes[1:-1] - gap.switch)))] = gap.switch
        new[phase] = np.maximum(np.diff(nodes), SHORTEST / 4.0)
        new[phase] /= new[phase].sum()
    return new


def _pieces(
    lengths: Vector, amounts: Vector, count: float, gaps: Sequence[Gap], narrow: float
) -> tuple[Vector, Vector]:
    """Return the lengths of the pieces into which a phase is divided, and the wanted length of intervals on each piece.

    `lengths` (N,) are the intervals of the phase, and `amounts` (N,) are proportional to the numbers of new intervals
    that replace them. `count` is the number of new intervals on all arcs. See `refined` for the other arguments.
    """
    mean = amounts.sum() / count
    longest = 1.0 / (LEAST_DENSITY * count)
    of_intervals = np.minimum(lengths * mean / np.maximum(amounts, 1e-3 * mean * lengths + 1e-300), longest)
    nodes = np.concatenate([[0.0], np.cumsum(np.repeat(lengths / PIECES, PIECES))])
    cuts = [np.linspace(gap.begin, gap.end, CUTS + 1) for gap in gaps]
    nodes = np.unique(np.clip(np.concatenate([nodes, *cuts]), 0.0, nodes[-1]))
    nodes = nodes[np.append(True, np.diff(nodes) > 1e-14)]
    middles = 0.5 * (nodes[:-1] + nodes[1:])
    interval = np.searchsorted(np.cumsum(lengths), middles)
    wanted = of_intervals[np.minimum(interval, lengths.size - 1)]
    for gap in gaps:
        inside = (middles > gap.begin) & (middles < gap.end)
        wanted[inside] = np.minimum(wanted[inside], max((gap.end - gap.begin) / CUTS, narrow / 4.0))
    # Reduce wanted lengths until the lengths of two pieces differ by at most GRADE times their distance.
    distance = GRADE * np.diff(middles)
    for k in range(1, wanted.size):
        wanted[k] = min(wanted[k], wanted[k - 1] + distance[k - 1])
    for k in range(wanted.size - 2, -1, -1):
        wanted[k] = min(wanted[k], wanted[k + 1] + distance[k])
    return np.diff(nodes), wanted


def refine(
    solve: Callable[[int, Vector | None], Result],
    module: ControlModule,
    steps: int,
    doublings: int,
    warm: Vector | None = None,
) -> Result:
    """Solve on N, 2N, 4N, ... intervals (N = `steps`), each time from the last solution, and return the last result.

    `solve` takes a number of intervals per phase and an initial guess (n,). `warm` is the initial guess on the first
    grid; None means the guess of the problem. A failure does not end the refinement, because a grid may be too coarse
    for a solution. All results are in `levels`. If the last two grids were solved, the summary has the extrapolated
    cost, and its distance from the last cost as an estimate of the error. If the last three grids were solved, the
    summary also has the observed order of convergence.
    """
    known, results = warm, list[Result]()
    for number in [steps * 2**k for k in range(doublings + 1)]:
        results.append(solve(number, None if known is None else transferred(module, known, number)))
        known = results[-1].unknowns if results[-1].solved else known
    failed = [index for index, result in enumerate(results) if not result.solved]
    costs = [result.cost for result in results[failed[-1] + 1 if failed else 0 :] if result.cost is not None]
    estimates: dict[str, float] = {}
    if len(costs) > 1:
        error = (costs[-1] - costs[-2]) / (2 ** order_of_optima(module) - 1)
        estimates |= {"cost_extrapolated": costs[-1] + error, "cost_error_estimate": abs(error)}
    if len(costs) > 2:
        before, last = costs[-2] - costs[-3], costs[-1] - costs[-2]
        # Differences of the size of rounding errors do not show an order.
        if min(abs(before), abs(last)) > 1e-12 * max(1.0, abs(costs[-1])) and before / last > 0.0:
            estimates["observed_order"] = float(np.log2(before / last))
    # Only the first result has entries such as the number of guesses.
    summary = {**results[0].summary, **results[-1].summary, **estimates}
    return replace(results[-1], summary=summary, attempts=results[0].attempts, levels=tuple(results))
