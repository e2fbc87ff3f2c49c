"""The linear theory of a matching: what small momenta would do, which tells beforehand how landmarks will be met.

The displacements of the landmarks are taken for a sample of a Gaussian field with the covariance H_pp, the Green's
function at the landmarks, and errors of one variance. Then smoothing is ridge regression, and everything follows from
one decomposition into eigenvectors: Wahba (1990), Spline Models for Observational Data, chapters 1 and 4. A "ridge" is
what is added to the diagonal of the covariance, in units of the disc: sigma^2 times the strength, see `Matching`.

Which alignment comes before the flow: the one after which landmarks that are left out are predicted best. An affine map
takes more out of the flow than a similarity, which is less for the flow to do, but it has more to be fitted, and
follows the errors of few landmarks. Leaving out each landmark in turn decides, by the linear theory, in which the
prediction of one by all others needs no solve.

Degrees of freedom: residuals are smaller than the errors of landmarks, because the fit follows errors, too. By the
linear theory what landmarks are missed by is a matrix I - A times where they are, A for the alignment and the smoothing
after it. Of n landmarks with d coordinates tr(I - A) coordinates are left, so that errors of a standard deviation sigma
leave residuals of about

    sigma sqrt(tr(I - A) / (n d)),

as a straight line leaves n - 2: Wahba (1983), J. R. Stat. Soc. B 45(1), section 4. The trace is taken where residuals
are as large as sigma. As an equation for A itself this is ill-posed: if sigma is a fifth too small, and the map rough
enough to follow errors, both sides of it fall together, and landmarks are met.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError
from codegen.registration.alignment import Kind, align, require_unmirrored
from codegen.registration.grid import Extent, grid_of
from codegen.registration.matching import TRUSTED, Matching
from codegen.registration.pairs import LandmarkPairs

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


CANDIDATES: tuple[Kind, ...] = ("similarity", "affine", "none")
"""Of equal errors, the first of these."""
FEWEST = 4
"""Of fewer landmarks, those that are left do not determine every candidate."""
MOST = 500
"""Of more landmarks, so many that are drawn evenly decide; time grows with the cube of their number."""
CLEARLY = 0.98
"""Another than the first has to have so much less of its error."""


@dataclass(frozen=True)
class AlignmentChoice:
    """The kind that was chosen, and the mean leave-one-out error with each kind that could be tried, in pixels."""

    kind: Kind
    errors: dict[str, float]
    unit: str = "pixels"

    @property
    def text(self) -> str:
        """What was compared, in words."""
        compared = ", ".join(f"{kind} {error:.3g}" for kind, error in self.errors.items())
        return (
            f"{self.kind} by leave-one-out ({self.unit}: {compared})"
            if compared
            else f"{self.kind}: too few to compare"
        )


def chosen_alignment(pairs: LandmarkPairs, shape: Extent, **options: Any) -> AlignmentChoice:
    """Compare alignments; arguments are those of `Matching.of`. LandmarkError where the landmarks mirror the image."""
    require_unmirrored(pairs)
    if len(pairs) < FEWEST:
        return AlignmentChoice(CANDIDATES[0], {})
    if len(pairs) > MOST:
        kept = np.zeros(len(pairs), dtype=bool)
        # Drawn, because every so-many-th landmark of a grid may be those of a few columns; always the same.
        kept[np.random.default_rng(0).choice(len(pairs), MOST, replace=False)] = True
        pairs = pairs.chosen(kept)
    errors: dict[str, float] = {}
    for kind in CANDIDATES:
        try:
            matching = Matching.of(pairs, shape, align=kind, **options)
            found = float(np.mean(left_out_errors(matching, kind)))
        except LandmarkError:  # a landmark is left out whose absence makes the others turn the image over
            continue
        if matching.alignment.kind == kind:
            errors[kind] = found
    if not errors:  # which says why as soon as it is used
        return AlignmentChoice(CANDIDATES[0], {})
    best = min(errors, key=lambda kind: errors[kind] if kind == CANDIDATES[0] else errors[kind] / CLEARLY)
    return AlignmentChoice(next(kind for kind in CANDIDATES if kind == best), errors, grid_of(shape).unit)


def left_out_errors(matching: Matching, kind: Kind) -> NDArray[np.float64]:
    """What the linear theory leaves of each landmark in pixels, predicted by the others and their alignment, (n,)."""
    pairs, linear = matching.pairs, Linear.of(matching)
    precision = linear.precision(linear.by_cross_validation())
    errors = np.empty(len(pairs))
    for k in range(len(pairs)):
        displacements = align(pairs.without(k), kind).apply(pairs.moving) - pairs.fixed
        errors[k] = np.linalg.norm(precision[k] @ displacements) / precision[k, k]
    return errors
