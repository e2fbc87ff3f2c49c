"""Warm starts along a path through cases: each begins from a neighbour that was solved, with other ways if that fails.

Source: Allgower and Georg (1990), Numerical continuation methods, for solutions as starts of neighbouring problems.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from codegen.loading import Matrix

OTHERS = 3
"""How many further neighbours are tried after the last one and the problem's own guess."""


class Attempted(Protocol):
    """What an attempt leaves: whether it is a solution that others may start from."""

    @property
    def is_start(self) -> bool:
        """Whether it is."""


Found = TypeVar("Found", bound=Attempted)


class Continuation(Generic[Found]):
    """The solutions of a chunk so far, and where the next case begins.

    `points` (n, quantities) are the cases in parts of each quantity's range, `families` (n,) tells which of them have
    the same module: only these start from each other.
    """

    def __init__(self, points: Matrix, families: NDArray[np.intp]) -> None:
        self._points, self._families = points, families
        self._solved: dict[int, Found] = {}
        self._last: dict[int, int] = {}

    def solve(self, place: int, attempt: Callable[[Found | None], Found]) -> list[Found]:
        """The attempts at a case, the last of which is its outcome: the first that is solved, else from its own guess.

        `attempt` is given the solution to start from, or None for the problem's own guess.
        """
        attempts: list[Found] = []
        own: Found | None = None
        for start in self._starts(place):
            found = attempt(start)
            attempts.append(found)
            if found.is_start:
                self._solved[place] = found
                self._last[int(self._families[place])] = place
                return attempts
            own = found if start is None else own
        assert own is not None, "a case is tried from its own guess in any case"
        return [*(found for found in attempts if found is not own), own]

    def _starts(self, place: int) -> Iterator[Found | None]:
        family = int(self._families[place])
        last = self._last.get(family)
        if last is not None:
            yield self._solved[last]
        yield None
        for other in self._nearest(
            place, [key for key in self._solved if self._families[key] == family and key != last]
        ):
            yield self._solved[other]

    def _nearest(self, place: int, others: Sequence[int]) -> list[int]:
        if not others:
            return []
        distances = ((self._points[others] - self._points[place]) ** 2).sum(axis=1)
        return [others[k] for k in np.argsort(distances, kind="stable")[:OTHERS]]
