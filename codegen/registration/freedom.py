"""Degrees of freedom: residuals are smaller than the errors of landmarks, because the fit follows errors, too.

By the linear theory what a landmark is missed by is a matrix I - A times the errors, A for the alignment and the
smoothing after it. Of n landmarks with d coordinates, tr(I - A) coordinates are left, and

    sum |miss|^2 / tr(I - A)

estimates the variance of an error: Wahba (1983), J. R. Stat. Soc. B 45(1), section 4, and for a straight line the
familiar n - 2. Its root is called the standard error of the residuals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codegen.registration.linear import Linear
from codegen.registration.matching import TRUSTED, Matching

FEWEST = 1e-9
"""Share of the coordinates below which none is left: landmarks are then met whatever their errors."""


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

    def factor(self, ridge: float) -> float:
        """How many times as large as the root mean square of residuals their standard error is."""
        whole, left = self.linear.displacements.size, self.coordinates(ridge)
        return float(np.sqrt(whole / left)) if left > FEWEST * whole else 1.0

    def deviation(self, ridge: float) -> float:
        """The standard error of the residuals that a ridge leaves, in pixels."""
        return self.linear.residual(ridge) * self.factor(ridge)

    def ridge_for(self, sigma: float) -> float:
        """The ridge whose residuals have a given standard error; infinite where no smoothing leaves so much."""
        largest = self.linear.largest
        if self.deviation(np.inf if largest == 0.0 else 1e12 * largest) <= sigma:
            return np.inf
        low, high = 1e-20 * largest, 1e12 * largest
        for _ in range(80):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if self.deviation(middle) < sigma else (low, middle)
        return high
