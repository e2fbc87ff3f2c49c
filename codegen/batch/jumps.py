"""The detection of jumps of the cost between neighbouring cases whose solves ended in different local optima.

Consider the cost along a line of a grid. The slopes on both sides of two neighbours predict the difference of their
costs. For a smooth cost, the difference lies between these predictions or close to them. This remains true where two
branches of optima meet at equal cost. If a solve has ended in the worse of two optima, the difference lies outside. At
an end of a line, or next to a failed case, only one slope exists. There a parabola and a cubic through the next costs
predict the cost. A deviation at an end justifies a new solve, but is no certain jump: a smooth cost may grow faster
towards an end.

Scattered cases are samples and rows of tables. For a pair of cases, the slope at a case is the slope of a plane through
this case and its neighbours on the side away from the other case. If both predictions err to the same side, the cost
jumps. The allowed error is the median error of predictions nearby, relative to their second-order terms. Source of
planes through scattered neighbours: Lancaster and Salkauskas (1981), Mathematics of Computation 37.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from codegen.batch.case import Attempt

Costs: TypeAlias = NDArray[np.float64]
Pair: TypeAlias = tuple[int, int]
"""Indices (worse, better) of two neighbouring cases with a jump of the cost; the last dimension varies fastest."""

LEAST = 4  # least number of values along a dimension for which jumps are detected
BENT, STEEP, ROUNDING = 0.5, 0.05, 1e-6
"""Allowed deviation from two predictions, relative to their difference, to the larger prediction, and to the cost."""
BENT_AT_ENDS = 4.0  # value that replaces BENT at the ends of lines, where one of the slopes is extrapolated
AHEAD = 4
"""Number of costs that predict the cost at an end; with three costs the prediction is less certain."""


def jumps_of(costs: Costs, places: Sequence[NDArray[np.float64]], certain: bool = False) -> list[Pair]:
    """Return pairs of neighbours on a grid of costs between which the cost jumps; NaN (no solution) is skipped.

    `places` has the positions (n,) along each dimension, or is empty for a dimension of texts. `certain` excludes
    deviations at ends, and kinks, where one curved branch of optima ends and another one begins.
    """
    numbers = np.arange(costs.size).reshape(costs.shape)
    found: list[Pair] = []
    for axis, along in enumerate(places):
        if along.size < LEAST or costs.shape[axis] < LEAST:
            continue
        rows = np.moveaxis(costs, axis, -1).reshape(-1, costs.shape[axis])
        own = np.moveaxis(numbers, axis, -1).reshape(rows.shape)
        after, before = _of_lines(rows, np.diff(along), certain)
        for worse, better in ((own[:, 1:][after], own[:, :-1][after]), (own[:, :-1][before], own[:, 1:][before])):
            found += zip(worse.tolist(), better.tolist())
    return sorted(found)


def _of_lines(
    costs: Costs, distances: NDArray[np.float64], certain: bool
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return two arrays (lines, n - 1), True for pairs of neighbours whose later, or whose earlier, cost is too high.

    `costs` are (lines, n). `distances` (n - 1,) of neighbours may be negative; a pair at distance 0 is never a jump.
    """
    with np.errstate(all="ignore"):
        steps = np.diff(costs, axis=1)
        slopes = np.where(distances == 0.0, np.nan, steps / distances)
        # Beyond the ends of a line the slope is extrapolated linearly.
        first, last = 3.0 * slopes[:, 1] - 2.0 * slopes[:, 2], 3.0 * slopes[:, -2] - 2.0 * slopes[:, -3]
        left = np.column_stack([first, slopes[:, :-1]]) * distances
        right = np.column_stack([slopes[:, 1:], last]) * distances
        low, high = np.minimum(left, right), np.maximum(left, right)
        size = np.maximum(np.abs(costs[:, 1:]), np.abs(costs[:, :-1]))
        bent = np.full(distances.size, BENT)
        bent[[0, -1]] = BENT_AT_ENDS
        allowed = bent * (high - low) + STEEP * np.maximum(np.abs(low), np.abs(high)) + ROUNDING * size
        if certain:
            # Both slopes are extrapolated linearly up to the pair.
            before = 2.0 * left - np.column_stack([left[:, :1], left[:, :-1]])
            after = 2.0 * right - np.column_stack([right[:, 1:], right[:, -1:]])
            low, high = np.minimum.reduce([low, before, after]), np.maximum.reduce([high, before, after])
            return steps - high > allowed, low - steps > allowed
        places = np.concatenate([[0.0], np.cumsum(distances)])
        above, below = _of_ends(costs, places)
        above_last, below_last = (flags[:, ::-1] for flags in _of_ends(costs[:, ::-1], places[::-1]))
        return (steps - high > allowed) | below | above_last, (low - steps > allowed) | above | below_last


def _of_ends(costs: Costs, places: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return two arrays (lines, n - 1), True where a cost without solved predecessor is too high, or too low."""
    number = places.size - 1
    later = [_shifted(costs, k)[:, :number] for k in range(AHEAD + 1)]
    positions = [_shifted(places[None], k)[:, :number] for k in range(AHEAD + 1)]
    line, parabola, cubic = (_polynomial(later[1:k], positions[1:k], positions[0]) for k in (3, 4, 5))
    # Without enough costs for a cubic, the error of the line bounds the error of the parabola.
    low = np.where(np.isnan(cubic), np.minimum(line, 2.0 * parabola - line), np.minimum(parabola, cubic))
    high = np.where(np.isnan(cubic), np.maximum(line, 2.0 * parabola - line), np.maximum(parabola, cubic))
    step = np.maximum.reduce([np.abs(value - later[1]) for value in (line, low, high)])
    # The error of the same predictions one position further inside, if it exists.
    off = _shifted(np.fmax(np.abs(later[0] - parabola), np.abs(later[0] - cubic)), 1)
    bent = BENT * (high - low + np.where(np.isnan(off), 0.0, off))
    allowed = bent + STEEP * step + ROUNDING * np.maximum(np.abs(later[0]), np.abs(later[1]))
    is_end = np.isnan(np.column_stack([np.full(len(costs), np.nan), costs[:, : number - 1]]))
    return is_end & (later[0] - high > allowed), is_end & (low - later[0] > allowed)


def _shifted(values: Costs, places: int) -> Costs:
    """Return rows (lines, n) shifted to the left by `places` entries, with NaN at their ends."""
    return np.column_stack([values[:, places:], np.full((len(values), places), np.nan)])


def _polynomial(values: Sequence[Costs], places: Sequence[Costs], place: Costs) -> Costs:
    """Return the value at `place` of the polynomial through `values` at `places`, by Neville's algorithm."""
    table = list(values)
    for degree in range(1, len(table)):
        for k in range(len(table) - degree):
            begin, end = places[k], places[k + degree]
            table[k] = ((place - end) * table[k] - (place - begin) * table[k + 1]) / (begin - end)
    return table[0]


def along_dimensions(points: Costs, shape: Sequence[int]) -> list[NDArray[np.float64]]:
    """Return the positions along each dimension of a grid, from the points (n, quantities) of all its cases.

    For quantities that vary together, the position is the length of the path through their values.
    """
    cells, number = points.reshape(*shape, -1), points.shape[1]
    lines = (np.moveaxis(cells, axis, 0).reshape(size, -1, number)[:, 0] for axis, size in enumerate(shape))
    return [along(line) for line in lines]


def along(points: Costs) -> NDArray[np.float64]:
    """Return the distance (n,) of each point (n, quantities) from the first point, along the path through them."""
    parts = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(parts)])


@dataclass(frozen=True)
class Grid:
    """The neighbours on a grid of cases or a block of a grid; `places` are the positions as for `jumps_of`."""

    shape: tuple[int, ...]
    places: tuple[NDArray[np.float64], ...]

    def jumps(self, costs: Costs, certain: bool = False) -> list[Pair]:
        """Return pairs of neighbours between which the cost (n,) jumps; see `jumps_of`."""
        return jumps_of(costs.reshape(self.shape), self.places, certain)

    def followers(self, worse: int, better: int, costs: Costs) -> list[int]:
        """Return the cases that may improve from the new solution of case `worse`, found from case `better`.

        These are the next case in the same direction and, at an end, the case `better`: no slope tells there which
        cost lies on the better branch.
        """
        place, origin = (np.array(np.unravel_index(k, self.shape)) for k in (worse, better))
        behind = self._solved(2 * place - origin, costs)
        return behind if self._solved(2 * origin - place, costs) else [*behind, better]

    def _solved(self, place: NDArray[np.intp], costs: Costs) -> list[int]:
        """Return a list with the case at a grid index, empty if the case does not exist or has no solution."""
        if (place < 0).any() or (place >= self.shape).any():
            return []
        case = int(np.ravel_multi_index(tuple(place), self.shape))
        return [] if np.isnan(costs[case]) else [case]


BETTER = 1e-7  # least relative reduction of the cost by which another solution counts as better


def improved(
    outcomes: Sequence[Attempt], neighbours: Neighbours, attempt: Callable[[int, Attempt], Attempt]
) -> dict[int, list[Attempt]]:
    """Solve the worse case of every jump again, until no new jump appears, and return the new attempts by case.

    `outcomes` has the outcome of each case. `attempt(case, solution)` solves a case from the better neighbour's
    solution. The best solution of a case is the cheapest among its outcome and its new attempts.
    """
    costs = np.array([outcome.cost if outcome.is_start else np.nan for outcome in outcomes])
    best, tried = list(outcomes), set[tuple[int, int, float]]()
    attempts: dict[int, list[Attempt]] = {}
    behind: list[Pair] = []
    while True:
        begun, pairs, behind = len(tried), [*neighbours.jumps(costs), *behind], []
        for worse, better in dict.fromkeys(pairs):
            key = (worse, better, float(costs[better]))
            # Each case may be improved from several sides, but the number of solves is bounded.
            if key in tried or len(tried) >= 2 * len(best):
                continue
            tried.add(key)
            result = attempt(worse, best[better])
            if is_better(result, best[worse]):
                best[worse], costs[worse] = result, result.cost
                behind += [(other, worse) for other in neighbours.followers(worse, better, costs)]
            attempts.setdefault(worse, []).append(result)
        if len(tried) == begun:
            return attempts


def is_better(one: Attempt, other: Attempt) -> bool:
    """Return True if `one` is a solution that costs less than `other`, by more than the relative reduction BETTER."""
    return one.is_start and one.cost < other.cost - BETTER * abs(other.cost)


SCATTERED_LEAST = 2  # jumps are detected among at least this number of cases times (quantities + 1)
NEAR, MOST_NEAR, AROUND = 2, 6, 4
"""Number of neighbours per quantity that a case is compared with, at most MOST_NEAR in total; number of neighbours
per quantity that determine a slope.
"""
OFF, OFF_AT_ENDS = 2.0, 8.0
"""Allowed errors relative to the median error nearby, for pairs with two predictions and with one prediction."""
CERTAIN = 2.0  # factor on the allowed errors for certain jumps
MISSED, FARTHEST = 0.01, 50.0
"""Limits of a valid prediction: the part of the vector between the two cases that the weighted neighbours miss, and the
second-order terms relative to the square of the distance.
"""
_BLOCK = 4096  # number of predictions that are computed together, which bounds the memory


@dataclass(frozen=True, eq=False)
class Scattered:
    """The neighbours among the solved cases of a chunk of samples.

    Each of the `clouds` has the cases of one family, see `scattered`; cases of two families are no neighbours.
    """

    clouds: tuple[_Cloud, ...]

    def jumps(self, costs: Costs, certain: bool = False) -> list[Pair]:
        """Return pairs of neighbours between which the cost (n,) jumps; `certain` requires two large deviations."""
        return sorted(pair for cloud in self.clouds for pair in cloud.jumps(costs, certain))

    def followers(self, worse: int, better: int, costs: Costs) -> list[int]:
        """Return the cases that may improve next: neighbours of `worse` on the side away from the case `better`."""
        return [other for cloud in self.clouds if worse in cloud.places for other in cloud.behind(worse, better)]


def scattered(points: NDArray[np.float64], families: NDArray[np.intp], solved: NDArray[np.bool_]) -> Scattered:
    """Return the neighbours among n cases at points (n, quantities), scaled by the range of each quantity.

    Only `solved` (n,) cases with the same number in `families` (n,) can be neighbours.
    """
    clouds = []
    for family in np.unique(families):
        own = np.flatnonzero((families == family) & solved)
        cloud = points[own]
        cloud = cloud[:, np.ptp(cloud, axis=0) > 0.0] if own.size else cloud
        if cloud.shape[1] and own.size >= SCATTERED_LEAST * (cloud.shape[1] + 1):
            from scipy.spatial import KDTree  # slow to import, and not needed for grids

            number, dimensions = cloud.shape
            count = min(number - 1, AROUND * dimensions + 2)
            nearest = np.asarray(KDTree(cloud).query(cloud, count + 1)[1], dtype=np.intp)
            is_itself = nearest == np.arange(number)[:, None]
            is_itself[~is_itself.any(axis=1), -1] = True  # a point with many copies may be missing among its neighbours
            around = _apart_first(cloud, nearest[~is_itself].reshape(number, count))
            near = around[:, : min(NEAR * dimensions, MOST_NEAR)]
            begins = np.broadcast_to(np.arange(number)[:, None], near.shape)
            both = [_predictions(cloud, around, a.ravel(), b.ravel()) for a, b in ((begins, near), (near, begins))]
            weights = np.stack([weights.reshape(*near.shape, -1) for weights, _ in both])
            seconds = np.stack([seconds.reshape(near.shape) for _, seconds in both])
            clouds.append(_Cloud(own, cloud, around, weights, seconds, dict(zip(own.tolist(), range(number)))))
    return Scattered(tuple(clouds))


@dataclass(frozen=True, eq=False)
class _Cloud:
    """The n cases of a family: their numbers `own` (n,) in the chunk, points, and nearest neighbours `around` (n, k).

    A case is compared with its first m neighbours. A predicted cost difference is a sum of known cost differences with
    `weights` (2, n, m, k), from the case to its neighbour and back. The second-order terms `seconds` (2, n, m) are NaN
    without a valid prediction. `places` is the inverse of `own`.
    """

    own: NDArray[np.intp]
    points: NDArray[np.float64]
    around: NDArray[np.intp]
    weights: NDArray[np.float64]
    seconds: NDArray[np.float64]
    places: dict[int, int]

    def jumps(self, costs: Costs, certain: bool) -> Iterator[Pair]:
        """Return pairs (worse, better) of cases between which the cost jumps, by their numbers in the chunk."""
        own = costs[self.own]
        near = self.around[:, : self.seconds.shape[2]]
        step = own[near] - own[:, None]
        ahead = np.einsum("nmk,nk->nm", self.weights[0], own[self.around] - own[:, None])
        back = np.einsum("nmk,nmk->nm", self.weights[1], own[self.around[near]] - own[near][..., None])
        with np.errstate(invalid="ignore"):
            off = np.where(np.isnan(self.seconds), np.nan, np.stack([step - ahead, -step - back]))
            # The median error (n,) around each case, from relative errors (2, n, m).
            errors = np.abs(off) / self.seconds
            each = _middle(np.concatenate([errors[0], errors[1]], axis=1))
            usual = _middle(np.column_stack([each, each[self.around]]))
            smooth = np.fmax(*self.seconds) * np.fmax(usual[:, None], usual[near])
            both = np.isfinite(off).all(axis=0)
            bent = np.where(both, OFF * smooth + BENT * np.abs(off[0] + off[1]), OFF_AT_ENDS * smooth)
            steep = np.fmax(*np.where(np.isnan(self.seconds), np.nan, np.abs(np.stack([ahead, back]))))
            size = np.maximum(np.abs(own[near]), np.abs(own[:, None]))
            allowed = (CERTAIN if certain else 1.0) * bent + STEEP * steep + ROUNDING * size
            up, down = np.fmin(off[0], -off[1]), np.fmin(-off[0], off[1])
            sought = both if certain else np.isfinite(allowed)
            found = [np.argwhere(sought & (least > allowed)) for least in (up, down)]
        pairs = [(near[case, k], case) for case, k in found[0]] + [(case, near[case, k]) for case, k in found[1]]
        return iter({(int(self.own[worse]), int(self.own[better])) for worse, better in pairs})

    def behind(self, worse: int, better: int) -> list[int]:
        """Return the neighbours of the case `worse` on the side away from the case `better`."""
        case, other = self.places[worse], self.places[better]
        near = self.around[case, : self.seconds.shape[2]]
        ahead = (self.points[near] - self.points[case]) @ (self.points[case] - self.points[other])
        return [int(number) for number in self.own[near[ahead > 0.0]]]


def _apart_first(points: NDArray[np.float64], around: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the neighbours `around` (n, k) of points (n, d), reordered with Gabriel neighbours first.

    The line from a point to its Gabriel neighbour is the diameter of a ball without other neighbours. So the first
    neighbours lie on all sides. Source: Gabriel and Sokal (1969), Systematic Zoology 18, A new statistical approach to
    geographic variation analysis.
    """
    ordered = []
    for k in range(0, len(around), _BLOCK // 8):
        own = around[k : k + _BLOCK // 8]
        ways = points[own] - points[k : k + len(own), None]
        products = ways @ np.swapaxes(ways, 1, 2)
        squares = np.diagonal(products, axis1=1, axis2=2)[:, None]
        has_between = (squares - products < -1e-12 * squares).any(axis=2)
        ordered.append(np.take_along_axis(own, np.argsort(has_between, axis=1, kind="stable"), axis=1))
    return np.concatenate(ordered)


def _predictions(
    points: NDArray[np.float64], around: NDArray[np.intp], begins: NDArray[np.intp], ends: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the results of `_slopes` for p pairs of cases with the indices `begins` (p,) and `ends` (p,)."""
    parts = [
        _slopes(points[around[begins[k : k + _BLOCK]]] - points[begins[k : k + _BLOCK], None],
                points[ends[k : k + _BLOCK]] - points[begins[k : k + _BLOCK]])
        for k in range(0, begins.size, _BLOCK)
    ]  # fmt: skip
    weights, seconds = zip(*parts)
    return np.concatenate(weights), np.concatenate(seconds)


def _slopes(others: NDArray[np.float64], ways: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return weights (p, k) of cost differences in the prediction along `ways` (p, d), and second-order terms (p,).

    `others` (p, k, d) are the vectors from each case to its neighbours. Neighbours on the side of `ways` have weight
    zero. The sum of squares of weight times distance is least. The second-order terms are NaN for invalid predictions.
    """
    squares, distance = (others**2).sum(axis=2), (ways**2).sum(axis=1)
    is_behind = ((others @ ways[:, :, None])[:, :, 0] <= 0.0) & (squares > 0.0)
    counted = np.where(is_behind, 1.0 / np.where(squares > 0.0, squares, 1.0), 0.0)
    weighted = others * counted[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ others
    # The regularisation keeps the matrix regular if all points lie on a line or a plane.
    size = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    normal += np.where(size > 0.0, 1e-9 * size, 1.0) * np.eye(ways.shape[1])
    weights = (weighted @ np.linalg.solve(normal, ways[:, :, None]))[:, :, 0]
    missed = (((weights[:, None] @ others)[:, 0] - ways) ** 2).sum(axis=1)
    seconds = distance + (np.abs(weights) * squares).sum(axis=1)
    is_one = (distance > 0.0) & (missed <= MISSED**2 * distance) & (seconds <= FARTHEST * distance)
    return weights, np.where(is_one, seconds, np.nan)


Neighbours: TypeAlias = Grid | Scattered
"""The neighbours among n cases; the costs (n,) that the methods take are NaN for cases without a solution."""


def _middle(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the median of each row without its NaN; the lower of two middle values counts."""
    number = np.maximum(1, np.isfinite(table).sum(axis=1))
    return np.asarray(np.sort(table, axis=1)[np.arange(len(table)), (number - 1) // 2])
