"""Grids of samples: how the columns, rows and slices of an image lie in the coordinates of its landmarks.

Pictures are grids of size (width, height) whose coordinates are pixels. Volumes are grids of size (columns, rows,
slices) whose coordinates are those of their file, LPS in millimetres as a rule, by ITK's rule

    place = origin + direction (spacing * index).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError
from codegen.registration.pairs import PointArray

COSINES = 1e-3
"""How far the axes of a grid may be from orthogonal unit vectors, by rounding in files."""


@dataclass(frozen=True)
class Grid:
    """`size` counts samples along each axis, columns first; `origin` is the place of the first one.

    `spacing` is the distance of neighbours along each axis, and the columns of `direction`, a tuple of rows, are the
    axes' unit vectors. `unit` is what coordinates are counted in. Raises LandmarkError for a grid that has no samples
    or no extent, and for axes that are not orthogonal to each other.
    """

    size: tuple[int, ...]
    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    direction: tuple[tuple[float, ...], ...]
    unit: str = "pixels"

    def __post_init__(self) -> None:
        said = " x ".join(map(str, self.size))
        if min(self.size, default=0) < 1:
            raise LandmarkError(f"the image's size is {said}", "give its extent in pixels along each axis")
        if not (np.isfinite(self.origin).all() and np.isfinite(self.spacing).all() and min(self.spacing) > 0.0):
            finding = f"the image's spacing is {self.spacing} and its origin {self.origin}"
            raise LandmarkError(finding, "give positive spacings and a finite origin")
        axes = np.array(self.direction)
        if not np.abs(axes.T @ axes - np.eye(len(self.size))).max() <= COSINES:
            raise LandmarkError("the image's axes are not orthogonal unit vectors", "resample it on an upright grid")

    @classmethod
    def plain(cls, shape: Sequence[int]) -> Grid:
        """That of a picture of shape (height, width, ...), in pixels."""
        height, width = (int(length) for length in tuple(shape)[:2])
        if height < 1 or width < 1:
            raise LandmarkError(f"the image's shape is {tuple(shape)}", "give its height and width in pixels")
        return cls((width, height), (0.0, 0.0), (1.0, 1.0), ((1.0, 0.0), (0.0, 1.0)))

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return len(self.size)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of its array of samples: (height, width), or (slices, rows, columns)."""
        return self.size[::-1]

    @property
    def count(self) -> int:
        """How many samples it has."""
        return int(np.prod(self.size, dtype=object))

    @property
    def pixel(self) -> float:
        """The finest spacing, in units of which errors are judged."""
        return min(self.spacing)

    @cached_property
    def matrix(self) -> NDArray[np.float64]:
        """The derivative of places by indices, shape (d, d)."""
        return np.asarray(np.array(self.direction) * np.array(self.spacing))

    @cached_property
    def is_plain(self) -> bool:
        """Whether places are indices."""
        return bool((self.matrix == np.eye(self.dimension)).all()) and not any(self.origin)

    def to_places(self, indices: PointArray) -> PointArray:
        """Places for indices (column, row, ...), shape (n, d)."""
        return indices if self.is_plain else indices @ self.matrix.T + self.origin

    def to_indices(self, places: PointArray) -> PointArray:
        """Indices (column, row, ...), which are no whole numbers as a rule, for places, shape (n, d)."""
        return places if self.is_plain else (places - self.origin) @ np.linalg.inv(self.matrix).T

    def said(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """A place, shape (d,), as people are told it: of a picture that is counted in pixels, in pixels."""
        in_pixels = self.dimension == 2 and self.unit == "pixels"
        return self.to_indices(place[None])[0] if in_pixels else place

    def contains(self, places: PointArray, slack: float = 0.0) -> NDArray[np.bool_]:
        """Which places lie in a sample, or at most `slack` samples beyond the outermost, shape (n,)."""
        indices = self.to_indices(places)
        low, high = -0.5 - slack, np.array(self.size) - 0.5 + slack
        return np.asarray(((indices >= low) & (indices <= high)).all(axis=1))

    def corners(self) -> PointArray:
        """The places of the outer corners, half a sample beyond the samples' centres."""
        ends = [(-0.5, length - 0.5) for length in self.size[::-1]]
        return self.to_places(np.array([corner[::-1] for corner in product(*ends)]))

    def coarse(self, count: int) -> PointArray:
        """`count` places along each axis, from edge to edge, columns fastest."""
        lines = [np.linspace(-0.5, length - 0.5, count) for length in self.size]
        return self.to_places(mesh(lines))

    def samples(self, most: int) -> PointArray:
        """The places of at most so many samples along each axis, the first and the last among them."""
        lines = [np.unique(np.linspace(0, length - 1, min(most, length)).round()) for length in self.size]
        return self.to_places(mesh(lines))


Extent: TypeAlias = Sequence[int] | Grid
"""The shape (height, width, ...) of a picture in pixels, or any grid."""


def grid_of(extent: Extent) -> Grid:
    """The grid of an extent; LandmarkError where a shape has no extent."""
    return extent if isinstance(extent, Grid) else Grid.plain(extent)


def mesh(lines: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """All points whose coordinates, the first one changing fastest, are on lines; shape (n, d)."""
    axes = np.meshgrid(*lines[::-1], indexing="ij")[::-1]
    return np.stack([axis.ravel() for axis in axes], axis=1)


def slabs(length: int, thickness: int) -> Iterator[slice]:
    """Slices of so many samples at most, one after the other."""
    for begin in range(0, length, thickness):
        yield slice(begin, min(begin + thickness, length))


def short(unit: str) -> str:
    """A unit as tables have it."""
    return "px" if unit == "pixels" else unit


def place_text(place: NDArray[np.float64], digits: int = 1) -> str:
    """A point in words, rounded."""
    return f"({', '.join(f'{x:.{digits}f}' for x in place)})"
