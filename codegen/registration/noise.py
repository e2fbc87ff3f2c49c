"""How large the errors of landmarks are, by their restricted likelihood, and whether that is plausible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.errors import LandmarkError
from codegen.registration.grid import Extent
from codegen.registration.likelihood import LikelySigma, likely_sigma
from codegen.registration.matching import Matching
from codegen.registration.outliers import outliers_of
from codegen.registration.pairs import LandmarkPairs

FEWEST = 4
"""Of fewer landmarks, no error can be told from a deformation."""
FEW = 15
"""With fewer landmarks an estimate is uncertain by a factor, which is said."""
UNSURE = 1.5
"""An estimate that is uncertain by a larger factor, by a standard error, is said to be so."""
LARGE = 0.1
"""An error that is so large a share of the landmarks' spread is said to be implausible."""


@dataclass(frozen=True)
class SigmaEstimate:
    """The standard deviation of landmarks' errors in pixels, and what makes it doubtful, if anything does."""

    sigma: float
    message: str = ""


def estimate_sigma(pairs: LandmarkPairs, shape: Extent, **options: Any) -> SigmaEstimate:
    """Estimate how far landmarks are from where they should be, from how far neighbours disagree.

    Displacements after the alignment are a smooth field and errors, whose standard deviation follows from their
    likelihood. Landmarks that are out of place do not take part. `options` are those of `Matching.of`; errors do not
    depend on the alignment, and something is aligned in any case. Raises LandmarkError for fewer than four landmarks.
    """
    if options.get("align") != "affine":
        options = {**options, "align": "similarity"}
    matching = Matching.of(pairs, shape, **options)
    if len(pairs) < FEWEST:
        raise LandmarkError(
            f"{len(pairs)} landmarks do not tell how large their errors are", f"give a sigma in {matching.unit}"
        )
    outliers = outliers_of(matching)
    trusted = np.ones(len(pairs), dtype=bool)
    trusted[list(outliers.numbers)] = False
    places = matching.realigned(trusted).apply(pairs.moving)[trusted]
    found = likely_sigma(places, places - pairs.fixed[trusted])
    spread = float(np.sqrt(((pairs.fixed - pairs.fixed.mean(axis=0)) ** 2).mean()))
    return SigmaEstimate(found.sigma, _doubt(found, spread, matching.unit, len(places), outliers.message))


def _doubt(found: LikelySigma, spread: float, unit: str, count: int, said: str) -> str:
    if found.sigma > LARGE * spread:
        finding = (
            f"sigma of {found.sigma:.3g} {unit} is implausible: {found.sigma / spread:.0%} of the landmarks' spread"
        )
        return f"{finding}; {said or 'look for landmarks out of place'}"
    if found.may_be_zero:
        finding = "the landmarks show no errors that could be told from a deformation"
        return f"{finding}; sigma is hardly above {found.high:.2g} {unit}"
    if count < FEW or found.high > UNSURE**2 * found.low:
        return f"of {count} landmarks alone, sigma is uncertain: {found.low:.2g} to {found.high:.2g} {unit}"
    return ""


def choose_sigma(pairs: LandmarkPairs, shape: Extent, **options: Any) -> float:
    """The estimate of `estimate_sigma`, in pixels; see there for arguments and errors."""
    return estimate_sigma(pairs, shape, **options).sigma
