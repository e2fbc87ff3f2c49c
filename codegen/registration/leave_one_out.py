"""Leave-one-out: how well the map that all other landmarks give predicts each landmark, and what follows from that.

The error at a landmark that was left out is a target registration error, which the residual at a landmark that was
used is not. A landmark whose error stands out from the others' was probably placed wrongly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.grid import Extent
from codegen.registration.maps import Registration, in_steps
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.register import register

ENOUGH = 0.1
"""Error of a map, in pixels, below which its steps are many enough to predict landmarks with."""
OUTLIER = 3.5
"""Modified z-score of outliers: Iglewicz and Hoaglin (1993), How to detect and handle outliers."""


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """Where landmarks that were left out arrive, from the fixed ones, in pixels of the fixed image, shape (n, d).

    They are NaN where the others determine no map, as that of an only landmark. `ranking` are the numbers of the
    landmarks, counted from zero, from the largest error to the least; `outliers` those whose error stands out.
    """

    misses: NDArray[np.float64]
    ranking: tuple[int, ...]
    outliers: tuple[int, ...]

    @cached_property
    def errors(self) -> NDArray[np.float64]:
        """Errors of landmarks that were left out, in pixels of the fixed image, shape (n,)."""
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
    """Register once with all landmarks and once without each; arguments are those of `register`.

    Without `steps`, as many are taken as leave an error of the map below `tolerance` pixels, here a larger one than
    `register` has, because errors of prediction are of the order of pixels.
    """
    count = len(pairs)
    misses = np.full((count, pairs.dimension), np.nan)
    if count > 1:
        full = register(pairs, shape, steps=steps, tolerance=tolerance, start=start, **options)
        velocities = full.velocities
    for k in range(count if count > 1 else 0):
        try:
            kept = full.matching.without(k)
            found = in_steps(kept, full.steps, np.delete(velocities, k, axis=0), quick=True)
        except (LandmarkError, RegistrationError):
            continue
        misses[k] = found.map_points(pairs.moving[k : k + 1])[0] - pairs.fixed[k]
    errors = np.linalg.norm(misses, axis=1)
    ranking = np.argsort(-np.nan_to_num(errors, nan=-1.0), kind="stable")
    return LeaveOneOut(misses, tuple(map(int, ranking)), _outliers(errors, ranking))


def _outliers(errors: NDArray[np.float64], ranking: NDArray[np.intp]) -> tuple[int, ...]:
    """The numbers of errors far above the median, in units of the median deviation from it."""
    known = errors[np.isfinite(errors)]
    if known.size < 3:
        return ()
    median = np.median(known)
    deviation = np.median(np.abs(known - median))
    return tuple(int(k) for k in ranking if 0.6745 * (errors[k] - median) > OUTLIER * deviation)
