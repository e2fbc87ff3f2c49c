"""The certificate of a registration: that it does not fold, that its inverse is one, and how well landmarks are met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from codegen.registration.coarse import Positions
from codegen.registration.frame import pixel_grid
from codegen.registration.maps import ROUND_TRIP, Registration
from codegen.registration.pairs import PointArray
from codegen.registration.step_bounds import bound_of_steps

SPACING = 8
"""Pixels between those at which det J is evaluated where it is proved to be positive."""
NEAR, EXTREMES = 2, 24
"""How far about landmarks every pixel is evaluated, and how many of the extremes are looked at from close by."""
CHEAPER = 4
"""A node of a proof costs less than a pixel; so many times fewer are taken at most."""
PORTION = 1 << 20
"""Pixels whose derivatives are in memory at once, a whole number of the blocks in which the flow carries points."""


@dataclass(frozen=True)
class Certificate:
    """What was found on the pixels of the warped image: those of the fixed one, or of the moving one by the inverse.

    `det_min` and `det_max` are the extremes of det J, the factor by which the map moving to fixed enlarges areas there;
    `det_min_at` is the pixel (x, y) of the least. `folded` counts the pixels at which it is not positive, `first_fold`
    is the first of them in reading order. `round_trip` and `residual_max` are in pixels.
    Where bounds of the derivative decide, it is `proved` that det J is positive everywhere, and within `det_bounds`;
    the extremes are then those of `evaluated` pixels.
    """

    det_min: float
    det_max: float
    det_min_at: tuple[float, float]
    folded: int
    first_fold: tuple[float, float] | None
    round_trip: float
    residual_max: float
    passed: bool
    message: str
    proved: bool = False
    det_bounds: tuple[float, float] | None = None
    evaluated: int = 0


def certify(registration: Registration, shape: Sequence[int] | None = None, *, inverse: bool = False) -> Certificate:
    """Certify that the map does not fold, by bounds of its derivative where they decide, or pixel by pixel.

    Where every step is proved to differ from the identity by less than the identity, as in
    `codegen.registration.step_bounds`, the map folds nowhere, between pixels neither; det J is then evaluated at every
    `SPACING`-th pixel, at those about landmarks, and at all about the extremes that were found. Otherwise every pixel
    of the fixed image is evaluated, or of an image of another shape. The derivative is that of the discrete inverse
    map, carried along its steps, not a difference of neighbouring pixels; its determinant is that of the map where the
    pixel comes from, turned over. With `inverse`, the pixels are those of the moving image, and the derivative is that
    of the map itself. Every pixel of a grid of at most 129 by 129, and every landmark, is also sent there and back.
    What passes comes back to within 1e-8 pixels.
    """
    return certificate_of(registration, shape, inverse=inverse)[0]


def certificate_of(
    registration: Registration, shape: Sequence[int] | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions | None]:
    """The same, and where every pixel comes from if all of them had to be evaluated."""
    whole = _whole(registration, shape, inverse)
    bounds = _bounds(registration, whole)
    if bounds is None:
        return certify_with_positions(registration, shape, inverse=inverse)
    points = _sparse(registration, whole, inverse)
    _, determinants = (registration.leaving if inverse else registration.arriving)(points)
    points, determinants = _about_extremes(registration, whole, inverse, points, determinants)
    found = _certificate(registration, whole, inverse, points, determinants)
    scale = registration.alignment.determinant
    # The flow runs from fixed to moving, so that its determinant is turned over.
    low, high = (float(scale * np.exp(-2.0 * np.log1p(sign * bounds).sum())) for sign in (1.0, -1.0))
    message = found.message
    if found.passed:
        message = f"the map is proved to fold nowhere; least det J found is {found.det_min:.4g}"
    return replace(found, proved=True, det_bounds=(low, high), message=message), None


def _whole(registration: Registration, shape: Sequence[int] | None, inverse: bool) -> Sequence[int]:
    default = registration.shape if inverse else registration.fixed_shape
    return default if shape is None else shape


def _bounds(registration: Registration, shape: Sequence[int]) -> NDArray[np.float64] | None:
    """Bounds of the flow's steps, if they decide with less work than evaluating every pixel."""
    if registration.alignment.determinant <= 0.0 or registration.status != "solved":
        return None
    return bound_of_steps(registration.flow, int(shape[0] * shape[1] / CHEAPER))


def _sparse(registration: Registration, shape: Sequence[int], inverse: bool) -> PointArray:
    """Every so-many-th pixel, the last row and column, and the pixels about landmarks, where det J is least smooth."""
    y, x = (np.unique(np.append(np.arange(0, length, SPACING), length - 1)) for length in shape[:2])
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(float)
    landmarks = registration.pairs.moving if inverse else registration.pairs.fixed
    return np.vstack([grid, _about(landmarks, shape, NEAR)])


def _about(points: PointArray, shape: Sequence[int], reach: int) -> PointArray:
    """The pixels in squares about points, each of them once."""
    offsets = np.stack(np.meshgrid(*[np.arange(-reach, reach + 1)] * 2), axis=-1).reshape(-1, 2)
    found = np.unique((np.rint(points)[:, None] + offsets).reshape(-1, 2), axis=0)
    inside = ((found >= 0.0) & (found <= [shape[1] - 1, shape[0] - 1])).all(axis=1)
    return np.asarray(found[inside])


def _about_extremes(
    registration: Registration, shape: Sequence[int], inverse: bool, points: PointArray,
    determinants: NDArray[np.float64],
) -> tuple[PointArray, NDArray[np.float64]]:  # fmt: skip
    """The same and all pixels about the least and the largest determinants, with theirs."""
    order = np.argsort(determinants)
    chosen = points[np.concatenate([order[:EXTREMES], order[-EXTREMES:]])]
    more = _about(chosen, shape, SPACING)
    _, found = (registration.leaving if inverse else registration.arriving)(more)
    return np.vstack([points, more]), np.concatenate([determinants, found])


def certify_with_positions(
    registration: Registration, shape: Sequence[int] | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions]:
    """The certificate of every pixel, and where each comes from, which is found on the same way and `warp` needs.

    The arguments are those of `certify`; between pixels nothing is evaluated.
    """
    whole = _whole(registration, shape, inverse)
    carried = registration.leaving if inverse else registration.arriving
    grid = pixel_grid(whole)
    places, determinants = np.empty_like(grid), np.empty(len(grid))
    for part in (slice(k, k + PORTION) for k in range(0, len(grid), PORTION)):
        places[part], determinants[part] = carried(grid[part])
    certificate = _certificate(registration, whole, inverse, grid, determinants)
    return certificate, Positions(places.reshape(*whole[:2], 2))


def _certificate(
    registration: Registration, shape: Sequence[int], inverse: bool, points: PointArray,
    determinants: NDArray[np.float64],
) -> Certificate:  # fmt: skip
    """What determinants at points say, and points that come back."""
    round_trip = _round_trip(registration, shape, inverse)
    known = np.isfinite(determinants)
    least = int(np.argmin(np.where(known, determinants, np.inf)))
    wrong = np.flatnonzero(~((determinants > 0.0) & known))
    first = (float(points[wrong[0], 0]), float(points[wrong[0], 1])) if wrong.size else None
    passed = wrong.size == 0 and round_trip <= ROUND_TRIP and registration.status == "solved"
    return Certificate(
        float(determinants[least]),
        float(determinants[known].max(initial=-np.inf)) if known.any() else np.nan,
        (float(points[least, 0]), float(points[least, 1])),
        int(wrong.size),
        first,
        round_trip,
        float(registration.residuals.max()),
        passed,
        _message(registration, round_trip, int(wrong.size), first, float(determinants[least])),
        evaluated=len(points),
    )


def _message(
    registration: Registration, round_trip: float, folded: int, first: tuple[float, float] | None, least: float
) -> str:
    if first is not None:
        return f"the map folds at {folded} pixels, the first at ({first[0]:g}, {first[1]:g}); take more steps"
    if not round_trip <= ROUND_TRIP:
        return f"points come back only to within {round_trip:.1e} pixels; take more steps"
    if registration.status != "solved":
        return registration.message
    return f"the map does not fold: det J is at least {least:.4g}"


def _round_trip(registration: Registration, shape: Sequence[int], inverse: bool) -> float:
    """The farthest that a point comes back from where it was, in pixels; infinite where one does not come back."""
    there, back = registration.map_points_inverse, registration.map_points
    landmarks = registration.pairs.fixed
    if inverse:
        there, back, landmarks = back, there, registration.pairs.moving
    height, width = shape[:2]
    x, y = (np.unique(np.linspace(0, length - 1, 129).round()) for length in (width, height))
    points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    points = np.vstack([points, landmarks])
    distance = float(np.linalg.norm(back(there(points)) - points, axis=1).max())
    return distance if np.isfinite(distance) else np.inf
