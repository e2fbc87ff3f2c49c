"""Errors of landmarks: robust losses, the standard deviation of errors by restricted likelihood, and outliers.

Standard deviation: displacements are the sum of an affine trend, a smooth Gaussian field and errors of equal variance.
Without the trend they have a restricted likelihood (Patterson and Thompson 1971, Biometrika 58(3)), from which the
variance of the field is eliminated. With few landmarks the likelihood is often largest for zero errors. Therefore the
estimate is the mean variance, with uniform priors for the standard deviation of errors (Gelman 2006, Bayesian Analysis
1(3)) and for the correlation length of the field.

The covariance of the field is 1/(1 + r^2/(2 l^2)), a mixture of Gaussian covariances of all lengths about l (Rasmussen
and Williams 2006, Gaussian Processes for Machine Learning, equation 4.19). The Green's function of the maps would
attribute a part of the deformation to errors, since it is rougher than most deformations. Lengths l are at least the
distance between landmarks: shorter variations cannot be distinguished from errors.

Outliers: the linear theory predicts each landmark from the other trusted landmarks. A landmark is an outlier if its
prediction error is far larger than the errors and distances of its neighbours explain. The test is repeated without the
outliers until nothing changes, and solves no flow. Masking is rare, because outliers are never trusted.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist, squareform
from scipy.stats import chi

from codegen.errors import ArgumentError, LandmarkError
from codegen.registration.grid import Extent
from codegen.registration.linear import Linear
from codegen.registration.matching import Matching
from codegen.registration.pairs import Kind, LandmarkPairs

Loss: TypeAlias = Literal["linear", "huber", "cauchy", "tukey"]
LOSSES: tuple[Loss, ...] = ("linear", "huber", "cauchy", "tukey")
LEAST = 1e-6  # the least weight of a landmark, so that every landmark has a determined position in the flow


def typical_distance(dimension: int, share: float = 0.5) -> float:
    """Return the quantile `share` of the norm of a standard normal vector (Rayleigh or Maxwell distribution)."""
    return float(np.sqrt(-2.0 * np.log(1.0 - share)) if dimension == 2 else chi.ppf(share, dimension))


def weights_of(loss: Loss, distances: NDArray[np.float64], dimension: int = 2) -> NDArray[np.float64]:
    """Return weights of iteratively reweighted least squares for residual distances in units of sigma, shape (n,).

    Tuning constants are the usual constants (Holland and Welsch 1977, Commun. Stat. A 6(9)) times the square root of
    the dimension. Raises ArgumentError for an unknown loss.
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
    """Estimate the standard deviation of a coordinate from residual distances; robust losses use their median."""
    if loss == "linear":
        return float(np.sqrt((distances**2).mean() / dimension))
    return float(np.median(distances) / typical_distance(dimension))


OUTLIERS_FEWEST = 8  # fewest landmarks among which outliers are searched
FAR = 4.0  # least error of an outlier, in units of its standard deviation: one landmark in 3000 exceeds it by chance
LEAST_ERROR = 0.5  # the least standard deviation that is assumed for an error, in pixels
MOST_AT_ONCE = 0.1
"""The largest share of landmarks that become outliers in one round: the landmarks with the largest errors."""
MOST = 1.0 / 3.0  # the largest share of outliers; above it landmarks contradict each other, and no outlier is named
ROUNDS = 30
TAIL = 0.8  # the quantile of errors that raises the scale of errors if large errors are frequent


@dataclass(frozen=True, eq=False)
class Outliers:
    """The numbers of the outliers, counted from zero and sorted by decreasing errors, and the errors of all landmarks.

    `errors`, shape (n,), are distances between predicted and given landmarks, in pixels of the fixed image. `message`
    is the reason if no outliers could be determined.
    """

    numbers: tuple[int, ...]
    errors: NDArray[np.float64]
    message: str = ""


def find_outliers(
    pairs: LandmarkPairs, shape: Extent, *, fixed_shape: Extent | None = None, align: Kind = "similarity"
) -> Outliers:
    """Search for outliers among the landmarks.

    Parameters
    ----------
    pairs : LandmarkPairs
        The landmarks.
    shape : sequence of int or Grid
        The shape or grid of the moving image, as in `register`.
    fixed_shape : sequence of int or Grid, optional
        The shape or grid of the fixed image if it differs.
    align : {"none", "similarity", "affine"}
        The alignment before the flow.

    Returns
    -------
    Outliers
        The outliers and the errors of all landmarks.

    Raises
    ------
    LandmarkError
        If the landmarks cannot be used.
    """
    return outliers_of(Matching.of(pairs, shape, fixed_shape=fixed_shape, align=align))


def outliers_of(matching: Matching) -> Outliers:
    """Search for outliers among the landmarks of a matching, with its frame and kind of alignment."""
    count = len(matching.pairs)
    if count < OUTLIERS_FEWEST:
        return Outliers(
            (), np.full(count, np.nan), f"fewer than {OUTLIERS_FEWEST} landmarks do not tell which is out of place"
        )
    pairs, whole, trusted = matching.pairs, matching.covariance, np.ones(count, dtype=bool)
    for _ in range(ROUNDS):
        # Errors of the predictions by the other trusted landmarks, in pixels, and standard deviations of errors.
        alignment = matching.realigned(trusted)
        displacements = alignment.apply(pairs.moving) - pairs.fixed
        linear = Linear(whole[np.ix_(trusted, trusted)], displacements[trusted], alignment.parameters)
        ridge = linear.by_cross_validation()
        precision = linear.precision(ridge)
        errors, spread = np.empty(count), np.empty(count)
        pulls, diagonal = precision @ displacements[trusted], np.diag(precision)
        errors[trusted], spread[trusted] = np.linalg.norm(pulls, axis=1) / diagonal, diagonal**-0.5
        across = whole[np.ix_(~trusted, trusted)]
        errors[~trusted] = np.linalg.norm(displacements[~trusted] - across @ pulls, axis=1)
        explained = np.einsum("ij,jk,ik->i", across, precision, across)
        spread[~trusted] = np.sqrt(np.maximum(np.diag(whole)[~trusted] + ridge - explained, ridge))
        ratios = errors[trusted] / spread[trusted]
        wide = np.quantile(ratios, TAIL) / typical_distance(pairs.dimension, TAIL)
        typical = float(np.median(ratios)) / typical_distance(pairs.dimension)
        scale = max(typical, float(wide), LEAST_ERROR * matching.fixed_grid.pixel / float(np.median(spread)))
        ratios = errors / (scale * spread)
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


LONGEST, STEP = 4.0, np.sqrt(2.0)
"""Longest correlation length of the field, in units of the landmarks' radius, and ratio of successive lengths."""
RATIOS = np.logspace(-8.0, 2.0, 401)
"""Variances of errors that are compared, in units of the largest eigenvalue of the covariance of the field."""
BLOCK = 500
"""Most landmarks in a block; more landmarks are halved repeatedly into blocks, which are treated as independent."""
NOTHING = 1e-9  # displacements below this fraction of the radius of the landmarks are rounding errors

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LikelySigma:
    """The standard deviation of errors in pixels, and the bounds `low` and `high` of its 68 percent interval.

    `may_be_zero` is True if the smallest standard deviation has the largest likelihood.
    """

    sigma: float
    low: float
    high: float
    may_be_zero: bool


def likely_sigma(places: Array, displacements: Array) -> LikelySigma:
    """Estimate the standard deviation of errors in `displacements` at `places`, both (n, d) in pixels with n >= 4."""
    blocks = []
    for k in _blocks(places):
        # Displacements without the trend: data in an orthonormal basis of the complement of the trend.
        trend = np.ones((len(k), 1))
        if len(k) >= 2 * (places.shape[1] + 1):  # an affine map would follow the errors of fewer landmarks
            trend = np.hstack([trend, places[k] - places[k].mean(axis=0)])
        basis = np.linalg.qr(trend, mode="complete")[0][:, trend.shape[1] :]
        blocks.append((squareform(pdist(places[k], "sqeuclidean")), basis, basis.T @ displacements[k]))
    radius = float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))
    if max(float(np.abs(data).max()) for _, _, data in blocks) <= NOTHING * radius:
        return LikelySigma(0.0, 0.0, 0.0, True)
    count, dimension = places.shape
    # The distance of landmarks that fill a square or a cube of this radius.
    distance = np.sqrt(12.0 / dimension) * radius / count ** (1.0 / dimension)
    number = 1 + int(np.log(LONGEST * radius / distance) / np.log(STEP))
    lengths, curves = np.asarray(distance * STEP ** np.arange(number)), []
    for length in lengths:
        # Standard deviations of errors, and logarithms of their likelihoods, for one length of the field.
        eigenvalues, squared = [], []
        for squares, basis, data in blocks:
            covariance = 1.0 / (1.0 + squares / (2.0 * length**2))
            values, vectors = np.linalg.eigh(basis.T @ covariance @ basis)
            eigenvalues.append(np.maximum(values, 0.0))
            squared.append(((vectors.T @ data) ** 2).sum(axis=1))
        values = np.concatenate(eigenvalues)
        ratios = RATIOS * values.max()
        coordinates, variances = dimension * len(values), values + ratios[:, None]
        field = (np.concatenate(squared) / variances).sum(axis=1) / coordinates
        likelihoods = -0.5 * (coordinates * np.log(field) + dimension * np.log(variances).sum(axis=1))
        curves.append((np.sqrt(field * ratios), likelihoods))
    sigmas, logarithms = (np.array(parts) for parts in zip(*curves, strict=True))
    weights = np.exp(logarithms - logarithms.max()) * np.gradient(sigmas, axis=1) * (lengths / lengths[0])[:, None]
    sigma = float(np.sqrt((weights * sigmas**2).sum() / weights.sum()))
    order, flat = np.argsort(sigmas, axis=None), weights.ravel()
    below = np.cumsum(flat[order]) - 0.5 * flat[order]
    low, high = map(float, np.interp([0.16, 0.84], below / flat.sum(), sigmas.ravel()[order]))
    return LikelySigma(sigma, low, high, bool(np.argmax(logarithms) % len(RATIOS) == 0))


def _blocks(places: Array) -> list[NDArray[np.intp]]:
    """Divide points, shape (n, d), into blocks of at most `BLOCK` by halving the longest extent; return indices."""
    blocks, waiting = list[NDArray[np.intp]](), [np.arange(len(places))]
    while waiting:
        block = waiting.pop()
        if len(block) <= BLOCK:
            blocks.append(block)
            continue
        axis = int(np.argmax(np.ptp(places[block], axis=0)))
        block = block[np.argsort(places[block, axis], kind="stable")]
        waiting += [block[: len(block) // 2], block[len(block) // 2 :]]
    return blocks


FEWEST = 4  # fewest landmarks whose errors can be estimated
FEW = 15  # fewest landmarks for an estimate without a warning of its uncertainty
UNSURE = 1.5  # the factor by which a bound of the 68 percent interval may differ from its middle without a warning
LARGE = 0.1  # errors above this fraction of the spread of the landmarks are implausible


@dataclass(frozen=True)
class SigmaEstimate:
    """The standard deviation of the errors of landmarks in pixels, and a warning if it is doubtful."""

    sigma: float
    message: str = ""


def estimate_sigma(pairs: LandmarkPairs, shape: Extent, **options: Any) -> SigmaEstimate:
    """Estimate the standard deviation of the errors of landmarks from the differences between neighbours.

    Parameters
    ----------
    pairs : LandmarkPairs
        The landmarks; outliers are ignored.
    shape : sequence of int or Grid
        The shape or grid of the moving image, as in `register`.
    **options
        Other arguments of `Matching.of`. Any `align` other than "affine" is replaced by "similarity".

    Returns
    -------
    SigmaEstimate
        The standard deviation of a coordinate, in pixels of the fixed image.

    Raises
    ------
    LandmarkError
        For fewer than four landmarks.

    Notes
    -----
    Displacements after the alignment are a smooth field plus errors; see `codegen.registration.noise`.
    """
    if options.get("align") != "affine":
        options = {**options, "align": "similarity"}
    matching = Matching.of(pairs, shape, **options)
    if len(pairs) < FEWEST:
        raise LandmarkError(
            f"{len(pairs)} landmarks do not tell how large their errors are",
            f"give a sigma in {matching.fixed_grid.unit}",
        )
    outliers = outliers_of(matching)
    trusted = np.ones(len(pairs), dtype=bool)
    trusted[list(outliers.numbers)] = False
    places = matching.realigned(trusted).apply(pairs.moving)[trusted]
    likely = likely_sigma(places, places - pairs.fixed[trusted])
    spread = float(np.sqrt(((pairs.fixed - pairs.fixed.mean(axis=0)) ** 2).mean()))
    sigma, unit, warning = likely.sigma, matching.fixed_grid.unit, ""
    if sigma > LARGE * spread:
        finding = f"sigma of {sigma:.3g} {unit} is implausible: {sigma / spread:.0%} of the landmarks' spread"
        warning = f"{finding}; {outliers.message or 'look for landmarks out of place'}"
    elif likely.may_be_zero:
        finding = "the landmarks show no errors that could be told from a deformation"
        warning = f"{finding}; sigma is hardly above {likely.high:.2g} {unit}"
    elif len(places) < FEW or likely.high > UNSURE**2 * likely.low:
        interval = f"{likely.low:.2g} to {likely.high:.2g} {unit}"
        warning = f"of {len(places)} landmarks alone, sigma is uncertain: {interval}"
    return SigmaEstimate(sigma, warning)


def choose_sigma(pairs: LandmarkPairs, shape: Extent, **options: Any) -> float:
    """Return the sigma of `estimate_sigma`, in pixels, with the same arguments and errors."""
    return estimate_sigma(pairs, shape, **options).sigma
