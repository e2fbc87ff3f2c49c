"""How large the errors of landmarks are, by generalised cross-validation, and whether that is plausible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.errors import LandmarkError
from codegen.registration.grid import Extent
from codegen.registration.linear import Linear
from codegen.registration.matching import Matching
from codegen.registration.outliers import outliers_of
from codegen.registration.pairs import LandmarkPairs

FEWEST = 4
"""Of fewer landmarks, no error can be told from a deformation."""
FEW = 15
"""With fewer landmarks an estimate is uncertain by a factor, which is said."""
LARGE = 0.1
"""An error that is so large a share of the landmarks' spread is said to be implausible."""


@dataclass(frozen=True)
class SigmaEstimate:
    """The standard deviation of landmarks' errors in pixels, and what makes it doubtful, if anything does."""

    sigma: float
    message: str = ""


def estimate_sigma(pairs: LandmarkPairs, shape: Extent, **options: Any) -> SigmaEstimate:
    """Estimate how far landmarks are from where they should be, from how far neighbours disagree.

    Displacements after the alignment are smoothed by the linear theory, as strongly as makes the generalised
    cross-validation score least; the estimate is what that leaves, by its degrees of freedom. Landmarks that are out of
    place do not take part. `options` are those of `Matching.of`; errors do not depend on the alignment, and something
    is aligned in any case, since without it 20 landmarks were estimated at a fifth of their errors. Raises
    LandmarkError for fewer than four landmarks.
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
    alignment = matching.realigned(trusted)
    linear = Linear(matching.covariance, alignment.apply(pairs.moving) - pairs.fixed, alignment.parameters)
    _, sigma, is_inside = linear.chosen(trusted).by_cross_validation()
    spread = float(np.sqrt(((pairs.fixed - pairs.fixed.mean(axis=0)) ** 2).mean()))
    return SigmaEstimate(sigma, _doubt(sigma, spread, matching.unit, is_inside, int(trusted.sum()), outliers.message))


def _doubt(sigma: float, spread: float, unit: str, is_inside: bool, count: int, said: str) -> str:
    if sigma > LARGE * spread:
        finding = f"sigma of {sigma:.3g} {unit} is implausible: {sigma / spread:.0%} of the landmarks' spread"
        return f"{finding}; {said or 'look for landmarks out of place'}"
    if not is_inside:
        return "the landmarks show no errors that could be told from a deformation"
    return f"of {count} landmarks alone, sigma is uncertain" if count < FEW else ""


def choose_sigma(pairs: LandmarkPairs, shape: Extent, **options: Any) -> float:
    """The estimate of `estimate_sigma`, in pixels; see there for arguments and errors."""
    return estimate_sigma(pairs, shape, **options).sigma
