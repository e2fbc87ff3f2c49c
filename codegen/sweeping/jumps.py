"""Jumps between local optima: where the cost along a grid is not smooth.

Along a line of a smooth function the difference of two neighbours lies between those that the slopes on either side
predict, or close to it. Where one branch of optima takes over from another at equal cost it still does; where a search
has ended on the worse of two, the difference lies outside. At an end, of a line or before a case without a solution,
there is a slope on one side only: a cost there is expected where a parabola and a cubic through what follows lead. One
that lies elsewhere is worth a solve and nothing more, since a smooth cost may well grow faster towards an end.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
