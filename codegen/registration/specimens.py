"""Specimens: homologous landmarks of many individuals, their superimposition, and distances in two dimensions."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, LandmarkError, PointsError
from codegen.registration.alignment import align
from codegen.registration.formats.base import Source
from codegen.registration.formats.tps import specimens_of
from codegen.registration.pairs import LandmarkPairs

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
