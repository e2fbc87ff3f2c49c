"""Losses: how much a landmark that misses by many sigmas may still pull."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi

from codegen.errors import ArgumentError

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
