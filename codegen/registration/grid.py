"""The coordinates of images and of the flow: grids of samples, and the frame that maps pixels to the unit disc.

Pictures are grids of size (width, height) whose coordinates are pixels. Volumes are grids of size (columns, rows,
slices) in the coordinates of their files, usually LPS in millimetres. As in ITK

    position = origin + direction (spacing * index).

The frame maps pixels of the fixed image to the unit disc in which the flow moves points. For volumes the frame maps
units of the coordinates to the unit ball. The disc contains both images with a margin. A disc around the landmarks
alone would be smaller, but its rim, beyond which nothing moves, would lie within the picture and end the deformation.
Moving a landmark at the edge would then change the effect of the others. Landmarks that are crowded in a corner lose no
accuracy in the larger disc. The reason is that the Green's function uses distances between points and from the rim
without differences of nearly equal numbers.
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

COSINES = 1e-3  # tolerance of the orthogonality of axes, because of rounding in files


@dataclass(frozen=True)
class Grid:
    """A grid of samples (pixels or voxels) in the coordinates of landmarks.

    `size` has the number of samples along each axis, columns first, and `origin` is the position of the first sample.
    `spacing` has the distance between neighbours along each axis. The columns of `direction`, a tuple of rows, are the
    unit vectors of the axes. `unit` is the unit of coordinates. Raises LandmarkError for a grid without samples or
    extent, and for axes that are not orthogonal.
    """

    size: tuple[int, ...]
    origin: tuple[float, ...]
    spacing: tuple[float, ...]
    direction: tuple[tuple[float, ...], ...]
    unit: str = "pixels"

    def __post_init__(self) -> None:
        if min(self.size, default=0) < 1:
            size = " x ".join(map(str, self.size))
            raise LandmarkError(f"the image's size is {size}", "give its extent in pixels along each axis")
        if not (np.isfinite(self.origin).all() and np.isfinite(self.spacing).all() and min(self.spacing) > 0.0):
            finding = f"the image's spacing is {self.spacing} and its origin {self.origin}"
            raise LandmarkError(finding, "give positive spacings and a finite origin")
        axes = np.array(self.direction)
        if not np.abs(axes.T @ axes - np.eye(len(self.size))).max() <= COSINES:
            raise LandmarkError("the image's axes are not orthogonal unit vectors", "resample it on an upright grid")

    @property
    def dimension(self) -> int:
        """The number of axes, 2 or 3."""
        return len(self.size)

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape of the array of samples: (height, width), or (slices, rows, columns)."""
        return self.size[::-1]

    @property
    def count(self) -> int:
        """The number of samples."""
        return int(np.prod(self.size, dtype=object))

    @property
    def pixel(self) -> float:
        """The smallest spacing, which is the unit of tolerances."""
        return min(self.spacing)

    @cached_property
    def matrix(self) -> NDArray[np.float64]:
        """The derivative of positions with respect to indices, shape (d, d)."""
        return np.asarray(np.array(self.direction) * np.array(self.spacing))

    @cached_property
    def is_plain(self) -> bool:
        """True if positions equal indices."""
        return bool((self.matrix == np.eye(self.dimension)).all()) and not any(self.origin)

    def to_places(self, indices: PointArray) -> PointArray:
        """Convert indices (column, row, ...), shape (n, d), to positions."""
        return indices if self.is_plain else indices @ self.matrix.T + self.origin

    def to_indices(self, places: PointArray) -> PointArray:
        """Convert positions, shape (n, d), to indices (column, row, ...), which need not be integers."""
        return places if self.is_plain else (places - self.origin) @ np.linalg.inv(self.matrix).T

    def said(self, place: NDArray[np.float64]) -> NDArray[np.float64]:
        """Convert a position, shape (d,), to the coordinates that messages show: pixels for pictures."""
        in_pixels = self.dimension == 2 and self.unit == "pixels"
        return self.to_indices(place[None])[0] if in_pixels else place

    def contains(self, places: PointArray, slack: float = 0.0) -> NDArray[np.bool_]:
        """Return True for each position, shape (n,), within the grid or at most `slack` samples beyond its edge."""
        indices = self.to_indices(places)
        low, high = -0.5 - slack, np.array(self.size) - 0.5 + slack
        return np.asarray(((indices >= low) & (indices <= high)).all(axis=1))

    def samples(self, most: int) -> PointArray:
        """Return the positions, shape (n, d), of up to `most` samples per axis, spread from the first to the last."""
        lines = [np.unique(np.linspace(0, length - 1, min(most, length)).round()) for length in self.size]
        return self.to_places(mesh(lines))

    def portions(self, most: int) -> Iterator[tuple[slice, PointArray]]:
        """Yield slices of at most `most` successive samples, columns fastest, and the positions of these samples."""
        for begin in range(0, self.count, most):
            part = slice(begin, min(begin + most, self.count))
            indices = np.unravel_index(np.arange(part.start, part.stop), self.shape)
            yield part, self.to_places(np.stack(indices[::-1], axis=1).astype(float))


Extent: TypeAlias = Sequence[int] | Grid  # the shape (height, width, ...) of a picture in pixels, or any grid


def grid_of(extent: Extent) -> Grid:
    """Return a grid unchanged, or the grid in pixels of a shape; LandmarkError for a shape without pixels."""
    if isinstance(extent, Grid):
        return extent
    height, width = (int(length) for length in tuple(extent)[:2])
    if height < 1 or width < 1:
        raise LandmarkError(f"the image's shape is {tuple(extent)}", "give its height and width in pixels")
    return Grid((width, height), (0.0, 0.0), (1.0, 1.0), ((1.0, 0.0), (0.0, 1.0)))


def mesh(lines: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return all points whose k-th coordinate is in `lines[k]`, shape (n, d); the first changes fastest."""
    axes = np.meshgrid(*lines[::-1], indexing="ij")[::-1]
    return np.stack([axis.ravel() for axis in axes], axis=1)


def short(unit: str) -> str:
    """Return the abbreviation of a unit."""
    return "px" if unit == "pixels" else unit


def place_text(place: NDArray[np.float64]) -> str:
    """Format a point with one decimal."""
    return f"({', '.join(f'{x:.1f}' for x in place)})"


MARGINS = {2: 0.25, 3: 1.0}
"""The margin of the disc, relative to the largest distance of a corner or landmark from its centre, by dimension.

In space the Green's function decays more slowly. Between 40 or 150 landmarks of smooth maps a margin of 0.25 made
errors 10 to 25 % larger than a margin of 1, whose errors were about as large as errors of thin-plate splines.
"""


@dataclass(frozen=True)
class Frame:
    """The centre and radius of the disc, or of the ball, in pixels of the fixed image."""

    centre: tuple[float, ...]
    radius: float

    @property
    def scale(self) -> float:
        """The length of a pixel in the unit disc."""
        return 1.0 / self.radius

    def to_disc(self, points: PointArray) -> PointArray:
        """Convert points in pixels, shape (n, d), to points of the disc."""
        return (points - self.centre) / self.radius

    def to_pixels(self, points: PointArray) -> PointArray:
        """Convert points of the disc, shape (n, d), to pixels."""
        return points * self.radius + self.centre

    @classmethod
    def around(cls, points: PointArray, margin: float = MARGINS[2]) -> Frame:
        """Return the frame in which points, shape (n, d), are within the radius 1/(1 + margin).

        Its centre is the centre of their bounding box. Raises LandmarkError if the margin is not positive, or if all
        points coincide.
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
    """Return the corners of an image, shape (2^d, d), half a pixel beyond the centres of the outermost pixels."""
    grid = grid_of(extent)
    ends = [(-0.5, length - 0.5) for length in grid.size[::-1]]
    return grid.to_places(np.array([corner[::-1] for corner in product(*ends)]))


def pixel_grid(shape: Sequence[int]) -> PointArray:
    """Return the points (x, y) of all pixels of an image of shape (height, width, ...), row by row, shape (n, 2)."""
    height, width = shape[:2]
    return mesh([np.arange(float(width)), np.arange(float(height))])


def coarse_grid(extent: Extent, count: int = 17) -> PointArray:
    """Return equally spaced points, shape (n, d), from edge to edge of an image, `count` per axis, columns fastest."""
    grid = grid_of(extent)
    return grid.to_places(mesh([np.linspace(-0.5, length - 0.5, count) for length in grid.size]))
