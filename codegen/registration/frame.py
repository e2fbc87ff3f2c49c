"""The frame: from pixels of the fixed image to the unit disc in which the flow moves points, and back.

For volumes it is the unit ball, and pixels are units of the volumes' coordinates. The disc contains both images whole,
corners and all, with a margin. A disc about the landmarks alone would be smaller, but its rim, beyond which nothing
moves, would then lie within the picture, as a circle at which the deformation is forced to end whatever the landmarks
say; and moving one landmark at the edge would change what the others do. Images whose landmarks are crowded in a corner
pay nothing for the larger disc, because distances between points and from the rim enter the Green's function without
differences of nearly equal numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from codegen.errors import LandmarkError
from codegen.registration.grid import Extent, grid_of
from codegen.registration.pairs import PointArray

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
