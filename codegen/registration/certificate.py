"""The certificate of a registration: that it does not fold, that its inverse is one, and how well landmarks are met."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from codegen.registration.coarse import Positions
from codegen.registration.frame import pixel_grid
from codegen.registration.maps import ROUND_TRIP, Registration

PORTION = 1 << 20
"""Pixels whose derivatives are in memory at once, a whole number of the blocks in which the flow carries points."""


@dataclass(frozen=True)
class Certificate:
    """What was found on the pixels of the warped image: those of the fixed one, or of the moving one by the inverse.

    `det_min` and `det_max` are the extremes of det J, the factor by which the map moving to fixed enlarges areas there;
    `det_min_at` is the pixel (x, y) of the least. `folded` counts the pixels at which it is not positive, `first_fold`
    is the first of them in reading order. `round_trip` and `residual_max` are in pixels.
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


def certify(registration: Registration, shape: Sequence[int] | None = None, *, inverse: bool = False) -> Certificate:
    """Evaluate the map's derivative at every pixel of the fixed image, or of an image of another shape.

    The derivative is that of the discrete inverse map, carried along its steps, not a difference of neighbouring
    pixels; its determinant is that of the map where the pixel comes from, turned over. With `inverse`, the pixels are
    those of the moving image, and the derivative is that of the map itself. Every pixel of a grid of at most 129 by
    129, and every landmark, is also sent there and back. What passes does not fold at any pixel and comes back to
    within 1e-8 pixels; between pixels nothing is evaluated.
    """
    return certify_with_positions(registration, shape, inverse=inverse)[0]


def certify_with_positions(
    registration: Registration, shape: Sequence[int] | None = None, *, inverse: bool = False
) -> tuple[Certificate, Positions]:
    """The certificate, and where every pixel comes from, which is found on the same way and is what `warp` needs.

    The arguments are those of `certify`.
    """
    default, carried = (
        (registration.shape, registration.leaving) if inverse else (registration.fixed_shape, registration.arriving)
    )
    whole = default if shape is None else shape
    grid = pixel_grid(whole)
    places, determinants = np.empty_like(grid), np.empty(len(grid))
    for part in (slice(k, k + PORTION) for k in range(0, len(grid), PORTION)):
        places[part], determinants[part] = carried(grid[part])
    round_trip = _round_trip(registration, whole, inverse)
    known = np.isfinite(determinants)
    least = int(np.argmin(np.where(known, determinants, np.inf)))
    wrong = np.flatnonzero(~((determinants > 0.0) & known))
    first = (float(grid[wrong[0], 0]), float(grid[wrong[0], 1])) if wrong.size else None
    passed = wrong.size == 0 and round_trip <= ROUND_TRIP and registration.status == "solved"
    certificate = Certificate(
        float(determinants[least]),
        float(determinants[known].max(initial=-np.inf)) if known.any() else np.nan,
        (float(grid[least, 0]), float(grid[least, 1])),
        int(wrong.size),
        first,
        round_trip,
        float(registration.residuals.max()),
        passed,
        _message(registration, round_trip, int(wrong.size), first, float(determinants[least])),
    )
    return certificate, Positions(places.reshape(*whole[:2], 2))


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
