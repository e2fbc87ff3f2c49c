"""Common parts of landmark formats: their description, texts of files, limits, and points in a plane."""

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
"""Most bytes of a file; 10 000 landmarks take a tenth of it, or half of it as point lists of Slicer."""

MOST_LANDMARKS = 10_000
"""Most landmarks: the interactions of n landmarks are a matrix of 8 n² bytes, 800 MB here."""

FLAT = 1e-3
"""Largest difference of the third coordinates of landmarks of one slice, by rounding."""


@dataclass(frozen=True)
class Source:
    """The text of a file and its name in errors."""

    name: str
    text: str


@dataclass(frozen=True)
class Frames:
    """The images of the landmarks, as far as known: shapes (height, width, ...) and file names.

    With the `grids` of a moving and a fixed volume, landmarks have three coordinates. They are converted to the
    coordinates of the grids: usually LPS in millimetres.
    """

    moving_shape: tuple[int, ...] | None = None
    fixed_shape: tuple[int, ...] | None = None
    moving_name: str = ""
    fixed_name: str = ""
    grids: tuple[Grid, Grid] | None = None

    @property
    def axes(self) -> str:
        """The names of the coordinates of landmarks."""
        return "xy" if self.grids is None else "xyz"


@dataclass(frozen=True)
class Format:
    """A landmark format.

    `parse` takes one text, or the moving and the fixed one if `files` is 2; `compose` returns as many. Both raise
    PointsError, naming the file and the line. `recognises` distinguishes formats with the same suffix by the beginning
    of a text: the result is true. `encoding` is the encoding of texts that are not UTF-8.
    """

    name: str
    title: str
    suffixes: tuple[str, ...]
    files: int
    recognises: Callable[[str], object]
    parse: Callable[[Sequence[Source], Frames], LandmarkPairs]
    compose: Callable[[LandmarkPairs, Frames], tuple[str, ...]]
    encoding: str | None = None


def rows(source: Source) -> Iterator[tuple[int, list[str]]]:
    """Yield the non-empty rows of a comma-separated table with their line numbers; PointsError for too many."""
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
    """Raise PointsError for more landmarks than can be registered."""
    if count > MOST_LANDMARKS:
        raise PointsError(f"{name} holds more than {MOST_LANDMARKS} landmarks", "give fewer")


def made(
    sources: Sequence[Source],
    moving: Sequence[Sequence[float]] | NDArray[np.float64],
    fixed: Sequence[Sequence[float]] | NDArray[np.float64],
    names: Sequence[str] = (),
) -> LandmarkPairs:
    """Make pairs of landmarks; PointsError, naming the files, if that is impossible."""
    files = " and ".join(source.name for source in sources)
    if not len(moving) and not len(fixed):
        raise PointsError(f"{files} holds no landmarks", "give at least one pair")
    try:
        return LandmarkPairs(np.array(moving, dtype=float), np.array(fixed, dtype=float), tuple(names))
    except LandmarkError as error:
        raise PointsError(f"{files}: {error.finding}", error.remedy) from error


def placed(name: str, side: str, points: Sequence[Sequence[float]], frames: Frames) -> list[tuple[float, ...]]:
    """Return the coordinates that the images need: x and y, or x, y and z.

    Raises PointsError for points of several slices of pictures, and for points without z of volumes.
    """
    if frames.grids is None:
        heights = [point[2] for point in points if len(point) > 2]
        if heights and max(heights) - min(heights) > FLAT:
            finding = f"{name}: {side} landmarks have z from {min(heights):g} to {max(heights):g}"
            raise PointsError(finding, "give landmarks of one slice; images in the plane are registered")
        return [(point[0], point[1]) for point in points]
    if any(len(point) != 3 for point in points):
        finding = f"{name}: {side} landmarks have x and y alone, and the images are volumes"
        raise PointsError(finding, "give three coordinates of every landmark")
    return [tuple(point) for point in points]


def require_order(sources: Sequence[Source]) -> None:
    """Raise PointsError for a pair of files whose names indicate the reverse order."""
    moving, fixed = (PurePath(source.name).name.lower() for source in sources)
    if ("fixed" in moving and "moving" not in moving) or ("moving" in fixed and "fixed" not in fixed):
        raise PointsError(
            f"{sources[0].name} is given for the moving image and {sources[1].name} for the fixed one",
            "give the moving file first, or rename the files if their names mislead",
        )


def text_of(number: float) -> str:
    """Return the shortest text of a number that is read as the same number."""
    return repr(float(number))


def is_missing(text: str) -> bool:
    """Return True for the coordinate of a point that was not set: NaN or infinity."""
    try:
        return not math.isfinite(float(text))
    except ValueError:
        return False
