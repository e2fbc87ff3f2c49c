"""Registration from pairs of landmarks, and leave-one-out errors.

From sigma to a map: the cost has two terms, misfit and roughness, and the strength of roughness is a free factor. The
discrepancy principle (Morozov 1966) determines the strength: the residuals are about as large as the standard deviation
sigma of the landmarks' errors. So the map is as smooth as sigma allows, corrected for the degrees of freedom of the fit
(`codegen.registration.linear`). The linear theory gives the first strength. Residuals grow with the strength, so a few
more solves suffice, each with a warm start from the previous solution.

Leave-one-out: the map of all other landmarks predicts each landmark. The error of this prediction is a target
registration error; the residual of a landmark that takes part in the fit is not. A landmark with an outlying error was
probably misplaced.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, LandmarkError, RegistrationError
from codegen.registration.grid import Extent
from codegen.registration.linear import Freedom, Linear, chosen_alignment
from codegen.registration.maps import TOLERANCE, Registration, in_steps, solved
from codegen.registration.matching import IN_ORDER, Matching, said_of_partners
from codegen.registration.noise import Loss, Outliers, choose_sigma, outliers_of, scale_of, weights_of
from codegen.registration.pairs import Kind, LandmarkPairs
from codegen.registration.solver import DEFAULT_SCHEME

MOST_SOLVES = 20  # most solves in the search for the strength of roughness
CLOSE = 0.05  # relative tolerance of the root mean square residual
STALLED = 4  # solves without progress after which the search ends
EASIER = 16.0  # the factor by which the strength is raised if the solver finds no solution
ALIGNED = 1e4
"""The largest ridge, as a multiple of the largest eigenvalue of the covariance; the map is nearly the alignment."""
ENOUGH = 0.1  # largest error of a map, in pixels, that is small enough for predictions of landmarks
MOST_LEFT_OUT = 100  # most landmarks for which leave-one-out is affordable, because each landmark takes a registration
OUTLIER = 3.5
"""Modified z-score above which an error is outlying: Iglewicz and Hoaglin (1993), How to detect and handle outliers."""

Progress = Callable[[str], None]


def register(
    pairs: LandmarkPairs,
    shape: Extent,
    *,
    fixed_shape: Extent | None = None,
    align: Kind = "auto",
    sigma: float | Literal["auto"] = 0.0,
    loss: Loss = "linear",
    scheme: str = DEFAULT_SCHEME,
    steps: int | None = None,
    tolerance: float = TOLERANCE,
    margin: float | None = None,
    start: Registration | None = None,
    quick: bool = False,
    progress: Progress | None = None,
) -> Registration:
    """Find the map that carries the moving landmarks to the fixed ones.

    Parameters
    ----------
    pairs : LandmarkPairs
        The landmarks.
    shape : sequence of int or Grid
        (height, width, ...) of the moving image in pixels, or its grid.
    fixed_shape : sequence of int or Grid, optional
        The shape of the fixed image if it differs.
    align : {"auto", "none", "similarity", "affine"}
        The alignment before the flow; "auto" takes the alignment with the least leave-one-out error.
    sigma : float or "auto"
        The standard deviation of the error of a coordinate, in pixels of the fixed image. Zero means that landmarks are
        met exactly; "auto" takes the result of `estimate_sigma`.
    loss : {"linear", "huber", "cauchy", "tukey"}
        All losses but "linear" are robust: they reduce the weight of landmarks with residuals of many sigmas.
    scheme : str
        The integration scheme of the flow.
    steps : int, optional
        The number of steps of the flow; by default large enough for an error of the map below `tolerance`.
    tolerance : float
        The largest error of the map, in pixels.
    margin : float, optional
        The distance from the images to the rim of the disc, relative to the radius of the images.
    start : Registration, optional
        An earlier registration with the same number of landmarks, for a warm start.
    quick : bool
        Give up after the first attempts (sigma zero), or keep the strength of a `start` of equal sigma. Needs `steps`.
    progress : function of str, optional
        Receives a line of text after each solve; if sigma is positive, there are up to 20 solves.

    Returns
    -------
    Registration
        The map and its inverse.

    Raises
    ------
    LandmarkError
        If the landmarks cannot be used.
    ArgumentError
        For an unknown alignment or loss, and for `quick` without `steps`.
    RegistrationError
        If no solution is found, or no solution with residuals as small as sigma.

    Notes
    -----
    If sigma is positive, the map is the smoothest map with residuals, within 5 percent, of 0.8 to 1 sigma. The factor
    is the correction for the degrees of freedom of the fit. `Matching` documents the cost, and
    `Registration.matching.strength` is the strength of roughness.
    """
    if quick and steps is None:
        raise ArgumentError("register(quick=True) has no number of steps", "give one, as in steps=16")
    if align == "auto":
        align = chosen_alignment(pairs, shape, fixed_shape=fixed_shape, scheme=scheme, margin=margin).kind
    if sigma == "auto":
        sigma = choose_sigma(pairs, shape, fixed_shape=fixed_shape, align=align, scheme=scheme, margin=margin)
    weights = weights_of(loss, np.zeros(len(pairs)))
    matching = Matching.of(
        pairs, shape, fixed_shape=fixed_shape, align=align, sigma=sigma, scheme=scheme, margin=margin, weights=weights
    )
    velocities = None if start is None or len(start.pairs) != len(pairs) else _first_velocities(matching, start)
    if sigma == 0.0:
        return solved(matching, steps, tolerance, velocities, quick)
    if loss != "linear":
        distances = np.nan_to_num(outliers_of(matching).errors) / sigma
        matching = matching.matched(pairs, weights_of(loss, distances, pairs.dimension))
    if start is not None and velocities is not None and start.sigma == sigma and loss == "linear":
        matching = replace(matching, strength=start.matching.strength)
        if quick and steps is not None:
            return in_steps(matching, steps, velocities, quick)
    else:
        freedom = Freedom.of(matching)
        ridge = min(freedom.ridge_for(freedom.target(sigma)), ALIGNED * freedom.linear.largest)
        matching = replace(matching, strength=ridge / replace(matching, strength=1.0).ridge)
    return _smoothest(matching, loss, steps, tolerance, velocities, progress)


def _first_velocities(matching: Matching, start: Registration) -> NDArray[np.float64]:
    """Return initial velocities from a registration of similar landmarks, plus straight motions of the differences."""
    (first, target), (start_first, start_target) = matching.ends, start.matching.ends
    return np.asarray(start.velocities + (target - first) - (start_target - start_first))


def _smoothest(
    matching: Matching,
    loss: Loss,
    steps: int | None,
    tolerance: float,
    velocities: NDArray[np.float64] | None,
    progress: Progress | None,
) -> Registration:
    """Return the registration with the strength (and weights of a robust loss) whose residuals agree with sigma."""
    sigma, unit, pairs = matching.sigma, matching.fixed_grid.unit, matching.pairs
    solves = 0
    while True:  # the first strength with a solution
        solves += 1
        try:
            current = solved(matching, steps, 10.0 * tolerance, velocities)
            break
        except RegistrationError:
            if solves >= 5:
                raise
            matching = replace(matching, strength=EASIER * matching.strength)
    target = Freedom.of(matching).target(sigma)
    low, high = -np.inf, np.inf  # logarithms of strengths whose residuals are too small, and too large
    tried: list[tuple[float, float]] = []  # logarithms of strengths and of residuals relative to the target
    following: Registration | None = current
    while solves < MOST_SOLVES and following is not None:
        current, following = following, None
        scale = scale_of(loss, current.residuals, pairs.dimension)
        logarithm, excess = float(np.log(current.matching.strength)), float(np.log(scale / target))
        if progress is not None:
            progress(f"solve {solves}: residuals of {scale:.3g} {unit} for a sigma of {sigma:g}")
        is_aligned = current.matching.ridge >= 0.99 * ALIGNED * Linear.of(current.matching).largest
        has_weights = loss == "linear" or solves > 3
        if (abs(excess) <= CLOSE and has_weights) or (is_aligned and excess < 0.0):
            break
        low, high = (logarithm, high) if excess < 0.0 else (low, logarithm)
        tried.append((logarithm, excess))
        recent = [excess for _, excess in tried[-STALLED:]]
        if len(recent) == STALLED and min(recent) > CLOSE and min(recent[1:]) > recent[0] - CLOSE:
            break
        # A secant between the bounds; residuals grow about as the square root of the strength.
        slope = 0.5
        if len(tried) > 1 and tried[-2][0] != logarithm:
            slope = float(np.clip((excess - tried[-2][1]) / (logarithm - tried[-2][0]), 0.1, 2.0))
        wanted = logarithm - float(np.clip(excess / slope, -4.0, 4.0))
        wanted = wanted if low < wanted < high else 0.5 * (low + high)
        matching = current.matching
        if loss != "linear":
            weights = weights_of(loss, current.residuals / sigma, pairs.dimension)
            matching = matching.matched(pairs, weights)
        largest = ALIGNED * Linear.of(matching).largest / replace(matching, strength=1.0).ridge
        for _ in range(3):
            solves += 1
            changed = replace(matching, strength=float(min(np.exp(wanted), largest)))
            if changed.frame != current.matching.frame:
                guess = _first_velocities(changed, current)
            else:
                guess = Linear.of(changed).continued(current.velocities, current.matching.ridge, changed.ridge)
            try:
                following = in_steps(changed, current.steps, guess, quick=True)
                break
            except RegistrationError:
                wanted = 0.5 * (wanted + logarithm)
    current = current if following is None else following
    scale = scale_of(loss, current.residuals, pairs.dimension)
    if scale > 1.25 * sigma:
        finding = f"residuals are {scale:.3g} {unit} where sigma is {sigma:g}"
        if out_of_order := said_of_partners(matching.pairs):
            raise RegistrationError(f"{finding}, and no map comes nearer; {out_of_order}", IN_ORDER)
        remedy = "give a larger sigma, or look for landmarks out of place"
        raise RegistrationError(f"{finding}, and no map was found that comes nearer", remedy)
    if steps is None and not (current.error <= tolerance * matching.fixed_grid.pixel):
        current = solved(current.matching, None, tolerance, current.velocities, first=current.steps)
    return replace(current, solves=solves)


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """The errors of landmarks that were left out: `misses`, shape (n, d), from fixed to predicted landmarks in pixels.

    They are NaN if the other landmarks determine no map. `ranking` has the numbers of the landmarks, counted from zero,
    in the order of decreasing errors, and `outliers` has the numbers of the landmarks with outlying errors.
    """

    misses: NDArray[np.float64]
    ranking: tuple[int, ...]
    outliers: tuple[int, ...]

    @cached_property
    def errors(self) -> NDArray[np.float64]:
        """Lengths of the errors in pixels of the fixed image, shape (n,)."""
        return np.asarray(np.linalg.norm(self.misses, axis=1))


def leave_one_out(
    pairs: LandmarkPairs,
    shape: Extent,
    *,
    steps: int | None = None,
    tolerance: float = ENOUGH,
    start: Registration | None = None,
    **options: Any,
) -> LeaveOneOut:
    """Predict each landmark by a registration of all other landmarks.

    Parameters
    ----------
    pairs : LandmarkPairs
        The landmarks.
    shape : sequence of int or Grid
        The shape or grid of the moving image, as in `register`.
    steps : int, optional
        The number of steps of the flow, as in `register`.
    tolerance : float
        The largest error of the map in pixels; larger than in `register`, since predictions err by some pixels.
    start : Registration, optional
        An earlier registration with the same number of landmarks, for a warm start.
    **options
        Other arguments of `register`.

    Returns
    -------
    LeaveOneOut
        The errors of the predictions.
    """
    count = len(pairs)
    misses = np.full((count, pairs.dimension), np.nan)
    if count > 1:
        full = register(pairs, shape, steps=steps, tolerance=tolerance, start=start, **options)
        velocities = full.velocities
        for k in range(count):
            try:
                guess = np.delete(velocities, k, axis=0)
                others = full.matching.matched(pairs.without(k), np.delete(full.matching.weights, k))
                predicting = in_steps(others, full.steps, guess, quick=True)
            except (LandmarkError, RegistrationError):
                continue
            misses[k] = predicting.map_points(pairs.moving[k : k + 1])[0] - pairs.fixed[k]
    errors = np.linalg.norm(misses, axis=1)
    ranking = tuple(map(int, np.argsort(-np.nan_to_num(errors, nan=-1.0), kind="stable")))
    outliers: tuple[int, ...] = ()
    finite = errors[np.isfinite(errors)]
    if finite.size >= 3:
        median = np.median(finite)
        deviation = np.median(np.abs(finite - median))
        outliers = tuple(k for k in ranking if 0.6745 * (errors[k] - median) > OUTLIER * deviation)
    return LeaveOneOut(misses, ranking, outliers)


def out_of_place(outliers: Outliers | None, left_out: LeaveOneOut | None) -> tuple[int, ...]:
    """Return the numbers of the outliers, or the outliers of leave-one-out if landmarks were too few for a search."""
    if outliers is not None and not np.isnan(outliers.errors).all():
        return outliers.numbers
    return left_out.outliers if left_out is not None else ()
