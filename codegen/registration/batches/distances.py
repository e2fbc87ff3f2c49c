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
from io import StringIO
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors import Progress, Team, Working, silent
from codegen.batch.executors.chunks import LOST, SOLVED, Abandoned, Done, Tally
from codegen.errors import ArgumentError, CodegenError, LandmarkError, PointsError
from codegen.files import replacing
from codegen.registration.alignment import align
from codegen.registration.formats.base import Source
from codegen.registration.formats.tps import specimens_of
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.register import register
from codegen.registration.solver import DEFAULT_SCHEME, registration_module

COLUMNS = ("specimen", "x", "y")
SIDE = 1000
"""Pixels along the square in which specimens lie, so that all pairs have one disc."""
EXTENT = 0.45
"""The distance of the outermost landmark from the middle, as a share of the side."""
ROUNDS, SETTLED = 50, 1e-10

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Specimens:
    """Landmarks of m specimens, shape (m, n, 2), and the specimens' names."""

    landmarks: Array
    names: tuple[str, ...]


def read_specimens(path: Path) -> Specimens:
    """Read a TPS file, or a table with the columns specimen, x, y; PointsError names what cannot be compared."""
    try:
        text = path.read_text(encoding="latin-1" if path.suffix.lower() == ".tps" else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise PointsError(f"{path} is no text", "give a .tps file, or a table (.csv)") from error
    except OSError as error:
        raise ArgumentError(f"{path} cannot be read ({error.strerror})", "check the name") from error
    found = _of_tps(path, text) if path.suffix.lower() == ".tps" else _of_table(path, text)
    if len(found) < 3:
        raise PointsError(f"{path} holds {len(found)} specimens", "give three or more")
    sizes = {name: len(points) for name, points in found.items()}
    first, usual = next(iter(sizes.items()))
    for name, size in sizes.items():
        if size != usual:
            finding = f"{path}: specimen {name} has {size} landmarks, and {first} has {usual}"
            raise PointsError(finding, "give the same landmarks of every specimen, in the same order")
    return Specimens(np.array(list(found.values())), tuple(found))


def _of_tps(path: Path, text: str) -> dict[str, list[tuple[float, float]]]:
    found: dict[str, list[tuple[float, float]]] = {}
    for number, specimen in enumerate(specimens_of(Source(path.name, text)), 1):
        name = specimen.identity or specimen.image or str(number)
        if name in found:
            name = f"{name} ({number})"
        points = [point for point in specimen.points if point is not None]
        if len(points) < len(specimen.points):
            raise PointsError(f"{path}: specimen {name} lacks a landmark", "leave out what not all specimens have")
        found[name] = points
    return found


def _of_table(path: Path, text: str) -> dict[str, list[tuple[float, float]]]:
    reader = csv.DictReader(StringIO(text))
    if tuple(reader.fieldnames or ()) != COLUMNS:
        columns = ",".join(reader.fieldnames or ())[:60]
        raise PointsError(f"{path}: the columns are {columns or 'missing'}", f"give {','.join(COLUMNS)}")
    found: dict[str, list[tuple[float, float]]] = {}
    for number, row in enumerate(reader, 2):
        try:
            point = float(row["x"]), float(row["y"])
        except (TypeError, ValueError):
            point = np.nan, np.nan
        if not np.isfinite(point).all():
            raise PointsError(f"{path}:{number}: x and y are no numbers", "give two finite numbers a row")
        found.setdefault(row["specimen"], []).append(point)
    return found


def superimposed(specimens: Specimens) -> tuple[Array, Array]:
    """Specimens brought to one place, size and direction, shape (m, n, 2), and their mean shape, shape (n, 2).

    Each is aligned with the mean by a similarity without reflection, until the mean stays (generalised Procrustes
    analysis: Gower 1975, Psychometrika 40(1)); then all are scaled into a square of SIDE pixels. LandmarkError names a
    specimen that is mirrored.
    """
    shapes = np.array([normal(points) for points in specimens.landmarks])
    mean = shapes[0]
    for _ in range(ROUNDS):
        for k, points in enumerate(shapes):
            try:
                shapes[k] = align(LandmarkPairs(points, mean), "similarity").apply(points)
            except LandmarkError as error:
                remedy = "mirror that specimen" if "mirror" in error.finding else error.remedy
                raise LandmarkError(f"specimen {specimens.names[k]}: {error.finding}", remedy) from error
        before, mean = mean, normal(shapes.mean(axis=0))
        if np.abs(mean - before).max() < SETTLED:
            break
    scale = EXTENT * SIDE / np.linalg.norm(shapes, axis=2).max()  # which no rotation changes
    return scale * shapes + 0.5 * (SIDE - 1), scale * mean + 0.5 * (SIDE - 1)


def normal(points: Array) -> Array:
    """About the origin, with squares of distances that sum up to 1."""
    centred = points - points.mean(axis=0)
    return np.asarray(centred / np.linalg.norm(centred))


def classical_scaling(distances: Array, dimensions: int = 2) -> tuple[Array, float]:
    """Points whose distances are about those of a table, shape (m, m), and the share of it that they explain.

    They are the leading eigenvectors of -1/2 J D^2 J (Torgerson 1952, Psychometrika 17(4)), shape (m, dimensions), with
    signs such that the largest entry of each is positive. The share is that of the absolute eigenvalues.
    """
    count = len(distances)
    centring = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centring @ np.asarray(distances) ** 2 @ centring)
    values, vectors = values[::-1], vectors[:, ::-1]
    vectors = vectors * np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)])
    leading = np.maximum(values[:dimensions], 0.0)
    whole = float(np.abs(values).sum())
    return vectors[:, :dimensions] * np.sqrt(leading), float(leading.sum()) / whole if whole > 0.0 else 1.0


def pairs_of(count: int) -> list[tuple[int, int]]:
    """All pairs of so many specimens, each of them once."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def whole_table(count: int, distances: Sequence[float]) -> Array:
    """The symmetric table of distances that come in the order of `pairs_of`, shape (count, count)."""
    table = np.zeros((count, count))
    for (i, j), distance in zip(pairs_of(count), distances, strict=True):
        table[i, j] = table[j, i] = distance
    return table


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
                found = register(LandmarkPairs(self.shapes[one], self.shapes[other]), (SIDE, SIDE), align="none")
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
