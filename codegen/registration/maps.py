"""Registrations: the maps from the moving to the fixed image, their inverses, and the number of steps.

Pictures whose pixels are not square are registered on grids, as volumes are, and their maps are between pixels.
Distances in such pixels are not isotropic: rotations, the disc, roughness and errors would be measured in a stretched
picture. Landmarks are therefore registered in coordinates whose unit is the side of a square with the area of a pixel.
Areas, and so det J, are the same in both coordinates. For square pixels, and for files without a spacing, the
coordinates are exactly pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.alignment import Alignment
from codegen.registration.grid import Extent, Grid, coarse_grid, grid_of, place_text, short
from codegen.registration.images import Spacing
from codegen.registration.matching import Matching
from codegen.registration.pairs import LandmarkPairs, PointArray, as_points
from codegen.registration.solver import Flow

TOLERANCE = 0.01
"""Largest error of the scheme, in pixels, for the automatic number of steps."""
ROUND_TRIP = 1e-8
"""Largest error of a round trip in pixels."""
MISSED = 1e-4
"""Largest residual, in pixels, of landmarks that are met."""
PROBED = {2: 17, 3: 9}
"""Points along each axis of the grid at which maps are compared."""
FIRST_STEPS, MOST_FIRST_STEPS, MOST_STEPS = 4, 32, 256


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """A map from the moving image to the fixed one, and its inverse: the alignment, then the reversed flow.

    The flow itself runs from the fixed image to the moving one; see `Matching`.

    `pairs` are the landmarks, and `grid` and `fixed_grid` the grids of the images, which define the coordinates of all
    points: pixels for pictures. `sides` are the sides of pixels of both images in the coordinates of the matching. They
    are 1 unless the pixels of a picture are not square; then distances, sigma, the alignment and the frame are in sides
    of a square of the area of a pixel.

    `misses` lead from the fixed landmarks to the carried moving ones, in pixels of the fixed image, shape (n, d).
    `error` estimates the distance from the map of infinitely many steps, in pixels; NaN for a given number of steps.
    `round_trip` is the largest error of the round trip of landmarks and of a coarse grid, in pixels. `rung` is the
    successful attempt of the solver, `message` its message, and `solves` the number of solves of the search for a
    strength. The `status` is "solved", or "folded" if the map should meet the landmarks but misses some, because its
    few steps have no inverse there.
    """

    matching: Matching
    flow: Flow
    misses: NDArray[np.float64]
    error: float
    round_trip: float
    status: str
    rung: str
    message: str
    pairs: LandmarkPairs
    grid: Grid
    fixed_grid: Grid
    sides: tuple[NDArray[np.float64], NDArray[np.float64]]
    solves: int = 1

    def __repr__(self) -> str:
        unit = short(self.matching.fixed_grid.unit)
        residuals = f"residuals at most {self.residuals.max(initial=0.0):.2g} {unit}"
        errors = f"{residuals}, round trip {self.round_trip:.2g} {unit}"
        solution = f"{self.status} in {self.steps} steps of {self.matching.scheme}"
        return f"<Registration of {len(self.pairs)} landmarks, moving to fixed: {solution}, {errors}>"

    @cached_property
    def residuals(self) -> NDArray[np.float64]:
        """Distances of the carried moving landmarks from the fixed ones, in pixels of the fixed image, shape (n,)."""
        return np.asarray(np.linalg.norm(self.misses, axis=1))

    @property
    def alignment(self) -> Alignment:
        """The similarity or affine map that comes before the flow."""
        return self.matching.alignment

    @property
    def sigma(self) -> float:
        """The standard deviation of a landmark's error, in pixels."""
        return self.matching.sigma

    @property
    def velocities(self) -> NDArray[np.float64]:
        """Initial velocities of the landmarks in the flow, in units of the disc, shape (n, d)."""
        return self.flow.velocities[self.matching.groups]

    @property
    def steps(self) -> int:
        """The number of steps of the flow."""
        return self.flow.steps

    @property
    def distance(self) -> float:
        """The length of the motion, the square root of its cost, in units of the radius of the disc."""
        pulls = (self.flow.velocities * self.flow.path[0, 1]).sum()
        return float(np.sqrt(max(0.0, pulls) * self.flow.case.duration))

    def map_points(self, xy: ArrayLike) -> PointArray:
        """Map points of the moving image, in pixels, shape (n, d), to the fixed image."""
        return self.positions(1.0, xy)

    def map_points_inverse(self, xy: ArrayLike) -> PointArray:
        """Map points of the fixed image, in pixels, shape (n, d), to the moving image."""
        return self.positions(1.0, xy, inverse=True)

    def positions(self, time: float, xy: ArrayLike, inverse: bool = False) -> PointArray:
        """Return the positions of points of the moving image at a time.

        Parameters
        ----------
        time : float
            From 0, the identity, to 1, the map.
        xy : array, shape (n, d)
            Points in pixels.
        inverse : bool
            Return the points of the moving image that are at the positions `xy` at this time.

        Returns
        -------
        array, shape (n, d)
            Positions in pixels.

        Raises
        ------
        LandmarkError
            For a time outside 0 to 1.
        """
        if not 0.0 <= time <= 1.0:
            raise LandmarkError(f"the time is {time!r}", "give a number from 0 to 1")
        alignment, (moving, fixed) = self.alignment, self.sides
        part = alignment.part(time, self.matching.pairs.moving.mean(axis=0))
        sides = moving * (fixed / moving) ** time  # they change from one image to the other
        if inverse:
            points = as_points(xy, self.pairs.dimension) * sides
            aligned = points if part is alignment else alignment.apply(part.apply_inverse(points))
            return np.asarray(alignment.apply_inverse(self._carried(aligned, 1.0 - time, 1.0)) / moving)
        carried = self._carried(alignment.apply(as_points(xy, self.pairs.dimension) * moving), 1.0, 1.0 - time)
        return np.asarray((carried if part is alignment else part.apply(alignment.apply_inverse(carried))) / sides)

    def jacobian(self, xy: ArrayLike, inverse: bool = False) -> NDArray[np.float64]:
        """Return the derivative of the map or of its inverse at points in pixels, shape (n, d, d), rows x, y, ..."""
        moving, fixed = self.sides
        ratio = fixed / moving[:, None] if inverse else moving / fixed[:, None]
        return np.asarray(self._with_derivative(xy, inverse)[1] * ratio)

    def determinant(self, xy: ArrayLike, inverse: bool = False) -> NDArray[np.float64]:
        """Return the growth of areas by the map, or by its inverse, at points in pixels, shape (n,)."""
        return _determinant(self.jacobian(xy, inverse))

    def arriving(self, xy: ArrayLike) -> tuple[PointArray, NDArray[np.float64]]:
        """Map points of the fixed image, in pixels, to the moving image, and return the growth of areas by the map.

        The growth, shape (n,), is the reciprocal of the growth by the inverse map, which costs less than `determinant`.
        """
        places, jacobians = self._with_derivative(xy, inverse=True)
        with np.errstate(divide="ignore"):
            return places, 1.0 / _determinant(jacobians)

    def leaving(self, xy: ArrayLike) -> tuple[PointArray, NDArray[np.float64]]:
        """Map points of the moving image, in pixels, to the fixed image, and return the growth of areas, shape (n,)."""
        places, jacobians = self._with_derivative(xy, inverse=False)
        return places, _determinant(jacobians)

    def _with_derivative(self, xy: ArrayLike, inverse: bool) -> tuple[PointArray, NDArray[np.float64]]:
        """Map points, and return the derivatives in the coordinates of the matching; areas are the same there."""
        points, (moving, fixed), frame = as_points(xy, self.pairs.dimension), self.sides, self.matching.frame
        if inverse:
            points = points * fixed
            before = frame.to_disc(points)
            after, jacobians = self.flow.carry_with_jacobian(before)
            places = self.alignment.apply_inverse(self._moved(points, before, after)) / moving
            return places, self.alignment.inverse_matrix @ jacobians
        aligned = self.alignment.apply(points * moving)
        before = frame.to_disc(aligned)
        after, jacobians = self.flow.carry_with_jacobian(before, 1.0, 0.0)
        return self._moved(aligned, before, after) / fixed, jacobians @ self.alignment.matrix

    def _carried(self, points: PointArray, start: float, stop: float) -> PointArray:
        """Carry points in pixels of the fixed image by the flow."""
        before = self.matching.frame.to_disc(points)
        return self._moved(points, before, self.flow.carry(before, start, stop))

    def _moved(self, points: PointArray, before: PointArray, after: PointArray) -> PointArray:
        """Move points in pixels as in the disc, so that fixed points remain exactly unchanged."""
        return points + self.matching.frame.radius * (after - before)


def _determinant(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Determinants of 2 by 2 or 3 by 3 matrices, shape (n, d, d)."""
    if matrices.shape[1] == 3:
        first, second, third = (matrices[:, k] for k in range(3))
        return np.asarray((first * np.cross(second, third)).sum(axis=1))
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


def in_steps(
    matching: Matching, steps: int, velocities: NDArray[np.float64] | None = None, quick: bool = False
) -> Registration:
    """Register in a given number of steps; `velocities` and `quick` are arguments of `Matching.solve`."""
    flow, solution, rung = matching.solve(steps, velocities, quick)
    nothing = np.empty((0, matching.pairs.dimension))
    ones = np.ones(matching.pairs.dimension)
    result = Registration(
        matching, flow, nothing, np.nan, np.nan, solution.status, rung, solution.message, matching.pairs,
        matching.grid, matching.fixed_grid, (ones, ones),
    )  # fmt: skip
    probe = _probe(matching)
    carried = result.map_points(probe)
    back = np.linalg.norm(result.map_points_inverse(carried) - probe, axis=1).max()
    result = replace(result, misses=carried[: len(matching.pairs)] - matching.pairs.fixed, round_trip=float(back))
    worst = int(np.argmax(result.residuals))
    residual = result.residuals[worst]
    if matching.sigma > 0.0 or residual <= MISSED * matching.fixed_grid.pixel:
        return result
    # The solver has met the landmarks by the inverse map, but the map itself misses them.
    place = place_text(matching.grid.said(matching.pairs.moving[worst]))
    where = f"landmark {matching.pairs.names[worst]}, at {place}, by {residual:.2g} {matching.fixed_grid.unit}"
    message = f"the map folds in {steps} steps and misses {where}; take more steps"
    return replace(result, status="folded", message=message)


def _probe(matching: Matching) -> PointArray:
    """Points at which maps are compared: moving landmarks, then a coarse grid over the moving image."""
    return np.vstack([matching.pairs.moving, coarse_grid(matching.grid, PROBED[matching.pairs.dimension])])


def solved(
    matching: Matching,
    steps: int | None,
    tolerance: float = TOLERANCE,
    velocities: NDArray[np.float64] | None = None,
    quick: bool = False,
    first: int = FIRST_STEPS,
) -> Registration:
    """Register in a given number of steps, or in as many as an error below `tolerance` pixels takes.

    Without a number of steps it is doubled from `first` until the error is small; the smallest sufficient one is kept.
    """
    if steps is not None:
        return in_steps(matching, steps, velocities, quick)
    if not tolerance > 0.0:
        raise LandmarkError(f"the tolerance is {tolerance!r}", "give a number of pixels")
    coarse, steps, probe = None, first, _probe(matching)
    pixel = matching.fixed_grid.pixel
    least, back = tolerance * pixel, ROUND_TRIP * pixel
    while True:
        try:
            fine = in_steps(matching, steps, velocities if coarse is None else coarse.velocities, quick=True)
        except RegistrationError:
            # A few steps may have no solution, or one that is unrelated to the solution of more steps.
            if 2 * steps > MOST_FIRST_STEPS:
                raise
            coarse, steps = None, 2 * steps
            continue
        if coarse is not None:
            # Richardson's estimate of the errors of both.
            change = float(np.linalg.norm(fine.map_points(probe) - coarse.map_points(probe), axis=1).max())
            gain = 2.0 ** float(fine.flow.module.metadata.order)
            coarse = replace(coarse, error=change * gain / (gain - 1.0))
            fine = replace(fine, error=change / (gain - 1.0))
            for candidate in (coarse, fine):
                if candidate.error <= least and candidate.round_trip <= back:
                    return candidate
        if 2 * steps > MOST_STEPS:
            return fine
        coarse, steps = fine, 2 * steps


SQUARE = 1e-6
"""Relative difference of the sides of a pixel up to which it is square, because of rounding in files."""


def square_grid(extent: Extent, spacing: Spacing | None) -> Grid:
    """Return the grid of a picture of shape (height, width, ...), in sides of a square of the area of a pixel."""
    plain = grid_of(extent)
    if spacing is None or abs(spacing.x / spacing.y - 1.0) <= SQUARE:
        return plain
    return Grid(plain.size, plain.origin, (spacing.x / spacing.side, spacing.y / spacing.side), plain.direction)


def in_squares(pairs: LandmarkPairs, grid: Grid, fixed_grid: Grid) -> LandmarkPairs:
    """Convert landmarks in pixels to the coordinates of such grids."""
    if grid.is_plain and fixed_grid.is_plain:
        return pairs
    return LandmarkPairs(grid.to_places(pairs.moving), fixed_grid.to_places(pairs.fixed), pairs.names)


def in_pixels(registration: Registration) -> Registration:
    """Convert the map of pictures that were registered on grids to pixels; maps of volumes are unchanged."""
    grid, fixed_grid, pairs = registration.grid, registration.fixed_grid, registration.pairs
    if pairs.dimension != 2 or (grid.is_plain and fixed_grid.is_plain):
        return registration
    return replace(
        registration,
        pairs=LandmarkPairs(grid.to_indices(pairs.moving), fixed_grid.to_indices(pairs.fixed), pairs.names),
        grid=grid_of(grid.shape),
        fixed_grid=grid_of(fixed_grid.shape),
        sides=(np.array(grid.spacing), np.array(fixed_grid.spacing)),
    )
