"""Maps that carry landmarks where they belong, their inverses, and how many steps they take.

Pictures whose pixels are not square: registered on grids as volumes are, and looked at in pixels all the same.

Distances in such pixels mean nothing: alignments that turn, the disc, roughness and errors would be those of a picture
that is stretched. Landmarks are registered in coordinates in which a unit is as long in x as in y, the side of a square
with the area of a pixel. Areas are then the same in both, so that det J is, and where pixels are square, or a file says
nothing of them, the coordinates are pixels to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.alignment import Alignment
from codegen.registration.grid import Extent, Frame, Grid, coarse_grid, grid_of, place_text, short
from codegen.registration.images import Spacing
from codegen.registration.matching import Matching
from codegen.registration.pairs import LandmarkPairs, PointArray, as_points
from codegen.registration.solver import Flow

TOLERANCE = 0.01
"""Largest error of the map, in pixels, that the automatic choice of steps leaves to the scheme."""
ROUND_TRIP = 1e-8
"""Largest distance in pixels at which a point may come back from the way forwards and backwards."""
MISSED = 1e-4
"""Distance in pixels by which landmarks are missed that should be met."""
PROBED = {2: 17, 3: 9}
"""Points along each axis of the grid at which maps are compared."""
FIRST_STEPS, MOST_FIRST_STEPS, MOST_STEPS = 4, 32, 256


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """A map from the moving image to the fixed one, and its inverse: alignment, then the flow backwards.

    The flow itself runs from the fixed image to the moving one; see `Matching`.

    `misses` lead from the fixed landmarks to where the moving ones arrive, in pixels of the fixed image, shape (n, d),
    and `residuals`, shape (n,), are their lengths. `error` estimates how far the map is from that of infinitely many
    steps, in pixels, NaN where steps were given. `round_trip` is the farthest from where it was, in pixels, that a
    landmark or a point of a coarse grid comes back. `rung` says which of the solver's attempts succeeded, and `message`
    how; `solves` counts those of a search for the strength of roughness. The `status` is "solved", or "folded" where a
    map that should meet the landmarks misses some, because its few steps have no inverse there.
    """

    matching: Matching
    flow: Flow
    misses: NDArray[np.float64]
    error: float
    round_trip: float
    status: str
    rung: str
    message: str
    solves: int = 1

    def __repr__(self) -> str:
        found = f"{self.status} in {self.steps} steps of {self.scheme}"
        unit = short(self.matching.unit)
        errors = (
            f"residuals at most {self.residuals.max(initial=0.0):.2g} {unit}, round trip {self.round_trip:.2g} {unit}"
        )
        return f"<Registration of {len(self.pairs)} landmarks, moving to fixed: {found}, {errors}>"

    @cached_property
    def residuals(self) -> NDArray[np.float64]:
        """How far from the fixed landmarks the moving ones arrive, in pixels of the fixed image, shape (n,)."""
        return np.asarray(np.linalg.norm(self.misses, axis=1))

    @property
    def pairs(self) -> LandmarkPairs:
        """The landmarks."""
        return self.matching.pairs

    @property
    def shape(self) -> tuple[int, ...]:
        """Height and width of the moving image, or slices, rows and columns."""
        return self.matching.shape

    @property
    def fixed_shape(self) -> tuple[int, ...]:
        """Those of the fixed image."""
        return self.matching.fixed_shape

    @property
    def grid(self) -> Grid:
        """The grid of the moving image, in whose coordinates landmarks are: pixels for a picture."""
        return self.matching.grid

    @property
    def fixed_grid(self) -> Grid:
        """The grid of the fixed image."""
        return self.matching.fixed_grid

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return self.pairs.dimension

    @property
    def alignment(self) -> Alignment:
        """The similarity or affine map that comes before the flow."""
        return self.matching.alignment

    @property
    def frame(self) -> Frame:
        """The disc in which the flow moves points."""
        return self.matching.frame

    @property
    def sigma(self) -> float:
        """The standard deviation of a landmark's error, in pixels."""
        return self.matching.sigma

    @property
    def velocities(self) -> NDArray[np.float64]:
        """What the landmarks' velocities are at the start of the flow, in units of the disc, shape (n, d)."""
        return self.flow.velocities[self.matching.groups]

    @property
    def scheme(self) -> str:
        """The name of the scheme that makes the flow's steps."""
        return self.matching.scheme

    @property
    def steps(self) -> int:
        """The number of the flow's steps."""
        return self.flow.steps

    @property
    def distance(self) -> float:
        """The length of the motion: the square root of its cost, in units in which the disc's radius is 1."""
        pulls = (self.flow.velocities * self.flow.path[0, 1]).sum()
        return float(np.sqrt(max(0.0, pulls) * self.flow.case.duration))

    def map_points(self, xy: Any) -> PointArray:
        """Moving to fixed, points in pixels of shape (n, d)."""
        return self.positions(1.0, xy)

    def map_points_inverse(self, xy: Any) -> PointArray:
        """Fixed to moving, points in pixels of shape (n, d)."""
        return self.positions(1.0, xy, inverse=True)

    def positions(self, time: float, xy: Any, inverse: bool = False) -> PointArray:
        """Where points of the moving image are at a time from 0, where they were, to 1, where `map_points` has them.

        With `inverse`, where points are from that are at given places at that time. Shape (n, d), pixels.
        """
        if not 0.0 <= time <= 1.0:
            raise LandmarkError(f"the time is {time!r}", "give a number from 0 to 1")
        points, part = as_points(xy, self.dimension), self.alignment.part(time, self.matching.pairs.moving.mean(axis=0))
        if inverse:
            aligned = points if part is self.alignment else self.alignment.apply(part.apply_inverse(points))
            return self.alignment.apply_inverse(self._carried(aligned, 1.0 - time, 1.0))
        carried = self._carried(self.alignment.apply(points), 1.0, 1.0 - time)
        return carried if part is self.alignment else part.apply(self.alignment.apply_inverse(carried))

    def jacobian(self, xy: Any, inverse: bool = False) -> NDArray[np.float64]:
        """The derivative of the map, or of its inverse, at points in pixels: shape (n, d, d), rows are x, y, ...."""
        points = as_points(xy, self.dimension)
        if inverse:
            jacobians = self.flow.carry_with_jacobian(self.frame.to_disc(points))[1]
            return np.asarray(self.alignment.inverse_matrix @ jacobians)
        aligned = self.frame.to_disc(self.alignment.apply(points))
        return np.asarray(self.flow.carry_with_jacobian(aligned, 1.0, 0.0)[1] @ self.alignment.matrix)

    def determinant(self, xy: Any, inverse: bool = False) -> NDArray[np.float64]:
        """The factor by which the map, or its inverse, enlarges areas at points in pixels, shape (n,)."""
        return _determinant(self.jacobian(xy, inverse))

    def arriving(self, xy: Any) -> tuple[PointArray, NDArray[np.float64]]:
        """Where what arrives at points of the fixed image, in pixels, is from, and by which factor areas have grown.

        The factor, shape (n,), is that of the inverse map turned over, which costs less than `determinant` where points
        come from.
        """
        points = as_points(xy, self.dimension)
        before = self.frame.to_disc(points)
        after, jacobians = self.flow.carry_with_jacobian(before)
        jacobians = self.alignment.inverse_matrix @ jacobians
        with np.errstate(divide="ignore"):
            factors = 1.0 / _determinant(jacobians)
        return self.alignment.apply_inverse(self._moved(points, before, after)), factors

    def leaving(self, xy: Any) -> tuple[PointArray, NDArray[np.float64]]:
        """Where points of the moving image, in pixels, are carried, and by which factor areas grow, shape (n,)."""
        points = as_points(xy, self.dimension)
        aligned = self.alignment.apply(points)
        before = self.frame.to_disc(aligned)
        after, jacobians = self.flow.carry_with_jacobian(before, 1.0, 0.0)
        return self._moved(aligned, before, after), _determinant(jacobians @ self.alignment.matrix)

    def arriving_determinant(self, xy: Any) -> NDArray[np.float64]:
        """The factors of `arriving`, shape (n,)."""
        return self.arriving(xy)[1]

    def _carried(self, points: PointArray, start: float, stop: float) -> PointArray:
        """Points in pixels of the fixed image carried by the flow."""
        before = self.frame.to_disc(points)
        return self._moved(points, before, self.flow.carry(before, start, stop))

    def _moved(self, points: PointArray, before: PointArray, after: PointArray) -> PointArray:
        """Points in pixels moved as they were in the disc: what does not move keeps its every bit."""
        return points + self.frame.radius * (after - before)


def _determinant(matrices: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of 2 by 2 or 3 by 3 matrices, shape (n, d, d)."""
    if matrices.shape[1] == 3:
        first, second, third = (matrices[:, k] for k in range(3))
        return np.asarray((first * np.cross(second, third)).sum(axis=1))
    return np.asarray(matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] * matrices[:, 1, 0])


def solved(
    matching: Matching,
    steps: int | None,
    tolerance: float = TOLERANCE,
    velocities: NDArray[np.float64] | None = None,
    quick: bool = False,
) -> Registration:
    """The registration in a given number of steps, or in as many as leave an error below `tolerance` pixels."""
    return refined(matching, tolerance, velocities) if steps is None else in_steps(matching, steps, velocities, quick)


def in_steps(
    matching: Matching, steps: int, velocities: NDArray[np.float64] | None = None, quick: bool = False
) -> Registration:
    """The registration in a given number of steps; `velocities` and `quick` are those of `Matching.solve`."""
    flow, solution, rung = matching.solve(steps, velocities, quick)
    nothing = np.empty((0, matching.pairs.dimension))
    found = Registration(matching, flow, nothing, np.nan, np.nan, solution.status, rung, solution.message)
    probe = _probe(matching)
    there = found.map_points(probe)
    back = np.linalg.norm(found.map_points_inverse(there) - probe, axis=1).max()
    found = replace(found, misses=there[: len(matching.pairs)] - matching.pairs.fixed, round_trip=float(back))
    missed = _missed(matching, steps, found.residuals)
    return replace(found, status="folded", message=missed) if missed else found


def _missed(matching: Matching, steps: int, residuals: NDArray[np.float64]) -> str:
    """What is said of a map whose inverse meets the landmarks, as the solver found, but which itself misses them."""
    worst = int(np.argmax(residuals))
    if matching.sigma > 0.0 or residuals[worst] <= MISSED * matching.pixel:
        return ""
    place = place_text(matching.grid.said(matching.pairs.moving[worst]))
    where = f"landmark {matching.pairs.names[worst]}, at {place}, by {residuals[worst]:.2g} {matching.unit}"
    return f"the map folds in {steps} steps and misses {where}; take more steps"


def _probe(matching: Matching) -> PointArray:
    """The points at which maps are compared: moving landmarks, then a coarse grid over the moving image."""
    return np.vstack([matching.pairs.moving, coarse_grid(matching.grid, PROBED[matching.pairs.dimension])])


def refined(
    matching: Matching, tolerance: float, velocities: NDArray[np.float64] | None, first: int = FIRST_STEPS
) -> Registration:
    """Double the steps until the map no longer changes, and keep the smallest number whose error is small enough."""
    if not tolerance > 0.0:
        raise LandmarkError(f"the tolerance is {tolerance!r}", "give a number of pixels")
    coarse, steps, probe = None, first, _probe(matching)
    least, back = tolerance * matching.pixel, ROUND_TRIP * matching.pixel
    while True:
        try:
            fine = in_steps(matching, steps, velocities if coarse is None else coarse.velocities, quick=True)
        except RegistrationError:
            # A few steps may have no solution, or one that has nothing to do with that of more steps.
            if 2 * steps > MOST_FIRST_STEPS:
                raise
            coarse, steps = None, 2 * steps
            continue
        if coarse is not None:
            coarse, fine = _with_errors(coarse, fine, probe)
            for found in (coarse, fine):
                if found.error <= least and found.round_trip <= back:
                    return found
        if 2 * steps > MOST_STEPS:
            return fine
        coarse, steps = fine, 2 * steps


def _with_errors(coarse: Registration, fine: Registration, probe: PointArray) -> tuple[Registration, Registration]:
    """The same registrations, of which the second has twice the steps, with their errors by Richardson's estimate."""
    change = float(np.linalg.norm(fine.map_points(probe) - coarse.map_points(probe), axis=1).max())
    gain = 2.0 ** float(fine.flow.module.metadata.order)
    return replace(coarse, error=change * gain / (gain - 1.0)), replace(fine, error=change / (gain - 1.0))


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
