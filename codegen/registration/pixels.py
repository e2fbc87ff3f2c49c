"""Pictures whose pixels are not square: registered on grids as volumes are, and looked at in pixels all the same.

Distances in such pixels mean nothing: alignments that turn, the disc, roughness and errors would be those of a picture
that is stretched. Landmarks are registered in coordinates in which a unit is as long in x as in y, the side of a square
with the area of a pixel. Areas are then the same in both, so that det J is, and where pixels are square, or a file says
nothing of them, the coordinates are pixels to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.registration.grid import Extent, Grid, grid_of
from codegen.registration.images.spacing import Spacing
from codegen.registration.maps import Registration
from codegen.registration.pairs import LandmarkPairs, PointArray, as_points

SQUARE = 1e-6
"""Sides of pixels that differ by a smaller share are the same, but for rounding in files."""


def square_grid(extent: Extent, spacing: Spacing | None) -> Grid:
    """The grid of a picture of shape (height, width, ...) in units of the side of a square of a pixel's area."""
    plain = grid_of(extent)
    if spacing is None or abs(spacing.x / spacing.y - 1.0) <= SQUARE:
        return plain
    return Grid(plain.size, plain.origin, (spacing.x / spacing.side, spacing.y / spacing.side), plain.direction)


def in_squares(pairs: LandmarkPairs, grid: Grid, fixed_grid: Grid) -> LandmarkPairs:
    """Landmarks in pixels as `register` takes them together with such grids."""
    if grid.is_plain and fixed_grid.is_plain:
        return pairs
    return LandmarkPairs(grid.to_places(pairs.moving), fixed_grid.to_places(pairs.fixed), pairs.names)


def in_pixels(found: Registration) -> Registration:
    """The same map between pixels, of pictures that were registered on grids; of volumes as it is."""
    if found.dimension != 2 or (found.grid.is_plain and found.fixed_grid.is_plain):
        return found
    return PixelRegistration(**{part.name: getattr(found, part.name) for part in fields(Registration)})


@dataclass(frozen=True, eq=False, repr=False)
class PixelRegistration(Registration):
    """A map whose points are in pixels, while distances, sigma among them, the alignment and the frame are in squares.

    What is said of `Registration` holds, with shapes for grids.
    """

    @property
    def pairs(self) -> LandmarkPairs:
        """The landmarks in pixels."""
        known = self.matching
        moving, fixed = known.grid.to_indices(known.pairs.moving), known.fixed_grid.to_indices(known.pairs.fixed)
        return LandmarkPairs(moving, fixed, known.pairs.names)

    @property
    def grid(self) -> Grid:
        """That of the moving picture, in pixels."""
        return Grid.plain(self.shape)

    @property
    def fixed_grid(self) -> Grid:
        """That of the fixed picture, in pixels."""
        return Grid.plain(self.fixed_shape)

    @property
    def _moving_sides(self) -> NDArray[np.float64]:
        return np.array(self.matching.grid.spacing)

    @property
    def _fixed_sides(self) -> NDArray[np.float64]:
        return np.array(self.matching.fixed_grid.spacing)

    def positions(self, time: float, xy: Any, inverse: bool = False) -> PointArray:
        """As `Registration.positions`; on the way the sides of pixels change from those of one picture to the other."""
        points, moving = as_points(xy), self._moving_sides
        there = moving * (self._fixed_sides / moving) ** time
        before, after = (there, moving) if inverse else (moving, there)
        return np.asarray(super().positions(time, points * before, inverse) / after)

    def jacobian(self, xy: Any, inverse: bool = False) -> NDArray[np.float64]:
        """As `Registration.jacobian`."""
        moving, fixed = self._moving_sides, self._fixed_sides
        before, after = (fixed, moving) if inverse else (moving, fixed)
        return np.asarray(super().jacobian(as_points(xy) * before, inverse) * (before / after[:, None]))

    def arriving(self, xy: Any) -> tuple[PointArray, NDArray[np.float64]]:
        """As `Registration.arriving`."""
        places, factors = super().arriving(as_points(xy) * self._fixed_sides)
        return places / self._moving_sides, factors

    def leaving(self, xy: Any) -> tuple[PointArray, NDArray[np.float64]]:
        """As `Registration.leaving`."""
        places, factors = super().leaving(as_points(xy) * self._moving_sides)
        return places / self._fixed_sides, factors
