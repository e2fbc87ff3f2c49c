"""Leave-one-out: how well the map that all other landmarks give predicts each landmark, and what follows from that.

The error at a landmark that was left out is a target registration error, which the residual at a landmark that was
used is not. A landmark whose error stands out from the others' was probably placed wrongly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.maps import Registration, in_steps, registered
from codegen.registration.matching import Matching
from codegen.registration.pairs import LandmarkPairs

ENOUGH = 0.1
"""Error of a map, in pixels, below which its steps are many enough to predict landmarks with."""
OUTLIER = 3.5
"""Modified z-score of outliers: Iglewicz and Hoaglin (1993), How to detect and handle outliers."""
SIGMAS = (0.0, 0.01, 0.03, 0.1, 0.3)
"""Values of sigma that are compared, as fractions of the radius of the frame."""


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Errors of landmarks that were left out, in pixels of the fixed image, shape (n,).

    An error is NaN where the others determine no map, as that of an only landmark. `ranking` are the numbers of the
    landmarks, counted from zero, from the largest error to the least; `outliers` those whose error stands out.
    """

    errors: NDArray[np.float64]
    ranking: tuple[int, ...]
    outliers: tuple[int, ...]

    @property
    def root_mean_square(self) -> float:
        """Of all errors, in pixels; NaN if there is none."""
        known = self.errors[np.isfinite(self.errors)]
        return float(np.sqrt((known**2).mean())) if known.size else np.nan


def leave_one_out(
    pairs: LandmarkPairs,
    shape: Sequence[int],
    *,
    steps: int | None = None,
    tolerance: float = ENOUGH,
    start: Registration | None = None,
    **options: Any,
) -> LeaveOneOut:
    """Register once with all landmarks and once without each; arguments are those of `register`.

    Without `steps`, as many are taken as leave an error of the map below `tolerance` pixels, here a larger one than
    `register` has, because errors of prediction are of the order of pixels.
    """
    count = len(pairs)
    errors = np.full(count, np.nan)
    if count > 1:
        full = registered(pairs, shape, steps=steps, tolerance=tolerance, start=start, **options)
        velocities = full.flow.velocities
    for k in range(count if count > 1 else 0):
        kept = Matching.of(pairs.without(k), shape, **options)
        try:
            found = in_steps(kept, full.steps, np.delete(velocities, k, axis=0), quick=True)
        except RegistrationError:
            continue
        errors[k] = np.linalg.norm(found.map_points(pairs.moving[k : k + 1]) - pairs.fixed[k])
    ranking = np.argsort(-np.nan_to_num(errors, nan=-1.0), kind="stable")
    return LeaveOneOut(errors, tuple(map(int, ranking)), _outliers(errors, ranking))


def _outliers(errors: NDArray[np.float64], ranking: NDArray[np.intp]) -> tuple[int, ...]:
    """The numbers of errors far above the median, in units of the median deviation from it."""
    known = errors[np.isfinite(errors)]
    if known.size < 3:
        return ()
    median = np.median(known)
    deviation = np.median(np.abs(known - median))
    return tuple(int(k) for k in ranking if 0.6745 * (errors[k] - median) > OUTLIER * deviation)


@dataclass(frozen=True, eq=False)
class SigmaChoice:
    """The sigma, in pixels, whose leave-one-out error is least, all that were compared, and their errors (pixels)."""

    sigma: float
    candidates: tuple[float, ...]
    errors: tuple[float, ...]


def choose_sigma(pairs: LandmarkPairs, shape: Sequence[int], **options: Any) -> float:
    """The sigma, in pixels, with the least leave-one-out error; see `compare_sigmas` for arguments and errors."""
    return compare_sigmas(pairs, shape, **options).sigma


def compare_sigmas(
    pairs: LandmarkPairs,
    shape: Sequence[int],
    *,
    candidates: Sequence[float] | None = None,
    steps: int | None = None,
    tolerance: float = ENOUGH,
    **options: Any,
) -> SigmaChoice:
    """Compare values of sigma by the root mean square of their leave-one-out errors, and take the best.

    `candidates` are in pixels, by default 0 and fractions of the frame's radius. Other arguments are those of
    `register`. Raises LandmarkError where fewer than three landmarks leave nothing to compare, RegistrationError where
    no candidate can be registered.
    """
    if len(pairs) < 3:
        raise LandmarkError(f"sigma cannot be chosen by leaving out one of {len(pairs)} landmarks", "give a sigma")
    if candidates is None:
        radius = Matching.of(pairs, shape, **options).frame.radius
        candidates = [fraction * radius for fraction in SIGMAS]
    known, smoother = dict[float, float](), None
    # The smoothest map is the easiest to find, and the next one is near it.
    for sigma in sorted(candidates, reverse=True):
        own = {**options, "sigma": sigma}
        try:
            smoother = registered(pairs, shape, steps=steps, tolerance=tolerance, start=smoother, **own)
        except RegistrationError:
            continue
        found = leave_one_out(pairs, shape, steps=steps, tolerance=tolerance, start=smoother, **own)
        if np.isfinite(found.errors).all():
            known[sigma] = found.root_mean_square
    if not known:
        raise RegistrationError("no sigma that was tried connects the landmarks", "look for landmarks out of place")
    tried = sorted(known)
    # Of errors that differ by rounding alone, that of the smaller sigma, which meets the landmarks better.
    best = min(tried, key=lambda sigma: (round(known[sigma], 9), sigma))
    return SigmaChoice(best, tuple(tried), tuple(known[sigma] for sigma in tried))
