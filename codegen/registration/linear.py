"""The linear theory of a matching: what small momenta would do, which tells beforehand how landmarks will be met.

The displacements of the landmarks are taken for a sample of a Gaussian field with the covariance H_pp, the Green's
function at the landmarks, and errors of one variance. Then smoothing is ridge regression, and everything follows from
one decomposition into eigenvectors: Wahba (1990), Spline Models for Observational Data, chapters 1 and 4. A "ridge" is
what is added to the diagonal of the covariance, in units of the disc: sigma^2 times the strength, see `Matching`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from codegen.registration.matching import Matching

RIDGES = np.logspace(-14.0, 2.0, 321)
"""Ridges that are compared, as fractions of the largest eigenvalue of the covariance."""
LEAST_FREE = 0.02
"""Least share of the data that smoothing leaves free for errors; with less, nothing is known of them."""
EXACT = 1e-13
"""The ridge, as a fraction of the largest eigenvalue, where landmarks are to be met: what rounding makes of zero."""

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Linear:
    """The covariance of n displacements, shape (n, n), and the displacements in pixels, shape (n, d).

    `fitted` is the number of parameters of the alignment, which takes part of the errors for itself.
    """

    covariance: Array
    displacements: Array
    fitted: int

    @classmethod
    def of(cls, matching: Matching) -> Linear:
        """That of landmarks, their alignment and their frame."""
        start, target = matching.all_ends
        return cls(matching.covariance, (target - start) * matching.frame.radius, matching.alignment.parameters)

    def chosen(self, kept: NDArray[np.bool_]) -> Linear:
        """The same of some of the landmarks, shape (n,)."""
        return Linear(self.covariance[np.ix_(kept, kept)], self.displacements[kept], self.fitted)

    @cached_property
    def _parts(self) -> tuple[Array, Array, Array]:
        """Eigenvalues, eigenvectors, and the squares of the displacements along them."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.maximum(values, 0.0), vectors, ((vectors.T @ self.displacements) ** 2).sum(axis=1)

    @property
    def vectors(self) -> Array:
        """Orthonormal eigenvectors of the covariance, shape (n, n), one a column."""
        return self._parts[1]

    @property
    def largest(self) -> float:
        """The largest eigenvalue."""
        return float(self._parts[0][-1])

    def left(self, ridges: Array) -> Array:
        """The share of each component that smoothing leaves, shape (number of ridges, n)."""
        return ridges[:, None] / (self._parts[0] + ridges[:, None])

    def residual(self, ridge: float) -> float:
        """The root mean square of what the coordinates of landmarks are missed by, in pixels."""
        left = self.left(np.array([ridge]))[0]
        return float(np.sqrt((left**2 * self._parts[2]).sum() / self.displacements.size))

    def by_cross_validation(self) -> float:
        """The ridge with the least generalised cross-validation score: squared residuals by free data squared."""
        ridges = RIDGES * self.largest
        left = self.left(ridges)
        squares = (left**2 * self._parts[2]).sum(axis=1)
        free = float(self.displacements.shape[1]) * left.sum(axis=1) - self.fitted
        known = free > LEAST_FREE * self.displacements.size
        scores = np.where(known, squares / np.where(known, free, 1.0) ** 2, np.inf)
        return float(ridges[np.argmin(scores)])

    def precision(self, ridge: float) -> Array:
        """The inverse of covariance plus ridge, shape (n, n)."""
        values, vectors, _ = self._parts
        return np.asarray((vectors / (values + max(ridge, EXACT * self.largest))) @ vectors.T)

    def continued(self, velocities: Array, before: float, after: float) -> Array:
        """Velocities at the start for another ridge, from those of a nearly linear solution, shape (n, d)."""
        values, vectors, _ = self._parts
        return np.asarray(vectors @ (((values + before) / (values + after))[:, None] * (vectors.T @ velocities)))
