"""Geodesic distances between all specimens, shared between processes: the way of `codegen distances`.

The squared distance of two specimens is the cost of the motion that carries the landmarks of one to those of the
other, so the distance is the length of a geodesic in the metric in which images are registered.
"""

from __future__ import annotations

import csv
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from codegen.engines.tally import LOST, SOLVED, Tally
from codegen.engines.team import Progress, Team, Working, silent
from codegen.engines.work import Abandoned, Done
from codegen.errors import ArgumentError, CodegenError
from codegen.files import replacing
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.smoothing import registered
from codegen.registration.solver import DEFAULT_SCHEME, registration_module
from codegen.registration.specimens import (
    SIDE,
    Specimens,
    classical_scaling,
    normal,
    pairs_of,
    superimposed,
    whole_table,
)

FAILED = "not converged"
FEWEST = 3
"""Specimens that a picture in two dimensions needs."""
MOST = 16
"""The most pairs of a chunk."""


@dataclass(frozen=True, eq=False)
class Distances:
    """Distances between m specimens, shape (m, m), NaN where none was found, and what is made of them.

    `points`, shape (m, 2), are the specimens in two dimensions, which explain a `share` of the table; NaN are those
    that had to be left out because distances are missing. `mean` is the mean shape, shape (n, 2), about the origin,
    with squares of distances from it that sum up to 1.
    """

    names: tuple[str, ...]
    table: NDArray[np.float64]
    points: NDArray[np.float64]
    share: float
    mean: NDArray[np.float64]
    failed: tuple[str, ...]


def geodesic_distances(
    specimens: Specimens, workers: int = 1, working: Working = nullcontext, progress: Progress = silent
) -> Distances:
    """Superimpose specimens and solve for the geodesic between each two of them."""
    shapes, mean = superimposed(specimens)
    with working("Preparing the solver"):
        registration_module(DEFAULT_SCHEME)
    count = len(shapes)
    size = max(1, min(MOST, len(pairs_of(count)) // (4 * workers)))
    work, found = DistanceWork(shapes, specimens.names, size), dict[int, Done]()
    Team(workers, None, working, progress).do(
        work, work.chunks, len(pairs_of(count)), Tally(), found.__setitem__, ("Comparing", "pairs")
    )
    rows = [row for number in work.chunks for row in found[number].rows]
    table = whole_table(count, [distance for distance, _ in rows])
    failed = tuple(said for _, said in rows if said)
    points, share = _scaled(table)
    return Distances(specimens.names, table, points, share, normal(mean), failed)


def _scaled(table: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Specimens in two dimensions; left out, one after the other, are those that lack most distances to others."""
    points, kept = np.full((len(table), 2), np.nan), np.arange(len(table))
    while (lacking := np.isnan(table[np.ix_(kept, kept)]).sum(axis=1)).any():
        kept = np.delete(kept, lacking.argmax())
    if len(kept) < FEWEST:
        return points, np.nan
    points[kept], share = classical_scaling(table[np.ix_(kept, kept)])
    return points, share


@dataclass(frozen=True, eq=False)
class DistanceWork:
    """All that comparing any two superimposed specimens needs; `size` pairs are a chunk."""

    shapes: NDArray[np.float64]
    names: tuple[str, ...]
    size: int

    @property
    def chunks(self) -> range:
        """The numbers of all chunks."""
        return range(-(-len(pairs_of(len(self.shapes))) // self.size))

    def loaded(self) -> DistanceWork:
        """The same; the solver is loaded in this process."""
        registration_module(DEFAULT_SCHEME)
        return self

    def piece(self, number: int) -> Sequence[tuple[int, int]]:
        """The pairs of a chunk."""
        return pairs_of(len(self.shapes))[number * self.size : (number + 1) * self.size]

    def solve(self, piece: Sequence[tuple[int, int]], is_wanted: Callable[[], bool] = lambda: True) -> Done:
        """A distance for each pair, and what is said where there is none."""
        rows, begin = [], time.perf_counter()
        for i, j in piece:
            if not is_wanted():
                raise Abandoned
            rows.append(self._compared(i, j))
        return _done(rows, FAILED, time.perf_counter() - begin)

    def _compared(self, i: int, j: int) -> tuple[float, str]:
        """The shorter of the geodesics that are found from one to the other and back, or why there is none.

        There may be several between two specimens, and the way on which the solver begins decides which it finds.
        """
        lengths, said = [], ""
        for one, other in ((i, j), (j, i)):
            try:
                found = registered(LandmarkPairs(self.shapes[one], self.shapes[other]), (SIDE, SIDE), align="none")
            except CodegenError as error:
                said = self._said(one, other, str(error))
                continue
            if found.status == SOLVED:
                lengths.append(found.distance)
            else:
                said = self._said(one, other, found.message)
        return (min(lengths), "") if lengths else (np.nan, said)

    def _said(self, i: int, j: int, message: str) -> str:
        return f"{self.names[i]} and {self.names[j]}: {message}"

    def lost(self, number: int, reason: str) -> Done:
        """A chunk whose processes ended."""
        return _done([(np.nan, self._said(i, j, reason)) for i, j in self.piece(number)], LOST, 0.0)

    def returned(self, number: int, done: Done) -> Done:
        """Distances come back with what is done."""
        return done

    def parcel(self) -> NoReturn:
        """Distances are a matter of seconds, and of one machine."""
        raise ArgumentError("distances between specimens need no cluster", "leave --cluster out")


def _done(rows: Sequence[tuple[float, str]], failure: str, seconds: float) -> Done:
    counts = Counter(failure if said else SOLVED for _, said in rows)
    messages = {failure: next(said for _, said in rows if said)} if failure in counts else {}
    return Done(Tally(counts, messages, seconds), rows)


def write_distances(path: Path, found: Distances) -> None:
    """The table as CSV: a row and a column for each specimen, and its place in two dimensions; empty where unknown."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["specimen", "mds_1", "mds_2", *found.names])
        for name, point, row in zip(found.names, found.points, found.table, strict=True):
            writer.writerow([name, *(_text(value) for value in (*point, *row))])


def write_mean(path: Path, found: Distances) -> None:
    """The mean shape as CSV: landmark, x and y."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["landmark", "x", "y"])
        writer.writerows([k, *map(_text, point)] for k, point in enumerate(found.mean, 1))


def _text(value: Any) -> str:
    return f"{value:.12g}" if np.isfinite(value) else ""
