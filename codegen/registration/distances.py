"""Geodesic distances between all pairs of specimens, on several processes: the command `codegen distances`.

The squared distance of two specimens is the cost of the motion that carries the landmarks of the first to the second.
The distance is the length of this motion, a geodesic in the metric of registrations.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from codegen.batch.executors import LOST, SOLVED, Abandoned, Done, Progress, Tally, Team, silent
from codegen.errors import ArgumentError, CodegenError, LandmarkError, PointsError
from codegen.files import replacing
from codegen.registration.formats.base import Source
from codegen.registration.formats.tps import specimens_of
from codegen.registration.pairs import LandmarkPairs, align
from codegen.registration.register import register
from codegen.registration.solver import DEFAULT_SCHEME, registration_module
from codegen.solving.progress import Working

COLUMNS = ("specimen", "x", "y")
SIDE = 1000  # the side, in pixels, of the square that contains all specimens, so that all pairs have the same disc
EXTENT = 0.45  # the distance of the outermost landmark from the middle of the square, relative to its side
ROUNDS, SETTLED = 50, 1e-10  # most iterations of the mean shape, and its largest change after convergence

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Specimens:
    """Landmarks of m specimens, shape (m, n, 2), and the names of the specimens."""

    landmarks: Array
    names: tuple[str, ...]


def read_specimens(path: Path) -> Specimens:
    """Read a TPS file, or a CSV table of specimen, x, y; PointsError if specimens have different landmarks."""
    try:
        text = path.read_text(encoding="latin-1" if path.suffix.lower() == ".tps" else "utf-8-sig")
    except UnicodeDecodeError as error:
        raise PointsError(f"{path} is no text", "give a .tps file, or a table (.csv)") from error
    except OSError as error:
        raise ArgumentError(f"{path} cannot be read ({error.strerror})", "check the name") from error
    specimens: dict[str, list[tuple[float, float]]] = {}
    if path.suffix.lower() == ".tps":
        for number, specimen in enumerate(specimens_of(Source(path.name, text)), 1):
            name = specimen.identity or specimen.image or str(number)
            if name in specimens:
                name = f"{name} ({number})"
            points = [point for point in specimen.points if point is not None]
            if len(points) < len(specimen.points):
                raise PointsError(f"{path}: specimen {name} lacks a landmark", "leave out what not all specimens have")
            specimens[name] = points
    else:
        reader = csv.DictReader(StringIO(text))
        if tuple(reader.fieldnames or ()) != COLUMNS:
            columns = ",".join(reader.fieldnames or ())[:60]
            raise PointsError(f"{path}: the columns are {columns or 'missing'}", f"give {','.join(COLUMNS)}")
        for number, row in enumerate(reader, 2):
            try:
                point = float(row["x"]), float(row["y"])
            except (TypeError, ValueError):
                point = np.nan, np.nan
            if not np.isfinite(point).all():
                raise PointsError(f"{path}:{number}: x and y are no numbers", "give two finite numbers a row")
            specimens.setdefault(row["specimen"], []).append(point)
    if len(specimens) < 3:
        raise PointsError(f"{path} holds {len(specimens)} specimens", "give three or more")
    first, usual = next((name, len(points)) for name, points in specimens.items())
    for name, points in specimens.items():
        if len(points) != usual:
            finding = f"{path}: specimen {name} has {len(points)} landmarks, and {first} has {usual}"
            raise PointsError(finding, "give the same landmarks of every specimen, in the same order")
    return Specimens(np.array(list(specimens.values())), tuple(specimens))


def superimposed(specimens: Specimens) -> tuple[Array, Array]:
    """Return the superimposed specimens, shape (m, n, 2), and their mean shape, shape (n, 2), in pixels.

    Each specimen is aligned with the mean by a similarity without reflection, until the mean is constant (generalised
    Procrustes analysis: Gower 1975, Psychometrika 40(1)). Then all specimens are scaled into a square of SIDE pixels.
    Raise LandmarkError, with the name, for a mirrored specimen.
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
    scale = EXTENT * SIDE / np.linalg.norm(shapes, axis=2).max()  # invariant under rotations
    return scale * shapes + 0.5 * (SIDE - 1), scale * mean + 0.5 * (SIDE - 1)


def normal(points: Array) -> Array:
    """Move the mean of points to the origin, and scale the sum of their squared coordinates to 1."""
    centred = points - points.mean(axis=0)
    return np.asarray(centred / np.linalg.norm(centred))


def classical_scaling(distances: Array) -> tuple[Array, float]:
    """Return points, shape (m, 2), whose distances approximate a table (m, m), and the share they explain.

    The points are the leading eigenvectors of -1/2 J D^2 J (Torgerson 1952, Psychometrika 17(4)). The largest entry of
    each eigenvector is positive. The share is the sum of the leading eigenvalues over the sum of all absolute values.
    """
    count = len(distances)
    centring = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centring @ np.asarray(distances) ** 2 @ centring)
    values, vectors = values[::-1], vectors[:, ::-1]
    vectors = vectors * np.sign(vectors[np.abs(vectors).argmax(axis=0), np.arange(count)])
    leading = np.maximum(values[:2], 0.0)
    whole = float(np.abs(values).sum())
    return vectors[:, :2] * np.sqrt(leading), float(leading.sum()) / whole if whole > 0.0 else 1.0


def pairs_of(count: int) -> list[tuple[int, int]]:
    """Return all pairs (i, j) with i < j of `count` specimens."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


FAILED = "not converged"
FEWEST = 3  # fewest specimens that are shown as points in two dimensions
MOST = 16  # most pairs of specimens in a chunk of work


@dataclass(frozen=True, eq=False)
class Distances:
    """A `table` of the distances between m specimens, shape (m, m), NaN for failures, and its approximation by points.

    `points`, shape (m, 2), are the result of `classical_scaling` and explain a `share` of the table. They are NaN for
    specimens that were left out because of missing distances. `mean`, shape (n, 2), is the mean shape, centred and
    scaled by `normal`. `failed` has a message for each missing distance.
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
    """Superimpose the specimens, and return the lengths of the geodesics between all pairs."""
    shapes, mean = superimposed(specimens)
    with working("Preparing the solver"):
        registration_module(DEFAULT_SCHEME)
    count = len(shapes)
    pairs = pairs_of(count)
    size = max(1, min(MOST, len(pairs) // (4 * workers)))
    work, results = DistanceWork(shapes, specimens.names, size), dict[int, Done]()
    Team(workers, None, working, progress).do(
        work, work.chunks, len(pairs), Tally(), results.__setitem__, ("Comparing", "pairs")
    )
    rows = [row for number in work.chunks for row in results[number].rows]
    table = np.zeros((count, count))
    for (i, j), (distance, _) in zip(pairs, rows, strict=True):
        table[i, j] = table[j, i] = distance
    failed = tuple(message for _, message in rows if message)
    # Leave out the specimen that lacks most distances, until no distance is missing.
    points, kept, share = np.full((count, 2), np.nan), np.arange(count), np.nan
    while (lacking := np.isnan(table[np.ix_(kept, kept)]).sum(axis=1)).any():
        kept = np.delete(kept, lacking.argmax())
    if len(kept) >= FEWEST:
        points[kept], share = classical_scaling(table[np.ix_(kept, kept)])
    return Distances(specimens.names, table, points, share, normal(mean), failed)


@dataclass(frozen=True, eq=False)
class DistanceWork:
    """The comparison of all pairs of superimposed specimens, shape (m, n, 2), in chunks of `size` pairs."""

    shapes: NDArray[np.float64]
    names: tuple[str, ...]
    size: int
    is_compiled = False  # Python code takes much of the time of a short registration

    @property
    def chunks(self) -> range:
        """The numbers of the chunks."""
        return range(-(-len(pairs_of(len(self.shapes))) // self.size))

    def loaded(self) -> DistanceWork:
        """Load the solver in this process, and return the work."""
        registration_module(DEFAULT_SCHEME)
        return self

    def piece(self, number: int) -> Sequence[tuple[int, int]]:
        """Return the pairs of specimens in a chunk."""
        return pairs_of(len(self.shapes))[number * self.size : (number + 1) * self.size]

    def solve(self, piece: Sequence[tuple[int, int]], is_wanted: Callable[[], bool] = lambda: True) -> Done:
        """Return a distance, or a message, for each pair; raise Abandoned as soon as `is_wanted` returns False."""
        rows, begin = [], time.perf_counter()
        for i, j in piece:
            if not is_wanted():
                raise Abandoned
            rows.append(self._compared(i, j))
        return _done(rows, FAILED, time.perf_counter() - begin)

    def _compared(self, i: int, j: int) -> tuple[float, str]:
        """Return the length of the shorter geodesic of both directions, or NaN and the reason of the failure.

        There may be several geodesics between two specimens; the initial guess determines which geodesic is found.
        """
        lengths, message = [], ""
        for one, other in ((i, j), (j, i)):
            try:
                geodesic = register(LandmarkPairs(self.shapes[one], self.shapes[other]), (SIDE, SIDE), align="none")
            except CodegenError as error:
                message = self._named(one, other, str(error))
                continue
            if geodesic.status == SOLVED:
                lengths.append(geodesic.distance)
            else:
                message = self._named(one, other, geodesic.message)
        return (min(lengths), "") if lengths else (np.nan, message)

    def _named(self, i: int, j: int, message: str) -> str:
        return f"{self.names[i]} and {self.names[j]}: {message}"

    def lost(self, number: int, reason: str) -> Done:
        """Return a chunk of failures with a `reason`, for a chunk whose worker processes ended."""
        return _done([(np.nan, self._named(i, j, reason)) for i, j in self.piece(number)], LOST, 0.0)

    def returned(self, number: int, done: Done) -> Done:
        """Return the result of a worker unchanged."""
        return done

    def parcel(self) -> NoReturn:
        """Raise ArgumentError, because distances are not computed on clusters: they take seconds."""
        raise ArgumentError("distances between specimens need no cluster", "leave --cluster out")


def _done(rows: Sequence[tuple[float, str]], failure: str, seconds: float) -> Done:
    statuses = [failure if message else SOLVED for _, message in rows]
    return Done(Tally.of(statuses, [message for _, message in rows], seconds), rows)


def write_distances(path: Path, distances: Distances) -> None:
    """Write a CSV table with a row for each specimen: its name, point and distances, empty for NaN."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["specimen", "mds_1", "mds_2", *distances.names])
        for name, point, row in zip(distances.names, distances.points, distances.table, strict=True):
            writer.writerow([name, *(_text(value) for value in (*point, *row))])


def write_mean(path: Path, distances: Distances) -> None:
    """Write the mean shape as CSV, with the columns landmark, x and y."""
    with replacing(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["landmark", "x", "y"])
        writer.writerows([k, *map(_text, point)] for k, point in enumerate(distances.mean, 1))


def _text(value: float) -> str:
    return f"{value:.12g}" if np.isfinite(value) else ""
