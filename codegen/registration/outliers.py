"""Landmarks out of place: which of them the others, by what is smooth about them, do not predict.

Each landmark is predicted by the linear theory from those that are trusted; one whose error is far above what its
neighbours' errors and its distance from them explain is an outlier, and no longer predicts others. This goes on until
nothing changes. It needs no solve of a flow, and masks are rare because nothing is trusted that stood out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi

from codegen.errors import ArgumentError
from codegen.registration.alignment import Kind
from codegen.registration.grid import Extent
from codegen.registration.linear import Linear
from codegen.registration.matching import Matching
from codegen.registration.pairs import LandmarkPairs

Loss: TypeAlias = Literal["linear", "huber", "cauchy", "tukey"]
LOSSES: tuple[Loss, ...] = ("linear", "huber", "cauchy", "tukey")
LEAST = 1e-6
"""The least weight, so that what belongs to no motion still has a place to be measured from."""


def typical_distance(dimension: int, share: float = 0.5) -> float:
    """Within this distance lies a share of points whose coordinates have standard deviation 1 (Rayleigh, Maxwell)."""
    return float(np.sqrt(-2.0 * np.log(1.0 - share)) if dimension == 2 else chi.ppf(share, dimension))


def weights_of(loss: Loss, distances: NDArray[np.float64], dimension: int = 2) -> NDArray[np.float64]:
    """The weights of iteratively reweighted least squares, for distances in units of sigma, shape (n,).

    Tuning constants are the usual ones (Holland and Welsch 1977, Commun. Stat. A 6(9)) times the square root of the
    dimension, which is the number of a landmark's coordinates. Raises ArgumentError for an unknown loss.
    """
    if loss not in LOSSES:
        raise ArgumentError(f"the loss is {loss!r}", f"use {', '.join(LOSSES)}")
    if loss == "linear":
        return np.ones(len(distances))
    tuning = {"huber": 1.345, "cauchy": 2.385, "tukey": 4.685}[loss] * np.sqrt(float(dimension))
    scaled = distances / tuning
    if loss == "huber":
        weights = 1.0 / np.maximum(scaled, 1.0)
    elif loss == "cauchy":
        weights = 1.0 / (1.0 + scaled**2)
    else:
        weights = np.where(scaled < 1.0, (1.0 - np.minimum(scaled, 1.0) ** 2) ** 2, 0.0)
    return np.asarray(np.maximum(weights, LEAST))


def scale_of(loss: Loss, distances: NDArray[np.float64], dimension: int = 2) -> float:
    """The standard deviation of a coordinate, from distances of landmarks; by the median where a loss is robust."""
    if loss == "linear":
        return float(np.sqrt((distances**2).mean() / dimension))
    return float(np.median(distances) / typical_distance(dimension))


FEWEST = 8
"""Of fewer landmarks, none can be told to be out of place."""
FAR = 4.0
"""Errors from which on a landmark stands out, in units of their standard deviation: one in 3000 by chance."""
LEAST_ERROR = 0.5
"""The least standard deviation of an error in pixels; nobody places landmarks better."""
MOST_AT_ONCE = 0.1
"""The share of landmarks that one round may put aside, at most: those that stand out most."""
MOST = 1.0 / 3.0
"""The share of outliers beyond which landmarks contradict each other and none is to blame."""
ROUNDS = 30
TAIL = 0.8
"""The quantile of errors that may widen their scale, where they are not normal."""


@dataclass(frozen=True, eq=False)
class Outliers:
    """Which landmarks are out of place, from the farthest to the nearest, and the errors at all of them.

    `errors` are distances in pixels of the fixed image between what the trusted landmarks predict and what is given,
    shape (n,); `numbers` count landmarks from zero. `message` says why none is named where that is not because all fit.
    """

    numbers: tuple[int, ...]
    errors: NDArray[np.float64]
    message: str = ""


def find_outliers(
    pairs: LandmarkPairs, shape: Extent, *, fixed_shape: Extent | None = None, align: Kind = "similarity"
) -> Outliers:
    """Look for landmarks out of place; arguments are those of `register`, and so is what is raised."""
    return outliers_of(Matching.of(pairs, shape, fixed_shape=fixed_shape, align=align))


def outliers_of(matching: Matching) -> Outliers:
    """The same for landmarks that are to be matched, in their frame and with their kind of alignment."""
    count = len(matching.pairs)
    if count < FEWEST:
        return Outliers((), np.full(count, np.nan), f"fewer than {FEWEST} landmarks do not tell which is out of place")
    trusted = np.ones(count, dtype=bool)
    for _ in range(ROUNDS):
        errors, deviations = _predicted(matching, trusted)
        ratios = errors / deviations
        limit = max(FAR, float(np.sort(ratios[trusted])[-1 - int(MOST_AT_ONCE * count)]))
        following = ratios <= limit
        if (following == trusted).all():
            break
        if following.sum() < (1.0 - MOST) * count:
            finding = f"more than {MOST:.0%} of the landmarks are not predicted by the others"
            return Outliers((), errors, finding)
        trusted = following
    order = np.argsort(-errors, kind="stable")
    return Outliers(tuple(int(k) for k in order if not trusted[k]), errors)


def _predicted(matching: Matching, trusted: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of all landmarks in pixels, predicted by the other trusted ones, and their standard deviations."""
    pairs, alignment, whole = matching.pairs, matching.realigned(trusted), matching.covariance
    displacements = alignment.apply(pairs.moving) - pairs.fixed
    linear = Linear(whole[np.ix_(trusted, trusted)], displacements[trusted], alignment.parameters)
    ridge = linear.by_cross_validation()
    precision = linear.precision(ridge)
    errors, spread = np.empty(len(pairs)), np.empty(len(pairs))
    pulls = precision @ displacements[trusted]
    own = np.diag(precision)
    errors[trusted], spread[trusted] = np.linalg.norm(pulls, axis=1) / own, own**-0.5
    across = whole[np.ix_(~trusted, trusted)]
    errors[~trusted] = np.linalg.norm(displacements[~trusted] - across @ pulls, axis=1)
    explained = np.einsum("ij,jk,ik->i", across, precision, across)
    spread[~trusted] = np.sqrt(np.maximum(np.diag(whole)[~trusted] + ridge - explained, ridge))
    ratios = errors[trusted] / spread[trusted]
    wide = np.quantile(ratios, TAIL) / typical_distance(pairs.dimension, TAIL)
    typical = float(np.median(ratios)) / typical_distance(pairs.dimension)
    scale = max(typical, float(wide), LEAST_ERROR * matching.pixel / float(np.median(spread)))
    return errors, scale * spread
