"""The certificate of a registration: that it does not fold, that its inverse is one, and how well landmarks are met."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from codegen.errors import RegistrationError
from codegen.registration.grid import Extent, Grid, grid_of, mesh, pixel_grid, slabs
from codegen.registration.maps import ROUND_TRIP, Registration, in_steps
from codegen.registration.pairs import PointArray
from codegen.registration.step_bounds import bound_of_steps, is_explicit
from codegen.registration.warp import PORTION, Positions

SPACING = 8
"""Pixels between those at which det J is evaluated where it is proved to be positive."""
NEAR, EXTREMES, REACH = 2, 24, {2: SPACING, 3: 4}
"""How far about landmarks every pixel is evaluated; of how many extremes, and how far, all are that lie about them."""
MOST_STEPS, NODES = 64, 200_000
"""The most steps that are made for the sake of a proof in space, and nodes of a grid by which one is tried."""
CHEAPER = 4
"""A node of a proof costs less than a pixel; so many times fewer are taken at most."""
SENT = {2: 129, 3: 25}
"""The most pixels along each axis that are sent there and back."""


@dataclass(frozen=True)
class Certificate:
    """What was found on the pixels of the warped image: those of the fixed one, or of the moving one by the inverse.

    Of volumes, pixels are voxels, areas are volumes, and places are in the coordinates of the landmarks.

    `det_min` and `det_max` are the extremes of det J, the factor by which the map moving to fixed enlarges areas there;
    `det_min_at` is the pixel (x, y) of the least. `folded` counts the pixels at which it is not positive, `first_fold`
    is the first of them in reading order. `round_trip` and `residual_max` are in pixels.
    Where bounds of the derivative decide, it is `proved` that det J is positive everywhere, and within `det_bounds`;
    the extremes are then those of `evaluated` pixels.
    """

    det_min: float
    det_max: float
    det_min_at: tuple[float, ...]
    folded: int
    first_fold: tuple[float, ...] | None
    round_trip: float
    residual_max: float
    passed: bool
    message: str
    proved: bool = False
    det_bounds: tuple[float, float] | None = None
    evaluated: int = 0


def certify(registration: Registration, shape: Extent | None = None, *, inverse: bool = False) -> Certificate:
    """Certify that the map does not fold, by bounds of its derivative where they decide, or pixel by pixel.

    Where every step is proved to differ from the identity by less than the identity, as in
    `codegen.registration.step_bounds`, the map folds nowhere, between pixels neither; det J is then evaluated at every
    `SPACING`-th pixel, at those about landmarks, and at all about the extremes that were found. Otherwise every pixel
    of the fixed image is evaluated, or of an image of another shape. The derivative is that of the discrete inverse
    map, carried along its steps, not a difference of neighbouring pixels; its determinant is that of the map where the
    pixel comes from, turned over. With `inverse`, the pixels are those of the moving image, and the derivative is that
    of the map itself. Every pixel of a grid of at most 129 by 129, or in space of 25 by 25 by 25, and every landmark,
    is also sent there and back.
    What passes comes back to within 1e-8 pixels.
    """
    return certificate_of(registration, shape, inverse=inverse)[0]


def certificate_of(
    registration: Registration, shape: Extent | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions | None]:
    """The same, and where every pixel comes from if all of them had to be evaluated."""
    whole = _whole(registration, shape, inverse)
    bounds = _bounds(registration, whole)
    if bounds is None and whole.dimension == 3:
        return _certified_in_slabs(registration, whole, inverse), None
    if bounds is None:
        return certify_with_positions(registration, shape, inverse=inverse)
    # Every so-many-th pixel, the last row and column, and the pixels about landmarks, where det J is least smooth.
    lines = [np.unique(np.append(np.arange(0, length, SPACING), length - 1)).astype(float) for length in whole.size]
    landmarks = registration.pairs.moving if inverse else registration.pairs.fixed
    points = np.vstack([whole.to_places(mesh(lines)), _about(landmarks, whole, NEAR)])
    _, determinants = (registration.leaving if inverse else registration.arriving)(points)
    points, determinants = _about_extremes(registration, whole, inverse, points, determinants)
    found = _certificate(registration, whole, inverse, points, determinants)
    scale, power = registration.alignment.determinant, float(registration.dimension)
    # The flow runs from fixed to moving, so that its determinant is turned over.
    low, high = (float(scale * np.exp(-power * np.log1p(sign * bounds).sum())) for sign in (1.0, -1.0))
    message = found.message
    if found.passed:
        message = f"the map is proved to fold nowhere; least det J found is {found.det_min:.4g}"
    return replace(found, proved=True, det_bounds=(low, high), message=message), None


def in_provable_steps(registration: Registration) -> Registration:
    """The same map in so many more steps that each is proved not to fold; as it is where that takes too many."""
    found = registration
    while is_explicit(found.flow) and bound_of_steps(found.flow, NODES) is None:
        if 2 * found.steps > MOST_STEPS or found.status != "solved":
            return registration
        try:
            found = in_steps(found.matching, 2 * found.steps, found.velocities, quick=True)
        except RegistrationError:
            return registration
    return replace(found, error=registration.error, solves=registration.solves)


def _whole(registration: Registration, shape: Extent | None, inverse: bool) -> Grid:
    default = registration.grid if inverse else registration.fixed_grid
    return default if shape is None else grid_of(shape)


def _bounds(registration: Registration, grid: Grid) -> NDArray[np.float64] | None:
    """Bounds of the flow's steps, if they decide with less work than evaluating every pixel."""
    if registration.alignment.determinant <= 0.0 or registration.status != "solved":
        return None
    least = NODES if grid.dimension == 3 else 0  # in space few nodes take less time than all voxels of a small volume
    return bound_of_steps(registration.flow, max(least, int(grid.count / CHEAPER)))


def _about(points: PointArray, grid: Grid, reach: int) -> PointArray:
    """The pixels in squares, or voxels in cubes, about points, each of them once."""
    offsets = mesh([np.arange(-reach, reach + 1.0)] * grid.dimension)
    found = np.unique((np.rint(grid.to_indices(points))[:, None] + offsets).reshape(-1, grid.dimension), axis=0)
    inside = ((found >= 0.0) & (found <= np.array(grid.size) - 1)).all(axis=1)
    return grid.to_places(found[inside])


def _about_extremes(
    registration: Registration, grid: Grid, inverse: bool, points: PointArray, determinants: NDArray[np.float64]
) -> tuple[PointArray, NDArray[np.float64]]:  # fmt: skip
    """The same and all pixels about the least and the largest determinants, with theirs."""
    order = np.argsort(determinants)
    chosen = points[np.concatenate([order[:EXTREMES], order[-EXTREMES:]])]
    more = _about(chosen, grid, REACH[grid.dimension])
    _, found = (registration.leaving if inverse else registration.arriving)(more)
    return np.vstack([points, more]), np.concatenate([determinants, found])


def certify_with_positions(
    registration: Registration, shape: Extent | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions]:
    """The certificate of every pixel, and where each comes from, which is found on the same way and `warp` needs.

    The arguments are those of `certify`; between pixels nothing is evaluated.
    """
    whole = _whole(registration, shape, inverse)
    carried = registration.leaving if inverse else registration.arriving
    grid = pixel_grid(whole.shape)
    places, determinants = np.empty_like(grid), np.empty(len(grid))
    for part in (slice(k, k + PORTION) for k in range(0, len(grid), PORTION)):
        places[part], determinants[part] = carried(grid[part])
    certificate = _certificate(registration, whole, inverse, grid, determinants)
    return certificate, Positions(places.reshape(*whole.shape, 2))


def _certified_in_slabs(registration: Registration, grid: Grid, inverse: bool) -> Certificate:
    """The certificate of every voxel, of which few are in memory at once."""
    carried = registration.leaving if inverse else registration.arriving
    columns, rows, slices = grid.size
    found = _Found.none()
    for slab in slabs(slices, max(1, PORTION // (columns * rows))):
        lines = [np.arange(float(columns)), np.arange(float(rows)), np.arange(float(slab.start), float(slab.stop))]
        places = grid.to_places(mesh(lines))
        found = found.joined(_Found.of(places, carried(places)[1]))
    return _judged(registration, grid, inverse, found)


@dataclass(frozen=True)
class _Found:
    """The extremes of determinants, their places, and where they are not positive, of so many as were evaluated."""

    least: float
    least_at: tuple[float, ...]
    largest: float
    folded: int
    first: tuple[float, ...] | None
    evaluated: int

    @classmethod
    def none(cls) -> _Found:
        return cls(np.inf, (), -np.inf, 0, None, 0)

    @classmethod
    def of(cls, points: PointArray, determinants: NDArray[np.float64]) -> _Found:
        known = np.isfinite(determinants)
        least = int(np.argmin(np.where(known, determinants, np.inf)))
        wrong = np.flatnonzero(~((determinants > 0.0) & known))
        first = tuple(map(float, points[wrong[0]])) if wrong.size else None
        largest = float(determinants[known].max(initial=-np.inf)) if known.any() else np.nan
        place = tuple(map(float, points[least]))
        return cls(float(determinants[least]), place, largest, int(wrong.size), first, len(points))

    def joined(self, other: _Found) -> _Found:
        """Both together, this one first."""
        lower = self if not other.least < self.least else other
        return _Found(
            lower.least, lower.least_at or other.least_at, float(np.fmax(self.largest, other.largest)),
            self.folded + other.folded, self.first or other.first, self.evaluated + other.evaluated,
        )  # fmt: skip


def _certificate(
    registration: Registration, grid: Grid, inverse: bool, points: PointArray, determinants: NDArray[np.float64]
) -> Certificate:
    """What determinants at points say, and points that come back."""
    return _judged(registration, grid, inverse, _Found.of(points, determinants))


def _judged(registration: Registration, grid: Grid, inverse: bool, found: _Found) -> Certificate:
    # The farthest that a point comes back from where it was, in pixels; infinite where one does not come back.
    there, back = registration.map_points_inverse, registration.map_points
    landmarks = registration.pairs.fixed
    if inverse:
        there, back, landmarks = back, there, registration.pairs.moving
    points = np.vstack([grid.samples(SENT[grid.dimension]), landmarks])
    distance = float(np.linalg.norm(back(there(points)) - points, axis=1).max())
    round_trip = distance if np.isfinite(distance) else np.inf
    return Certificate(
        found.least,
        found.largest,
        found.least_at,
        found.folded,
        found.first,
        round_trip,
        float(registration.residuals.max()),
        found.folded == 0
        and round_trip <= ROUND_TRIP * registration.fixed_grid.pixel
        and registration.status == "solved",
        _message(registration, round_trip, found),
        evaluated=found.evaluated,
    )


def _message(registration: Registration, round_trip: float, found: _Found) -> str:
    if found.first is not None:
        what = "pixels" if registration.dimension == 2 else "voxels"
        place = ", ".join(f"{x:g}" for x in found.first)
        return f"the map folds at {found.folded} {what}, the first at ({place}); take more steps"
    if not round_trip <= ROUND_TRIP * registration.fixed_grid.pixel:
        return f"points come back only to within {round_trip:.1e} {registration.fixed_grid.unit}; take more steps"
    if registration.status != "solved":
        return registration.message
    return f"the map does not fold: det J is at least {found.least:.4g}"
