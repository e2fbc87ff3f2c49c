"""Grids of samples: how the columns, rows and slices of an image lie in the coordinates of its landmarks.

Pictures are grids of size (width, height) whose coordinates are pixels. Volumes are grids of size (columns, rows,
slices) whose coordinates are those of their file, LPS in millimetres as a rule, by ITK's rule

    place = origin + direction (spacing * index).

The frame: from pixels of the fixed image to the unit disc in which the flow moves points, and back. For volumes it is
the unit ball, and pixels are units of the volumes' coordinates. The disc contains both images whole, corners and all,
with a margin. A disc about the landmarks alone would be smaller, but its rim, beyond which nothing moves, would then
lie within the picture, as a circle at which the deformation is forced to end whatever the landmarks say; and moving one
landmark at the edge would change what the others do. Images whose landmarks are crowded in a corner pay nothing for the
larger disc, because distances between points and from the rim enter the Green's function without differences of nearly
equal numbers.
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


MARGINS = {2: 0.25, 3: 1.0}
"""How much the radius exceeds the farthest corner's distance, as a fraction, by dimension.

In space, where the Green's function falls off more slowly, errors between 40 or 150 landmarks of smooth maps were a
tenth to a quarter larger with 0.25, and with 1 about those of thin plates.
"""


@dataclass(frozen=True)
class Frame:
    """The centre of the disc, or of the ball, and its radius, in pixels of the fixed image."""

    centre: tuple[float, ...]
    radius: float

    @property
    def scale(self) -> float:
        """Units of the disc to a pixel."""
        return 1.0 / self.radius

    def to_disc(self, points: PointArray) -> PointArray:
        """Points of the disc for points in pixels, shape (n, d)."""
        return (points - self.centre) / self.radius

    def to_pixels(self, points: PointArray) -> PointArray:
        """Points in pixels for points of the disc, shape (n, d)."""
        return points * self.radius + self.centre

    @classmethod
    def around(cls, points: PointArray, margin: float = MARGINS[2]) -> Frame:
        """The frame whose disc contains points, shape (n, d), and in which they are at most at 1/(1 + margin).

        Its centre is that of the points' bounding box. LandmarkError when the margin is not positive, or when all the
        points are one.
        """
        if not 0.0 < margin < np.inf:
            raise LandmarkError(f"the margin is {margin!r}", "give a positive number")
        low, high = points.min(axis=0), points.max(axis=0)
        centre = low + 0.5 * (high - low)
        radius = float(np.linalg.norm(points - centre, axis=1).max()) * (1.0 + margin)
        if not 0.0 < radius < np.inf:
            raise LandmarkError("image and landmarks have no extent", "give the image's height and width in pixels")
        return cls(tuple(map(float, centre)), radius)


def corners(extent: Extent) -> PointArray:
    """The outer corners of an image of shape (height, width, ...) or of a grid, half a pixel beyond pixels' centres."""
    return grid_of(extent).corners()


def pixel_grid(shape: Sequence[int]) -> PointArray:
    """The centres of all pixels of an image of shape (height, width, ...), row by row, shape (height * width, 2)."""
    height, width = shape[:2]
    grid = np.empty((height, width, 2))
    grid[..., 0] = np.arange(width)
    grid[..., 1] = np.arange(height)[:, None]
    return grid.reshape(-1, 2)


def coarse_grid(extent: Extent, count: int = 17) -> PointArray:
    """`count` points along each axis of an image of shape (height, width, ...) or of a grid, from edge to edge."""
    return grid_of(extent).coarse(count)
