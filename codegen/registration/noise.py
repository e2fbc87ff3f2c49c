"""How large the errors of landmarks are, by their restricted likelihood, and whether that is plausible.

How large the errors of landmarks are, by their restricted likelihood: what near landmarks do not share. Displacements
are taken for an affine trend, a smooth Gaussian field and errors of one variance. What is left without the trend has a
likelihood (Patterson and Thompson 1971, Biometrika 58(3)) in which the field's variance is eliminated. With few
landmarks its maximum is often at no errors; therefore the estimate is the mean variance, when all standard deviations
of errors (Gelman 2006, Bayesian Analysis 1(3)) and all lengths of the field are equally likely before.

The field's covariance is 1/(1 + r^2/(2 l^2)), a mixture of Gaussian ones of all lengths about l (Rasmussen and Williams
2006, Gaussian Processes for Machine Learning, equation 4.19). The Green's function of the maps is rougher than what
deforms most images, and takes part of the deformation for errors. Lengths l are at least the distance of landmarks: of
what changes from each landmark to the next nobody can tell whether it is an error.

Landmarks out of place: which of them the others, by what is smooth about them, do not predict. Each landmark is
predicted by the linear theory from those that are trusted; one whose error is far above what its neighbours' errors and
its distance from them explain is an outlier, and no longer predicts others. This goes on until nothing changes. It
needs no solve of a flow, and masks are rare because nothing is trusted that stood out.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import pdist, squareform
from scipy.stats import chi

from codegen.errors import ArgumentError, LandmarkError
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


OUTLIERS_FEWEST = 8
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
    if count < OUTLIERS_FEWEST:
        return Outliers(
            (), np.full(count, np.nan), f"fewer than {OUTLIERS_FEWEST} landmarks do not tell which is out of place"
        )
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


LONGEST, STEP = 4.0, np.sqrt(2.0)
"""The longest length in units of the landmarks' radius, and the ratio of one length to the next."""
RATIOS = np.logspace(-8.0, 2.0, 401)
"""Variances of errors that are compared, in units of the largest eigenvalue of the field's covariance."""
BLOCK = 500
"""Of more landmarks, those of either half of the image are taken for independent of the others, and so on."""
NOTHING = 1e-9
"""Displacements that are a smaller share of the landmarks' radius are rounding."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LikelySigma:
    """The standard deviation of errors in pixels, and the range in which it is with a probability of 68 percent.

    Where the least that was compared is the likeliest, it `may_be_zero`.
    """

    sigma: float
    low: float
    high: float
    may_be_zero: bool


def likely_sigma(places: Array, displacements: Array) -> LikelySigma:
    """The errors of displacements at places, both of shape (n, d) in pixels, of at least four landmarks."""
    blocks = [_Block.of(places[k], displacements[k]) for k in _blocks(places)]
    if max(float(np.abs(block.data).max()) for block in blocks) <= NOTHING * _radius(places):
        return LikelySigma(0.0, 0.0, 0.0, True)
    # The lengths of fields that are compared, in pixels.
    count, dimension = places.shape
    # A square or cube with this radius has this side, and its landmarks this distance from each other.
    distance = np.sqrt(12.0 / dimension) * _radius(places) / count ** (1.0 / dimension)
    number = 1 + int(np.log(LONGEST * _radius(places) / distance) / np.log(STEP))
    lengths = np.asarray(distance * STEP ** np.arange(number))
    curves = np.array([_curve(blocks, length) for length in lengths])
    sigmas, logarithms = curves[:, 0], curves[:, 1]
    weights = np.exp(logarithms - logarithms.max()) * np.gradient(sigmas, axis=1) * (lengths / lengths[0])[:, None]
    sigma = float(np.sqrt((weights * sigmas**2).sum() / weights.sum()))
    low, high = _quantiles(sigmas.ravel(), weights.ravel(), [0.16, 0.84])
    return LikelySigma(sigma, low, high, bool(np.argmax(logarithms) % len(RATIOS) == 0))


def _quantiles(values: Array, weights: Array, shares: list[float]) -> list[float]:
    """The values below which are shares of the weight."""
    order = np.argsort(values)
    below = np.cumsum(weights[order]) - 0.5 * weights[order]
    return [float(value) for value in np.interp(shares, below / weights.sum(), values[order])]


@dataclass(frozen=True, eq=False)
class _Block:
    """Landmarks without their trend: an orthonormal basis of what is free of it, shape (n, m), and the data, (m, d).

    `squares` are squared distances, shape (n, n).
    """

    squares: Array
    basis: Array
    data: Array

    @classmethod
    def of(cls, places: Array, displacements: Array) -> _Block:
        count, dimension = places.shape
        trend = np.ones((count, 1))
        if count >= 2 * (dimension + 1):  # fewer say more of their errors if they are not fitted by an affine map
            trend = np.hstack([trend, places - places.mean(axis=0)])
        basis = np.linalg.qr(trend, mode="complete")[0][:, trend.shape[1] :]
        return cls(squareform(pdist(places, "sqeuclidean")), basis, basis.T @ displacements)

    def parts(self, length: float) -> tuple[Array, Array]:
        """Eigenvalues of the field's covariance, and squares of the data along its eigenvectors, shape (m,)."""
        covariance = 1.0 / (1.0 + self.squares / (2.0 * length**2))
        values, vectors = np.linalg.eigh(self.basis.T @ covariance @ self.basis)
        return np.maximum(values, 0.0), ((vectors.T @ self.data) ** 2).sum(axis=1)


def _curve(blocks: list[_Block], length: float) -> tuple[Array, Array]:
    """Standard deviations of errors, and logarithms of their likelihoods, for a field of some length."""
    values, squares = (np.concatenate(part) for part in zip(*(b.parts(length) for b in blocks), strict=True))
    ratios = RATIOS * values.max()
    dimension = blocks[0].data.shape[1]
    count = dimension * len(values)
    variances = values + ratios[:, None]
    field = (squares / variances).sum(axis=1) / count
    logarithms = -0.5 * (count * np.log(field) + dimension * np.log(variances).sum(axis=1))
    return np.sqrt(field * ratios), logarithms


def _radius(places: Array) -> float:
    return float(np.sqrt(((places - places.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _blocks(places: Array) -> list[NDArray[np.intp]]:
    """The numbers of landmarks in blocks of at most `BLOCK`, by halves of the longest extent."""
    found, waiting = list[NDArray[np.intp]](), [np.arange(len(places))]
    while waiting:
        block = waiting.pop()
        if len(block) <= BLOCK:
            found.append(block)
            continue
        axis = int(np.argmax(np.ptp(places[block], axis=0)))
        block = block[np.argsort(places[block, axis], kind="stable")]
        waiting += [block[: len(block) // 2], block[len(block) // 2 :]]
    return found


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
