"""Registrations: the maps from the moving to the fixed image, their inverses, and the choice of the number of steps.

Pictures whose pixels are not square are registered on grids, as volumes are, but their maps lead from pixels to pixels.
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
from codegen.registration.grid import Extent, Grid, coarse_grid, grid_of, place_text, short
from codegen.registration.images import Spacing
from codegen.registration.matching import Matching
from codegen.registration.pairs import Alignment, LandmarkPairs, PointArray, as_points
from codegen.registration.solver import Flow

TOLERANCE = 0.01  # largest error of the time discretisation, in pixels, for the automatic number of steps
ROUND_TRIP = 1e-8  # largest error, in pixels, of a point after the map and its inverse
MISSED = 1e-4  # largest residual, in pixels, of landmarks that count as met exactly
PROBED = {2: 17, 3: 9}  # points along each axis of the coarse grid on which maps are compared, by dimension
FIRST_STEPS, MOST_FIRST_STEPS, MOST_STEPS = 4, 32, 256


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """The map from the moving to the fixed image (the alignment, then the reversed flow) and its inverse.

    The flow itself runs from the fixed image to the moving image; see `Matching`.

    `pairs` are the landmarks, and `grid` and `fixed_grid` the grids of the images, which define the coordinates of all
    points: pixels for pictures. `sides` are the sides of a pixel of the moving and of the fixed image, shape (d,), in
    the coordinates of the matching. Sides are 1 if pixels are square. Otherwise the unit of distances, sigma, alignment
    and frame is the side of a square with the area of a pixel.

    `misses` are the vectors from fixed to mapped moving landmarks, in pixels of the fixed image, shape (n, d). `error`
    estimates the distance from the map of infinitely many steps, in pixels; NaN for a given number of steps.
    `round_trip` is the largest error, in pixels, of landmarks and of a coarse grid after the map and its inverse.
    `rung` names the successful attempt of the solver, `message` is its message. `solves` counts the solves of the
    search for a strength. `status` is "solved", or "folded" if the map misses landmarks that it should meet exactly,
    because a step has no inverse there.
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
        """Distances between mapped moving landmarks and fixed landmarks, in pixels of the fixed image, shape (n,)."""
        return np.asarray(np.linalg.norm(self.misses, axis=1))

    @property
    def alignment(self) -> Alignment:
        """The similarity or affine map that comes before the flow."""
        return self.matching.alignment

    @property
    def sigma(self) -> float:
        """The standard deviation of the error of a landmark's coordinate, in pixels."""
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
        """Return the positions of points of the moving image at a time of their motion to the fixed image.

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
        sides = moving * (fixed / moving) ** time  # from the moving to the fixed image
        if inverse:
            points = as_points(xy, self.pairs.dimension) * sides
            aligned = points if part is alignment else alignment.apply(part.apply_inverse(points))
            return np.asarray(alignment.apply_inverse(self._carried(aligned, 1.0 - time, 1.0)) / moving)
        carried = self._carried(alignment.apply(as_points(xy, self.pairs.dimension) * moving), 1.0, 1.0 - time)
        return np.asarray((carried if part is alignment else part.apply(alignment.apply_inverse(carried))) / sides)

    def jacobian(self, xy: ArrayLike, inverse: bool = False) -> NDArray[np.float64]:
        """Return the Jacobian of the map or of its inverse at points in pixels, shape (n, d, d), rows x, y, ..."""
        moving, fixed = self.sides
        ratio = fixed / moving[:, None] if inverse else moving / fixed[:, None]
        return np.asarray(self._with_derivative(xy, inverse)[1] * ratio)

    def determinant(self, xy: ArrayLike, inverse: bool = False) -> NDArray[np.float64]:
        """Return det J of the map, or of its inverse, at points in pixels, shape (n,): the enlargement of areas."""
        return _determinant(self.jacobian(xy, inverse))

    def arriving(self, xy: ArrayLike) -> tuple[PointArray, NDArray[np.float64]]:
        """Return the points of the moving image that the map carries to the points `xy`, in pixels, and its det J.

        det J, shape (n,), is computed from the derivative of the inverse map, at less cost than by `determinant`.
        """
        places, jacobians = self._with_derivative(xy, inverse=True)
        with np.errstate(divide="ignore"):
            return places, 1.0 / _determinant(jacobians)

    def leaving(self, xy: ArrayLike) -> tuple[PointArray, NDArray[np.float64]]:
        """Return the points of the fixed image to which the map carries the points `xy`, in pixels, and det J (n,)."""
        places, jacobians = self._with_derivative(xy, inverse=False)
        return places, _determinant(jacobians)

    def _with_derivative(self, xy: ArrayLike, inverse: bool) -> tuple[PointArray, NDArray[np.float64]]:
        """Return mapped points in pixels, and Jacobians in the coordinates of the matching, where det J is the same."""
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
        """Carry points, in pixels of the fixed image, by the flow from time `start` to time `stop`."""
        before = self.matching.frame.to_disc(points)
        return self._moved(points, before, self.flow.carry(before, start, stop))

    def _moved(self, points: PointArray, before: PointArray, after: PointArray) -> PointArray:
        """Add the motion from `before` to `after` in the disc to points in pixels; zero motions change no digit."""
        return points + self.matching.frame.radius * (after - before)


def _determinant(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the determinants of 2 by 2 or 3 by 3 matrices, shape (n, d, d)."""
    if matrices.shape[1] == 3:
        first, second, third = (matrices[:, k] for k in range(3))
        return np.asarray((first * np.cross(second, third)).sum(axis=1))
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


def in_steps(
    matching: Matching, steps: int, velocities: NDArray[np.float64] | None = None, quick: bool = False
) -> Registration:
    """Return the registration in a given number of steps; `velocities` and `quick` are as in `Matching.solve`."""
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
    # The solver met the landmarks by the inverse map, but the map itself misses them.
    place = place_text(matching.grid.said(matching.pairs.moving[worst]))
    where = f"landmark {matching.pairs.names[worst]}, at {place}, by {residual:.2g} {matching.fixed_grid.unit}"
    message = f"the map folds in {steps} steps and misses {where}; take more steps"
    return replace(result, status="folded", message=message)


def _probe(matching: Matching) -> PointArray:
    """Return the points at which maps are compared: moving landmarks, then a coarse grid over the moving image."""
    return np.vstack([matching.pairs.moving, coarse_grid(matching.grid, PROBED[matching.pairs.dimension])])


def solved(
    matching: Matching,
    steps: int | None,
    tolerance: float = TOLERANCE,
    velocities: NDArray[np.float64] | None = None,
    quick: bool = False,
    first: int = FIRST_STEPS,
) -> Registration:
    """Return the registration in `steps` steps, or in enough steps for an error of the map below `tolerance` pixels.

    If `steps` is None, the first sufficient number of `first`, 2 `first`, 4 `first`, ... is taken.
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
            # Richardson's estimates of the errors of both maps.
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


SQUARE = 1e-6  # largest relative difference between the sides of a square pixel, because files round the sides


def square_grid(extent: Extent, spacing: Spacing | None) -> Grid:
    """Return the grid of a picture; the unit of its coordinates is the side of a square with the area of a pixel."""
    plain = grid_of(extent)
    if spacing is None or abs(spacing.x / spacing.y - 1.0) <= SQUARE:
        return plain
    return Grid(plain.size, plain.origin, (spacing.x / spacing.side, spacing.y / spacing.side), plain.direction)


def in_squares(pairs: LandmarkPairs, grid: Grid, fixed_grid: Grid) -> LandmarkPairs:
    """Convert landmarks in pixels to the coordinates of grids from `square_grid`."""
    if grid.is_plain and fixed_grid.is_plain:
        return pairs
    return LandmarkPairs(grid.to_places(pairs.moving), fixed_grid.to_places(pairs.fixed), pairs.names)


def in_pixels(registration: Registration) -> Registration:
    """Convert a registration of pictures on grids of `square_grid` to pixels; volumes are returned unchanged."""
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
