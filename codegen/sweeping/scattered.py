"""Jumps between local optima among cases that are no grid: samples, and the rows of a table.

Two neighbours are compared as on a line of a grid: of a smooth cost their difference lies between those that the slopes
on either side predict, where the slope at a case is that of a plane through it and those of its neighbours that lie
away from the other case. So where both predictions are off to the same side there is a jump between them. How far off
predictions of a smooth cost are is seen around: the middle one of their errors there, each in parts of its second-order
term. Source of planes through scattered neighbours: Lancaster and Salkauskas (1981), Mathematics of Computation 37.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.sweeping.jumps import BENT, ROUNDING, STEEP, Costs, Pair

LEAST = 2
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
        if there.shape[1] and own.size >= LEAST * (there.shape[1] + 1):
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
