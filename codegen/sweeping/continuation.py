"""Starts along a path through cases: where one from a case's own guess fails, or before it, from solved neighbours.

On a straight part of the path a start follows the secant through the last two solutions, and where derivatives of the
last one are known the parabola that has its tangent there; elsewhere it follows this tangent. On a grid of cases secant
and tangent are off by the square of their distance, the parabola by its cube. Source: Allgower and Georg (1990),
Numerical continuation methods, chapters 2 and 6.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from codegen.interfaces import Matrix

OTHERS = 3
"""How many neighbours are tried after the problem's own guess."""
FARTHEST = 2.0
"""How far a secant is followed, in parts of the distance of the two solutions that it goes through."""
STRAIGHT = 1e-6
"""What part of a move may lie beside the direction of the one before."""


Found = TypeVar("Found", bound="Attempted")


class Attempted(Protocol):
    """What an attempt leaves: whether it is a solution that others may start from."""

    @property
    def is_start(self) -> bool:
        """Whether it is."""

    @property
    def has_tangent(self) -> bool:
        """Whether it is known how it follows what varies."""

    def without_tangent(self: Found) -> Found:
        """The same without this knowledge, which takes memory."""


@dataclass(frozen=True)
class Start(Generic[Found]):
    """A solution to start from, moved by so many times its difference from another one, along its tangent, or both."""

    solution: Found
    before: Found | None = None
    factor: float = 0.0
    is_along_tangent: bool = False

    @property
    def is_moved(self) -> bool:
        """Whether it is not the solution itself."""
        return self.is_along_tangent or self.before is not None


class Continuation(Generic[Found]):
    """The solutions of a chunk so far, and where the next case begins.

    `points` (n, quantities) are the cases in parts of each quantity's range, `families` (n,) tells which of them have
    the same module: only these start from each other. Where starts are `warm` the last neighbour comes before the
    problem's own guess.
    """

    def __init__(self, points: Matrix, families: NDArray[np.intp], warm: bool) -> None:
        self._points, self._families, self._warm = points, families, warm
        self._coordinates: list[list[float]] = points.tolist()  # of single points, for which arrays are slow
        self._solved: dict[int, Found] = {}
        self._path: dict[int, list[int]] = {}

    def solve(self, index: int, attempt: Callable[[Start[Found] | None], Found]) -> list[Found]:
        """The attempts at a case, the last of which is its outcome: the first that is solved, else from its own guess.

        `attempt` is given what to start from, or None for the problem's own guess.
        """
        attempts: list[Found] = []
        own: Found | None = None
        for start in self._starts(index):
            found = attempt(start)
            attempts.append(found)
            if found.is_start:
                path = self._path.setdefault(int(self._families[index]), [])
                if path:
                    self._solved[path[-1]] = self._solved[path[-1]].without_tangent()
                path.append(index)
                self._solved[index] = found
                return [*attempts[:-1], found.without_tangent()]
            own = found if start is None else own
        assert own is not None, "a case is tried from its own guess in any case"
        return [*(found for found in attempts if found is not own), own]

    def _starts(self, index: int) -> Iterator[Start[Found] | None]:
        family = int(self._families[index])
        path = self._path.get(family, [])
        first = self._first(index, path) if self._warm else None
        if first is not None:
            yield first
        yield None
        others = path[:-1] if first is not None and not first.is_moved else path
        for other in self._nearest(index, others):
            yield Start(self._solved[other])

    def _first(self, index: int, path: Sequence[int]) -> Start[Found] | None:
        """The last solution, moved along its tangent, and by the secant through the last two if the case lies there."""
        if not path:
            return None
        last = self._solved[path[-1]]
        if len(path) == 1:
            return Start(last, is_along_tangent=last.has_tangent)
        began, ended, wanted = (self._coordinates[k] for k in (path[-2], path[-1], index))
        one = [b - a for a, b in zip(began, ended, strict=True)]
        two = [b - a for a, b in zip(ended, wanted, strict=True)]
        square = sum(a * a for a in one)
        factor = sum(a * b for a, b in zip(one, two, strict=True)) / square if square > 0.0 else 0.0
        beside = sum((b - factor * a) ** 2 for a, b in zip(one, two, strict=True))
        if abs(factor) > FARTHEST or not beside <= STRAIGHT**2 * sum(b * b for b in two):
            return Start(last, is_along_tangent=last.has_tangent)
        return Start(last, self._solved[path[-2]], factor, last.has_tangent)

    def _nearest(self, index: int, others: Sequence[int]) -> list[int]:
        if not others:
            return []
        distances = ((self._points[others] - self._points[index]) ** 2).sum(axis=1)
        return [others[k] for k in np.argsort(distances, kind="stable")[:OTHERS]]
