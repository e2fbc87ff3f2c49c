"""Common parts of the landmark formats: the interface of a format, the text of a file, limits and checks."""

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
"""Largest size of a file, in bytes; 10 000 landmarks take a tenth of this, or half in point lists of Slicer."""

MOST_LANDMARKS = 10_000  # largest number of landmarks: n landmarks need a dense matrix of 8 n² bytes, here 800 MB
FLAT = 1e-3  # largest difference, due to rounding, between the third coordinates of landmarks in one plane slice


@dataclass(frozen=True)
class Source:
    """The text of a landmark file, and the name of the file in error messages."""

    name: str
    text: str


@dataclass(frozen=True)
class Frames:
    """The shapes (height, width, ...) and file names of the images of the landmarks, as far as known.

    If `grids` has the grids of a moving and a fixed volume, landmarks have three coordinates. Formats convert landmarks
    to the coordinates of these grids: usually LPS (left, posterior, superior) in millimetres.
    """

    moving_shape: tuple[int, ...] | None = None
    fixed_shape: tuple[int, ...] | None = None
    moving_name: str = ""
    fixed_name: str = ""
    grids: tuple[Grid, Grid] | None = None

    @property
    def axes(self) -> str:
        """The names of the coordinates of a landmark, one letter each."""
        return "xy" if self.grids is None else "xyz"


@dataclass(frozen=True)
class Format:
    """A landmark format: its key in FORMATS, its title, and its functions.

    The first of the `suffixes` is the usual one: batches look for it next to an image, and downloads have it. `files`
    is 1, or 2 if a moving and a fixed file are needed. `parse` takes that many texts, and `compose` returns
    them. Both raise PointsError, with file and line. `recognises` returns a true value if a text of this format can
    begin like its argument. `encoding` is the encoding of texts that are not UTF-8.
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
    """Yield the line number and the fields of every non-empty row of a CSV table; PointsError for too many rows."""
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
    """Raise PointsError if the file `name` holds more landmarks than can be registered."""
    if count > MOST_LANDMARKS:
        raise PointsError(f"{name} holds more than {MOST_LANDMARKS} landmarks", "give fewer")


def made(
    sources: Sequence[Source],
    moving: Sequence[Sequence[float]] | NDArray[np.float64],
    fixed: Sequence[Sequence[float]] | NDArray[np.float64],
    names: Sequence[str] = (),
) -> LandmarkPairs:
    """Return landmark pairs from points of shape (n, d) each; PointsError, with the names of the files, if invalid."""
    files = " and ".join(source.name for source in sources)
    if not len(moving) and not len(fixed):
        raise PointsError(f"{files} holds no landmarks", "give at least one pair")
    try:
        return LandmarkPairs(np.array(moving, dtype=float), np.array(fixed, dtype=float), tuple(names))
    except LandmarkError as error:
        raise PointsError(f"{files}: {error.finding}", error.remedy) from error


def placed(name: str, side: str, points: Sequence[Sequence[float]], frames: Frames) -> list[tuple[float, ...]]:
    """Return the points with x and y alone for pictures, or with x, y and z for volumes.

    `name` and `side` name the file and the image in errors. Raises PointsError if points for pictures lie in several
    slices, or if points for volumes have no z.
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
    """Raise PointsError if the names of two files suggest that the fixed file comes before the moving file."""
    moving, fixed = (PurePath(source.name).name.lower() for source in sources)
    if ("fixed" in moving and "moving" not in moving) or ("moving" in fixed and "fixed" not in fixed):
        raise PointsError(
            f"{sources[0].name} is given for the moving image and {sources[1].name} for the fixed one",
            "give the moving file first, or rename the files if their names mislead",
        )


def text_of(number: float) -> str:
    """Return the shortest text from which exactly the same number is read."""
    return repr(float(number))


def is_missing(text: str) -> bool:
    """Return True if the text is NaN or infinity, the coordinate of a point that was not set."""
    try:
        return not math.isfinite(float(text))
    except ValueError:
        return False
