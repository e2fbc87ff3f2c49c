"""The linear theory of registrations with small momenta, which predicts residuals and leave-one-out errors.

The displacements of the landmarks are a sample of a Gaussian field, plus independent errors of equal variance. The
covariance H_pp of the field is the Green's function at the landmarks. Smoothing is then ridge regression, and all
results follow from one eigendecomposition: Wahba (1990), Spline Models for Observational Data, chapters 1 and 4. The
ridge is added to the diagonal of the covariance: sigma^2 times the strength of roughness, in units of the disc.

Choice of the alignment: an affine map leaves less deformation to the flow than a similarity. But it has more parameters
and follows the errors of few landmarks. The alignment with the least leave-one-out error is chosen. In the linear
theory the prediction of a landmark by all others needs no solve.

Degrees of freedom: residuals are smaller than the errors of landmarks, because the fit follows errors, too. In the
linear theory the residuals are (I - A) times the positions, where A is the matrix of alignment and smoothing. Of the
n d coordinates of n landmarks, tr(I - A) are free. Errors of standard deviation sigma leave residuals of about

    sigma sqrt(tr(I - A) / (n d)),

as a straight line through n points leaves n - 2 degrees of freedom: Wahba (1983), J. R. Stat. Soc. B 45(1), section 4.
The trace is evaluated for the ridge whose residuals are as large as sigma. Solving for A itself would be ill-posed: if
sigma is 20 % too small, both sides decrease together, and the map follows the errors until landmarks are met.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError
from codegen.registration.grid import Extent, grid_of
from codegen.registration.matching import TRUSTED, Matching
from codegen.registration.pairs import Kind, LandmarkPairs, align, require_unmirrored

RIDGES = np.logspace(-14.0, 2.0, 321)
"""Ridges that cross-validation compares, as fractions of the largest eigenvalue of the covariance."""
LEAST_FREE = 0.02  # least degrees of freedom per coordinate for which cross-validation determines the errors
EXACT = 1e-13  # the least ridge, as a fraction of the largest eigenvalue: the rounding error of an eigenvalue of zero
LEAST = 0.8  # the least expected residual, in units of sigma, because few landmarks do not determine a smaller value
CANDIDATES: tuple[Kind, ...] = ("similarity", "affine", "none")  # alignments that are compared, in order of preference
FEWEST = 4
"""Fewest landmarks for the comparison, because after one is left out the others must determine each candidate."""
MOST = 500
"""Most landmarks in the comparison; a random sample represents more, because time grows with their number cubed."""
CLEARLY = 0.98  # the ratio of errors below which another candidate is preferred to the first one

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Linear:
    """The covariance of n displacements, shape (n, n), and the displacements in pixels, shape (n, d).

    `fitted` is the number of parameters of the alignment, which reduce the degrees of freedom. A ridge is the parameter
    of the smoothing: the number that is added to the diagonal of the covariance.
    """

    covariance: Array
    displacements: Array
    fitted: int

    @classmethod
    def of(cls, matching: Matching) -> Linear:
        """Return the linear theory of the aligned landmarks of a matching."""
        start, target = matching.ends
        return cls(matching.covariance, (target - start) * matching.frame.radius, matching.alignment.parameters)

    @cached_property
    def parts(self) -> tuple[Array, Array, Array]:
        """Eigenvalues and eigenvectors (orthonormal columns) of the covariance; squared displacements along them."""
        values, vectors = np.linalg.eigh(self.covariance)
        return np.maximum(values, 0.0), vectors, ((vectors.T @ self.displacements) ** 2).sum(axis=1)

    @property
    def largest(self) -> float:
        """The largest eigenvalue of the covariance."""
        return float(self.parts[0][-1])

    def unfitted(self, ridges: Array) -> Array:
        """Return the fraction of the displacement along each eigenvector that each ridge leaves, shape (ridges, n)."""
        return ridges[:, None] / (self.parts[0] + ridges[:, None])

    def residual(self, ridge: float) -> float:
        """Return the root mean square of the residuals that a ridge leaves in a coordinate, in pixels."""
        unfitted = self.unfitted(np.array([ridge]))[0]
        return float(np.sqrt((unfitted**2 * self.parts[2]).sum() / self.displacements.size))

    def by_cross_validation(self) -> float:
        """Return the ridge that minimises squared residuals / (degrees of freedom)^2: generalised cross-validation."""
        ridges = RIDGES * self.largest
        unfitted = self.unfitted(ridges)
        squares = (unfitted**2 * self.parts[2]).sum(axis=1)
        free = float(self.displacements.shape[1]) * unfitted.sum(axis=1) - self.fitted
        enough = free > LEAST_FREE * self.displacements.size
        scores = np.where(enough, squares / np.where(enough, free, 1.0) ** 2, np.inf)
        return float(ridges[np.argmin(scores)])

    def precision(self, ridge: float) -> Array:
        """Return the inverse of the covariance plus `ridge` times the identity, shape (n, n)."""
        values, vectors, _ = self.parts
        return np.asarray((vectors / (values + max(ridge, EXACT * self.largest))) @ vectors.T)

    def continued(self, velocities: Array, before: float, after: float) -> Array:
        """Convert initial velocities, shape (n, d), of a solution with ridge `before` to the ridge `after`."""
        values, vectors, _ = self.parts
        return np.asarray(vectors @ (((values + before) / (values + after))[:, None] * (vectors.T @ velocities)))


@dataclass(frozen=True, eq=False)
class Freedom:
    """The linear theory of the trusted landmarks, and their degrees of freedom after the alignment.

    `free`, shape (n,), has the number of coordinates, 0 to d, that the alignment leaves free along each eigenvector.
    """

    linear: Linear
    free: NDArray[np.float64]

    @classmethod
    def of(cls, matching: Matching) -> Freedom:
        """Return the degrees of freedom of the trusted landmarks of a matching, or of all if none is trusted."""
        trusted = matching.weights >= TRUSTED
        kept = trusted if trusted.any() else ~trusted
        whole = Linear.of(matching)
        linear = Linear(whole.covariance[np.ix_(kept, kept)], whole.displacements[kept], whole.fitted)
        changes = matching.alignment.tangent(matching.pairs.moving[kept])
        along = np.einsum("nk,ndp->kdp", linear.parts[1], changes)
        return cls(linear, matching.pairs.dimension - (along**2).sum(axis=(1, 2)))

    def coordinates(self, ridge: float) -> float:
        """Return tr(I - A), the degrees of freedom of the residuals that a ridge leaves."""
        return float(self.linear.unfitted(np.array([ridge]))[0] @ self.free)

    def target(self, sigma: float) -> float:
        """Return the expected root mean square residual, in pixels, for errors of standard deviation `sigma`."""
        whole = self.linear.displacements.size
        return sigma * max(LEAST, float(np.sqrt(self.coordinates(self.ridge_for(sigma)) / whole)))

    def ridge_for(self, residual: float) -> float:
        """Return the ridge that leaves a root mean square residual, in pixels; a very large ridge if none does."""
        largest = self.linear.largest
        low, high = 1e-20 * largest, 1e12 * largest
        if largest == 0.0 or self.linear.residual(high) <= residual:
            return high
        for _ in range(80):
            middle = float(np.sqrt(low * high))
            low, high = (middle, high) if self.linear.residual(middle) < residual else (low, middle)
        return high


@dataclass(frozen=True)
class AlignmentChoice:
    """The chosen alignment, and the mean leave-one-out error of each candidate, in `unit`."""

    kind: Kind
    errors: dict[str, float]
    unit: str = "pixels"

    @property
    def text(self) -> str:
        """The choice and the errors as text."""
        if not self.errors:
            return f"{self.kind}: too few to compare"
        compared = ", ".join(f"{kind} {error:.3g}" for kind, error in self.errors.items())
        return f"{self.kind} by leave-one-out ({self.unit}: {compared})"


def chosen_alignment(pairs: LandmarkPairs, shape: Extent, **options: Any) -> AlignmentChoice:
    """Choose the alignment with the least leave-one-out error.

    Parameters
    ----------
    pairs : LandmarkPairs
        The landmarks.
    shape : sequence of int or Grid
        The shape or grid of the moving image, as in `register`.
    **options
        Other arguments of `Matching.of`.

    Returns
    -------
    AlignmentChoice
        The alignment and the errors.

    Raises
    ------
    LandmarkError
        If the landmarks mirror the image.
    """
    require_unmirrored(pairs)
    if len(pairs) < FEWEST:
        return AlignmentChoice(CANDIDATES[0], {})
    if len(pairs) > MOST:
        kept = np.zeros(len(pairs), dtype=bool)
        # A random sample, always the same: every n-th landmark of a grid may lie in a few columns.
        kept[np.random.default_rng(0).choice(len(pairs), MOST, replace=False)] = True
        pairs = pairs.chosen(kept)
    errors: dict[str, float] = {}
    for kind in CANDIDATES:
        try:
            matching = Matching.of(pairs, shape, align=kind, **options)
            linear = Linear.of(matching)
            precision = linear.precision(linear.by_cross_validation())
            predictions = np.empty(len(pairs))
            for k in range(len(pairs)):
                displacements = align(pairs.without(k), kind).apply(pairs.moving) - pairs.fixed
                predictions[k] = np.linalg.norm(precision[k] @ displacements) / precision[k, k]
        except LandmarkError:  # without one of the landmarks, the others mirror the image
            continue
        if matching.alignment.kind == kind:
            errors[kind] = float(np.mean(predictions))
    if not errors:  # fitting the alignment gives the reason
        return AlignmentChoice(CANDIDATES[0], {})
    best = min(errors, key=lambda kind: errors[kind] if kind == CANDIDATES[0] else errors[kind] / CLEARLY)
    return AlignmentChoice(next(kind for kind in CANDIDATES if kind == best), errors, grid_of(shape).unit)
