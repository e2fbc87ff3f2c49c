"""Jumps between local optima: where the cost along a grid is not smooth.

Along a line of a smooth function the difference of two neighbours lies between those that the slopes on either side
predict, or close to it. Where one branch of optima takes over from another at equal cost it still does; where a search
has ended on the worse of two, the difference lies outside. At an end, of a line or before a case without a solution,
there is a slope on one side only: a cost there is expected where a parabola and a cubic through what follows lead. One
that lies elsewhere is worth a solve and nothing more, since a smooth cost may well grow faster towards an end.

Jumps between local optima among cases that are no grid: samples, and the rows of a table. Two neighbours are compared
as on a line of a grid: of a smooth cost their difference lies between those that the slopes on either side predict,
where the slope at a case is that of a plane through it and those of its neighbours that lie away from the other case.
So where both predictions are off to the same side there is a jump between them. How far off predictions of a smooth
cost are is seen around: the middle one of their errors there, each in parts of its second-order term. Source of planes
through scattered neighbours: Lancaster and Salkauskas (1981), Mathematics of Computation 37.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Costs: TypeAlias = NDArray[np.float64]
Pair: TypeAlias = tuple[int, int]
"""A case on the worse side of a jump and its neighbour on the better, counted with the last dimension fastest."""

LEAST = 4
"""So many values of a quantity it takes to see a jump along it."""
BENT, STEEP, ROUNDING = 0.5, 0.05, 1e-6
"""What a difference may lie outside the predictions: in parts of their distance, of the larger one, of the cost."""
BENT_AT_ENDS = 4.0
"""As the first of these, where there is no slope beyond, for what is told and not only tried."""
AHEAD = 4
"""So many values after one at an end are asked what it should be; without the last of them it is less certain."""


def jumps_of(costs: Costs, places: Sequence[NDArray[np.float64]], certain: bool = False) -> list[Pair]:
    """Pairs of neighbours on a grid of costs between which the cost jumps; NaN, where there is no solution, is skipped.

    Those that are `certain` are no kinks either, in which one curved branch of optima ends and another begins.
    `places` has the place (n,) of each row of a dimension along it, or nothing for a dimension that is none of numbers.
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
    """Between which neighbours of each line (lines, n) the later one is the worse, and the earlier one: (lines, n - 1).

    Values may decrease along a line, but none may be there twice: a pair that is has no slope, and is none.
    """
    with np.errstate(all="ignore"):
        steps = np.diff(costs, axis=1)
        slopes = np.where(distances == 0.0, np.nan, steps / distances)
        # Beyond the ends of a line the slope goes on changing as it does inside.
        first, last = 3.0 * slopes[:, 1] - 2.0 * slopes[:, 2], 3.0 * slopes[:, -2] - 2.0 * slopes[:, -3]
        left = np.column_stack([first, slopes[:, :-1]]) * distances
        right = np.column_stack([slopes[:, 1:], last]) * distances
        low, high = np.minimum(left, right), np.maximum(left, right)
        size = np.maximum(np.abs(costs[:, 1:]), np.abs(costs[:, :-1]))
        bent = np.full(distances.size, BENT)
        bent[[0, -1]] = BENT_AT_ENDS
        allowed = bent * (high - low) + STEEP * np.maximum(np.abs(low), np.abs(high)) + ROUNDING * size
        if certain:
            # Each side goes on changing its slope up to the pair.
            before = 2.0 * left - np.column_stack([left[:, :1], left[:, :-1]])
            after = 2.0 * right - np.column_stack([right[:, 1:], right[:, -1:]])
            low, high = np.minimum.reduce([low, before, after]), np.maximum.reduce([high, before, after])
            return steps - high > allowed, low - steps > allowed
        places = np.concatenate([[0.0], np.cumsum(distances)])
        above, below = _of_ends(costs, places)
        above_last, below_last = (found[:, ::-1] for found in _of_ends(costs[:, ::-1], places[::-1]))
        return (steps - high > allowed) | below | above_last, (low - steps > allowed) | above | below_last


def _of_ends(costs: Costs, places: NDArray[np.float64]) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Where nothing solved lies before a pair: whether its first costs more than what follows says, or less.

    `costs` are (lines, n), what is found (lines, n - 1).
    """
    number = places.size - 1
    later = [_shifted(costs, k)[:, :number] for k in range(AHEAD + 1)]
    there = [_shifted(places[None], k)[:, :number] for k in range(AHEAD + 1)]
    line, parabola, cubic = (_polynomial(later[1:k], there[1:k], there[0]) for k in (3, 4, 5))
    # Of four values there is no cubic: the parabola may be off by as much as the line is.
    low = np.where(np.isnan(cubic), np.minimum(line, 2.0 * parabola - line), np.minimum(parabola, cubic))
    high = np.where(np.isnan(cubic), np.maximum(line, 2.0 * parabola - line), np.maximum(parabola, cubic))
    step = np.maximum.reduce([np.abs(value - later[1]) for value in (line, low, high)])
    # How far off the same predictions are one place further in, where there is one.
    off = _shifted(np.fmax(np.abs(later[0] - parabola), np.abs(later[0] - cubic)), 1)
    bent = BENT * (high - low + np.where(np.isnan(off), 0.0, off))
    allowed = bent + STEEP * step + ROUNDING * np.maximum(np.abs(later[0]), np.abs(later[1]))
    is_end = np.isnan(np.column_stack([np.full(len(costs), np.nan), costs[:, : number - 1]]))
    return is_end & (later[0] - high > allowed), is_end & (low - later[0] > allowed)


def _shifted(values: Costs, places: int) -> Costs:
    """Rows (lines, n) begun so many places later, NaN behind their end."""
    return np.column_stack([values[:, places:], np.full((len(values), places), np.nan)])


def _polynomial(values: Sequence[Costs], places: Sequence[Costs], place: Costs) -> Costs:
    """The value at a place of the polynomial through values at others; Neville's algorithm."""
    found = list(values)
    for degree in range(1, len(found)):
        for k in range(len(found) - degree):
            begin, end = places[k], places[k + degree]
            found[k] = ((place - end) * found[k] - (place - begin) * found[k + 1]) / (begin - end)
    return found[0]


def along_dimensions(points: Costs, shape: Sequence[int]) -> list[NDArray[np.float64]]:
    """The place of each row of a grid along its dimensions, for the points (n, quantities) of its cells.

    Where quantities vary together it is the length of the way through them.
    """
    cells, found = points.reshape(*shape, -1), []
    for axis in range(len(shape)):
        found.append(along(np.moveaxis(cells, axis, 0).reshape(shape[axis], -1, points.shape[1])[:, 0]))
    return found


def along(points: Costs) -> NDArray[np.float64]:
    """How far points (n, quantities) are from the first one, along the way through them."""
    parts = np.linalg.norm(np.diff(points, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(parts)])


@dataclass(frozen=True)
class Grid:
    """The neighbours on a grid of cases, or on a block of one, by its shape and the `places` of `jumps_of`."""

    shape: tuple[int, ...]
    places: tuple[NDArray[np.float64], ...]

    def jumps(self, costs: Costs, certain: bool = False) -> list[Pair]:
        """Pairs of neighbours between which the cost (n,) jumps; see `jumps_of`."""
        return jumps_of(costs.reshape(self.shape), self.places, certain)

    def followers(self, worse: int, better: int, costs: Costs) -> list[int]:
        """What may follow a case that was improved: the case behind it, and at an end the neighbour it was begun from.

        No slope beyond tells whether the cost at an end is one with that beside it.
        """
        place, origin = (np.array(np.unravel_index(k, self.shape)) for k in (worse, better))
        behind = self._solved(2 * place - origin, costs)
        return behind if self._solved(2 * origin - place, costs) else [*behind, better]

    def _solved(self, place: NDArray[np.intp], costs: Costs) -> list[int]:
        """The case at a place of the grid, if it is one and has a solution."""
        if (place < 0).any() or (place >= self.shape).any():
            return []
        case = int(np.ravel_multi_index(tuple(place), self.shape))
        return [] if np.isnan(costs[case]) else [case]


BETTER = 1e-7
"""What part of a cost has to be won for a solution to be another one."""


class Solved(Protocol):
    """What is known of a solution: its cost, and whether others may start from it."""

    @property
    def is_start(self) -> bool:
        """Whether they may."""

    @property
    def cost(self) -> float:
        """What it costs, NaN where it is none."""


class Neighbours(Protocol):
    """Which cases are neighbours; their costs (n,) are NaN where there is no solution."""

    def jumps(self, costs: Costs, certain: bool = False) -> list[Pair]:
        """Pairs of neighbours between which the cost jumps, or does so beyond doubt."""

    def followers(self, worse: int, better: int, costs: Costs) -> list[int]:
        """What may follow a case that was improved from its neighbour."""


Found = TypeVar("Found", bound=Solved)


def improved(
    outcomes: Sequence[Found], neighbours: Neighbours, attempt: Callable[[int, Found], Found]
) -> dict[int, list[Found]]:
    """Try the worse side of every jump from its neighbour, and what then jumps, until nothing improves.

    `outcomes` are those of all cases; `attempt` solves a case from a solution. Returns the further attempts at each
    case that has some; of these and its outcome the cheapest solution counts.
    """
    costs = np.array([outcome.cost if outcome.is_start else np.nan for outcome in outcomes])
    best, attempts, tried = list(outcomes), dict[int, list[Found]](), set[tuple[int, int, float]]()
    behind: list[Pair] = []
    while True:
        begun, pairs, behind = len(tried), [*neighbours.jumps(costs), *behind], []
        for worse, better in dict.fromkeys(pairs):
            key = (worse, better, float(costs[better]))
            # Each case may be improved from several sides, but a search has to end.
            if key in tried or len(tried) >= 2 * len(best):
                continue
            tried.add(key)
            found = attempt(worse, best[better])
            if is_better(found, best[worse]):
                best[worse], costs[worse] = found, found.cost
                behind += [(other, worse) for other in neighbours.followers(worse, better, costs)]
            attempts.setdefault(worse, []).append(found)
        if len(tried) == begun:
            return attempts


def is_better(found: Solved, than: Solved) -> bool:
    """Whether a solution is another one than a solution of the same case, and costs less."""
    return found.is_start and found.cost < than.cost - BETTER * abs(than.cost)


SCATTERED_LEAST = 2
"""So many cases for each quantity, and for one more, it takes to see a jump."""
NEAR, MOST_NEAR, AROUND = 2, 6, 4
"""Neighbours that a case is compared with, for each quantity and at most; and, for each, that slopes are taken from."""
OFF, OFF_AT_ENDS = 2.0, 8.0
"""How far off predictions may be, in parts of what is found around; where only one of them is known."""
CERTAIN = 2.0
"""As many times as far off is what is told, and not only tried, where both are known."""
MISSED, FARTHEST = 0.01, 50.0
"""Of a prediction: the part of its way that others may leave out, and second-order terms in squares of its length."""
_BLOCK = 4096
"""Predictions that are prepared at a time, so that memory does not grow with the number of quantities."""


@dataclass(frozen=True, eq=False)
class Scattered:
    """The cases of a chunk that have a solution, in clouds of those that may be compared with each other."""

    clouds: tuple[_Cloud, ...]

    def jumps(self, costs: Costs, certain: bool = False) -> list[Pair]:
        """Pairs of neighbours between which the cost (n,) jumps; those that are `certain` are off by far."""
        return sorted(pair for cloud in self.clouds for pair in cloud.jumps(costs, certain))

    def followers(self, worse: int, better: int, costs: Costs) -> list[int]:
        """What may follow a case that was improved from its neighbour: the cases near behind it."""
        return [other for cloud in self.clouds if worse in cloud.places for other in cloud.behind(worse, better)]


def scattered(points: NDArray[np.float64], families: NDArray[np.intp], solved: NDArray[np.bool_]) -> Scattered:
    """The neighbours among points (n, quantities) of a chunk, in parts of ranges: those of a family (n,) are compared.

    Those that are not `solved` (n,) have no cost.
    """
    clouds = []
    for family in np.unique(families):
        own = np.flatnonzero((families == family) & solved)
        there = points[own]
        there = there[:, np.ptp(there, axis=0) > 0.0] if own.size else there
        if there.shape[1] and own.size >= SCATTERED_LEAST * (there.shape[1] + 1):
            # Cases at points (n, quantities), with their neighbours.
            number, dimensions = there.shape
            around = _nearest(there, min(number - 1, AROUND * dimensions + 2))
            around = _apart_first(there, around)
            near = around[:, : min(NEAR * dimensions, MOST_NEAR)]
            begins = np.broadcast_to(np.arange(number)[:, None], near.shape)
            made = [_predictions(there, around, a.ravel(), b.ravel()) for a, b in ((begins, near), (near, begins))]
            weights = np.stack([found[0].reshape(*near.shape, -1) for found in made])
            seconds = np.stack([found[1].reshape(near.shape) for found in made])
            clouds.append(_Cloud(own, there, around, weights, seconds, dict(zip(own.tolist(), range(number)))))
    return Scattered(tuple(clouds))


@dataclass(frozen=True, eq=False)
class _Cloud:
    """Cases (n,) by their numbers in the chunk, their points, and the nearest `around` (n, k) each.

    The first m of these are compared with it. `weights` (2, n, m, k) are those of differences of costs in a prediction,
    from a case to its neighbour and back, whose second-order terms `seconds` (2, n, m) are NaN where there is none.
    """

    own: NDArray[np.intp]
    points: NDArray[np.float64]
    around: NDArray[np.intp]
    weights: NDArray[np.float64]
    seconds: NDArray[np.float64]
    places: dict[int, int]

    def jumps(self, costs: Costs, certain: bool) -> Iterator[Pair]:
        """Pairs (worse, better) between which the cost jumps, by their numbers in the chunk."""
        own = costs[self.own]
        near = self.around[:, : self.seconds.shape[2]]
        step = own[near] - own[:, None]
        ahead = np.einsum("nmk,nk->nm", self.weights[0], own[self.around] - own[:, None])
        back = np.einsum("nmk,nmk->nm", self.weights[1], own[self.around[near]] - own[near][..., None])
        with np.errstate(invalid="ignore"):
            off = np.where(np.isnan(self.seconds), np.nan, np.stack([step - ahead, -step - back]))
            # The middle one of errors (2, n, m) about each case (n,).
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
        """The neighbours of a case that lie away from another one."""
        case, other = self.places[worse], self.places[better]
        near = self.around[case, : self.seconds.shape[2]]
        ahead = (self.points[near] - self.points[case]) @ (self.points[case] - self.points[other])
        return [int(found) for found in self.own[near[ahead > 0.0]]]


def _nearest(points: NDArray[np.float64], number: int) -> NDArray[np.intp]:
    """So many nearest others (n, number) of each point, nearest first."""
    from scipy.spatial import KDTree  # takes long to import, and grids have no need of it

    near = np.asarray(KDTree(points).query(points, number + 1)[1], dtype=np.intp)
    is_itself = near == np.arange(len(points))[:, None]
    is_itself[~is_itself.any(axis=1), -1] = True  # of points that are there more often than this it is not found
    return np.asarray(near[~is_itself].reshape(len(points), number))


def _apart_first(points: NDArray[np.float64], around: NDArray[np.intp]) -> NDArray[np.intp]:
    """The neighbours (n, k) of points, those first between which and the point none lies, in the ball about both.

    So each has neighbours to all sides, however unevenly they lie. Source: Gabriel and Sokal (1969), Systematic Zoology
    18, A new statistical approach to geographic variation analysis.
    """
    found = []
    for k in range(0, len(around), _BLOCK // 8):
        own = around[k : k + _BLOCK // 8]
        ways = points[own] - points[k : k + len(own), None]
        products = ways @ np.swapaxes(ways, 1, 2)
        squares = np.diagonal(products, axis1=1, axis2=2)[:, None]
        has_between = (squares - products < -1e-12 * squares).any(axis=2)
        found.append(np.take_along_axis(own, np.argsort(has_between, axis=1, kind="stable"), axis=1))
    return np.concatenate(found)


def _predictions(
    points: NDArray[np.float64], around: NDArray[np.intp], begins: NDArray[np.intp], ends: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (p, k) that predict the step from each of p cases to another, and second-order terms (p,)."""
    parts = [
        _slopes(points[around[begins[k : k + _BLOCK]]] - points[begins[k : k + _BLOCK], None],
                points[ends[k : k + _BLOCK]] - points[begins[k : k + _BLOCK]])
        for k in range(0, begins.size, _BLOCK)
    ]  # fmt: skip
    weights, seconds = zip(*parts)
    return np.concatenate(weights), np.concatenate(seconds)


def _slopes(others: NDArray[np.float64], ways: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (p, k) of the costs at `others` (p, k, d) that a plane predicts ways (p, d) from, by those behind alone.

    Their sum of squares, each by the square of its distance, is least.
    """
    squares, distance = (others**2).sum(axis=2), (ways**2).sum(axis=1)
    is_behind = ((others @ ways[:, :, None])[:, :, 0] <= 0.0) & (squares > 0.0)
    counted = np.where(is_behind, 1.0 / np.where(squares > 0.0, squares, 1.0), 0.0)
    weighted = others * counted[:, :, None]
    normal = np.swapaxes(weighted, 1, 2) @ others
    # Where others lie on a line or a plane, what they do not reach is left out.
    size = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    normal += np.where(size > 0.0, 1e-9 * size, 1.0) * np.eye(ways.shape[1])
    weights = (weighted @ np.linalg.solve(normal, ways[:, :, None]))[:, :, 0]
    left = (((weights[:, None] @ others)[:, 0] - ways) ** 2).sum(axis=1)
    seconds = distance + (np.abs(weights) * squares).sum(axis=1)
    is_one = (distance > 0.0) & (left <= MISSED**2 * distance) & (seconds <= FARTHEST * distance)
    return weights, np.where(is_one, seconds, np.nan)


def _middle(table: NDArray[np.float64]) -> NDArray[np.float64]:
    """The middle value of each row, the lower one of two, without those that are NaN."""
    number = np.maximum(1, np.isfinite(table).sum(axis=1))
    return np.asarray(np.sort(table, axis=1)[np.arange(len(table)), (number - 1) // 2])
