"""Degrees of freedom: residuals are smaller than the errors of landmarks, because the fit follows errors, too.

By the linear theory what landmarks are missed by is a matrix I - A times where they are, A for the alignment and the
smoothing after it. Of n landmarks with d coordinates tr(I - A) coordinates are left, so that errors of a standard
deviation sigma leave residuals of about

    sigma sqrt(tr(I - A) / (n d)),

as a straight line leaves n - 2: Wahba (1983), J. R. Stat. Soc. B 45(1), section 4. The trace is taken where residuals
are as large as sigma. As an equation for A itself this is ill-posed: if sigma is a fifth too small, and the map rough
enough to follow errors, both sides of it fall together, and landmarks are met.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.registration.linear import Linear
from codegen.registration.matching import TRUSTED, Matching

LEAST = 0.8
"""The least size of residuals, in units of sigma: of few landmarks little more can be known."""


@dataclass(frozen=True, eq=False)
class Freedom:
    """The linear theory of the landmarks that are trusted, and how many coordinates the alignment leaves of each part.

    `left`, shape (n,), has for each eigenvector of the covariance the number of coordinates, from 0 to d, along it.
    """

    linear: Linear
    left: NDArray[np.float64]

    @classmethod
    def of(cls, matching: Matching) -> Freedom:
        """That of landmarks, their alignment and their frame."""
        trusted = matching.weights >= TRUSTED
        kept = trusted if trusted.any() else ~trusted
        linear = Linear.of(matching).chosen(kept)
        changes = matching.alignment.tangent(matching.pairs.moving[kept])
        along = np.einsum("nk,ndp->kdp", linear.vectors, changes)
        return cls(linear, matching.pairs.dimension - (along**2).sum(axis=(1, 2)))

    def coordinates(self, ridge: float) -> float:
        """How many coordinates a ridge leaves, tr(I - A)."""
        return float(self.linear.left(np.array([ridge]))[0] @ self.left)

    def target(self, sigma: float) -> float:
        """The root mean square, in pixels, that residuals are to have for errors of a standard deviation `sigma`."""
        whole = self.linear.displacements.size
        return sigma * max(LEAST, float(np.sqrt(self.coordinates(self.ridge_for(sigma)) / whole)))

    def ridge_for(self, residual: float) -> float:
        """The ridge that leaves a root mean square residual in pixels; a very large one where none leaves so much."""
        largest = self.linear.largest
        low, high = 1e-20 * largest, 1e12 * largest
        if largest == 0.0 or self.linear.residual(high) <= residual:
            return high
        for _ in range(80):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if self.linear.residual(middle) < residual else (low, middle)
        return high
