"""What every landmark format shares: how it is described, text with its file's name, limits, points in a plane."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePath

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError, PointsError
from codegen.registration.grid import Grid
from codegen.registration.pairs import LandmarkPairs

MOST_BYTES = 8 << 20
"""A larger file is refused before it is read; 10 000 landmarks take a tenth of this, or half of it in Slicer's form."""

MOST_LANDMARKS = 10_000
"""The interactions of n landmarks are a matrix of 8 n² bytes: 800 MB here."""

FLAT = 1e-3
"""Pixels by which the third coordinates of landmarks may differ: rounding, but no other slice."""


@dataclass(frozen=True)
class Source:
    """The text of a file and the name by which errors call it."""

    name: str
    text: str


@dataclass(frozen=True)
class Frames:
    """The images between which landmarks lie, as far as they are known: shapes (height, width, ...) and file names.

    With the grids of a moving and a fixed volume, `grids`, landmarks have three coordinates, which are made those of
    the grids: as a rule LPS in millimetres.
    """

    moving_shape: tuple[int, ...] | None = None
    fixed_shape: tuple[int, ...] | None = None
    moving_name: str = ""
    fixed_name: str = ""
    grids: tuple[Grid, Grid] | None = None

    @property
    def axes(self) -> str:
        """The names of the coordinates that landmarks must have."""
        return "xy" if self.grids is None else "xyz"


@dataclass(frozen=True)
class Format:
    """A landmark format.

    `parse` takes one text, or first the moving and then the fixed one where `files` is 2; `compose` returns as many.
    `recognises` looks at the beginning of a text, to tell formats with the same suffix apart. `encoding` is tried for
    what is no UTF-8. Both functions raise PointsError, naming the file and the line.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    files: int
    recognises: Callable[[str], bool]
    parse: Callable[[Sequence[Source], Frames], LandmarkPairs]
    compose: Callable[[LandmarkPairs, Frames], tuple[str, ...]]
    encoding: str | None = None


def rows(source: Source) -> Iterator[tuple[int, list[str]]]:
    """Lines that are not empty, as fields of a comma-separated table, with their numbers; no more than are allowed."""
    reader = csv.reader(io.StringIO(source.text, newline=""))
    count = 0
    try:
        for row in reader:
            if any(map(str.strip, row)):
                count += 1
                require_count(source.name, count - 1)
                yield reader.line_num, [field.strip() for field in row]
    except csv.Error as error:
        raise PointsError(f"{source.name}:{reader.line_num}: {error}", "give a table of numbers as text") from error


def require_count(name: str, count: int) -> None:
    """Refuse more landmarks than could be registered."""
    if count > MOST_LANDMARKS:
        raise PointsError(f"{name} holds more than {MOST_LANDMARKS} landmarks", "give fewer")


def made(
    sources: Sequence[Source],
    moving: Sequence[Sequence[float]] | NDArray[np.float64],
    fixed: Sequence[Sequence[float]] | NDArray[np.float64],
    names: Sequence[str] = (),
) -> LandmarkPairs:
    """Pairs of landmarks; PointsError names the files where they cannot be matched."""
    where = " and ".join(source.name for source in sources)
    if not len(moving) and not len(fixed):
        raise PointsError(f"{where} holds no landmarks", "give at least one pair")
    try:
        return LandmarkPairs(np.array(moving, dtype=float), np.array(fixed, dtype=float), tuple(names))
    except LandmarkError as error:
        raise PointsError(f"{where}: {error.finding}", error.remedy) from error


def in_plane(name: str, what: str, points: Sequence[Sequence[float]]) -> list[tuple[float, float]]:
    """The x and y of points with two or three coordinates; PointsError when the third ones differ: two slices."""
    heights = [point[2] for point in points if len(point) > 2]
    if heights and max(heights) - min(heights) > FLAT:
        finding = f"{name}: {what} landmarks have z from {min(heights):g} to {max(heights):g}"
        raise PointsError(finding, "give landmarks of one slice; images in the plane are registered")
    return [(point[0], point[1]) for point in points]


def placed(name: str, what: str, points: Sequence[Sequence[float]], frames: Frames) -> list[tuple[float, ...]]:
    """Points as the images ask for them: with x and y, or with x, y and z; PointsError where they have others."""
    if frames.grids is None:
        return list(in_plane(name, what, points))
    if any(len(point) != 3 for point in points):
        finding = f"{name}: {what} landmarks have x and y alone, and the images are volumes"
        raise PointsError(finding, "give three coordinates of every landmark")
    return [tuple(point) for point in points]


def require_order(sources: Sequence[Source]) -> None:
    """Refuse a pair of files whose names say that they were given the wrong way round."""
    moving, fixed = (PurePath(source.name).name.lower() for source in sources)
    if ("fixed" in moving and "moving" not in moving) or ("moving" in fixed and "fixed" not in fixed):
        raise PointsError(
            f"{sources[0].name} is given for the moving image and {sources[1].name} for the fixed one",
            "give the moving file first, or rename the files if their names mislead",
        )


def text_of(number: float) -> str:
    """The shortest text that is read back as the same number."""
    return repr(float(number))


def is_missing(text: str) -> bool:
    """Whether a coordinate says that the point was not set: NaN or an infinity."""
    try:
        return not math.isfinite(float(text))
    except ValueError:
        return False
