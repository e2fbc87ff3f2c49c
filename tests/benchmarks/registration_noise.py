"""Errors of landmarks, measured: sigma, outliers, near duplicates, certificates; beside scikit-image's thin plate.

    python tests/benchmarks/registration_noise.py [noise rough outliers certificates] [--repeat R]

`noise` registers known warps of 512 x 512 pixels by 20 to 200 landmarks with errors of 1, 3 and 10 pixels, with the
true sigma and with an estimated one; errors of maps are root mean squares over the image, medians of R warps, beside
scipy's smoothing thin-plate spline with residuals of the same standard deviation, and scikit-image's exact one.
`rough` estimates errors of landmarks in random fields of known covariance, beside the Cramer-Rao bound of one who
knows it. `outliers` plants 20 of 200. `certificates` times proof, every pixel and the positions that a warp needs, on
1024 x 1024 pixels. The extra `bench` has what this needs.

Of 20 landmarks with errors of 1, 3 and 10 pixels, an estimate by one who knew the covariance of the warps would have
0.34, 0.23 and 0.17 for the standard deviation of its logarithm, by the Cramer-Rao bound, so that 76, 92 and 98 percent
are expected within a factor of 1.5.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from itertools import product
from math import erf
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from scipy.interpolate import RBFInterpolator
from skimage.transform import ThinPlateSplineTransform

sys.path.insert(0, str(Path(__file__).parents[1] / "registration"))
from noisy_landmarks import SIDE, known_warp, misplaced, noisy_pairs

from codegen.registration import register
from codegen.registration.certificate import certify, certify_with_positions
from codegen.registration.grid import coarse_grid
from codegen.registration.noise import find_outliers, likely_sigma
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.warp import sources

SHAPE = (SIDE, SIDE)
GRID = coarse_grid(SHAPE, 25)


def distance(function: Any, seed: int) -> float:
    """The root mean square distance of a map from the known warp."""
    return float(np.sqrt(((function(GRID) - known_warp(seed)(GRID)) ** 2).sum(axis=1).mean()))


def smoothed_plate(pairs: LandmarkPairs, deviation: float) -> Any:
    """scipy's smoothing thin-plate spline whose residuals have a given standard deviation."""
    low, high = -6.0, 12.0  # logarithms of the smoothing, with which residuals grow
    for _ in range(40):
        middle = 0.5 * (low + high)
        plate = RBFInterpolator(pairs.moving, pairs.fixed, kernel="thin_plate_spline", smoothing=10.0**middle)
        residuals = np.sqrt(((plate(pairs.moving) - pairs.fixed) ** 2).mean())
        low, high = (middle, high) if residuals < deviation else (low, middle)
    return plate


def noise(repeat: int) -> None:
    """Residuals, estimates, errors of maps, solves and seconds."""
    print("landmarks noise | residual/sigma: median | auto/noise: median, range, within 1.5 | "
          "error of map, px: sigma, thin plate of the same residuals, auto, thin plate of those, exact one | solves "
          "most | seconds")  # fmt: skip
    for count in (20, 80, 200):
        for size in (1.0, 3.0, 10.0):
            table = np.array([_noise_of(count, size, seed) for seed in range(repeat)])
            middle, ratios = np.median(table, axis=0), table[:, 1]
            within = ((ratios > 1.0 / 1.5) & (ratios < 1.5)).mean()
            errors = " ".join(f"{value:.2f}" for value in middle[2:7])
            print(f"{count:4d} {size:4.0f} | {table[:, 0].min():.2f}-{table[:, 0].max():.2f}: {middle[0]:.2f} | "
                  f"{middle[1]:.2f}, {ratios.min():.2f}-{ratios.max():.2f}, {within:.0%} | {errors} | "
                  f"{table[:, 7].max():.0f} | {middle[8]:.2f}", flush=True)  # fmt: skip


def _noise_of(count: int, size: float, seed: int) -> list[float]:
    """One row of `noise`."""
    pairs = noisy_pairs(count, size, seed)
    begin = perf_counter()
    given = register(pairs, SHAPE, sigma=size)
    seconds = perf_counter() - begin
    auto = register(pairs, SHAPE, sigma="auto")
    deviations = [float(np.sqrt((found.residuals**2).mean() / 2.0)) for found in (given, auto)]
    plates = [smoothed_plate(pairs, deviation) for deviation in deviations]
    exact = ThinPlateSplineTransform.from_estimate(pairs.moving, pairs.fixed)
    maps = (given.map_points, plates[0], auto.map_points, plates[1], exact)
    solves = max(given.solves, auto.solves)
    errors = [distance(function, seed) for function in maps]
    return [deviations[0] / size, auto.sigma / size, *errors, solves, seconds]


def gaussian_field(places: Any, logarithms: Any) -> Any:
    """The covariance of displacements: errors, and a Gaussian field with a size and a length."""
    errors, field, squared_length = np.exp(logarithms)
    squares = ((places[:, None] - places) ** 2).sum(axis=-1)
    return errors * np.eye(len(places)) + field * np.exp(-squares / (2.0 * squared_length))


def bound_of_logarithm(places: Any, logarithms: Any) -> float:
    """The least standard deviation of log(sigma), by Cramer and Rao, of who knows the kind of field."""
    trend = np.hstack([np.ones((len(places), 1)), places - places.mean(axis=0)])
    free = np.linalg.qr(trend, mode="complete")[0][:, trend.shape[1] :]
    inverse = np.linalg.inv(free.T @ gaussian_field(places, logarithms) @ free)
    slopes = [
        free.T @ (gaussian_field(places, logarithms + d) - gaussian_field(places, logarithms - d)) @ free / 2e-5
        for d in 1e-5 * np.eye(3)
    ]
    # Of two coordinates, of which each has half the trace for its information.
    information = np.array([[np.trace(inverse @ a @ inverse @ b) for b in slopes] for a in slopes])
    return float(np.sqrt(np.linalg.inv(information)[0, 0])) / 2.0


def rough(repeat: int) -> None:
    """Displacements of 12 pixels that change within a length, on 512 x 512 pixels."""
    print("landmarks length noise | unpredictable, px | bound of log(sigma), within 1.5 by it | auto/noise, within 1.5")
    for count, length, size in product((20, 80), (60.0, 100.0, 150.0), (1.0, 3.0)):
        rows = np.array([_rough(count, length, size, seed) for seed in range(repeat)])
        unknown, bound, found = np.median(rows, axis=0)
        expected, share = erf(np.log(1.5) / bound / np.sqrt(2.0)), (np.abs(np.log(rows[:, 2])) < np.log(1.5)).mean()
        said = f"{unknown:5.2f} | {bound:.2f}, {expected:.0%} | {found:.2f}, {share:.0%}"
        print(f"{count:4d} {length:4.0f} {size:3.0f} | {said}", flush=True)


def _rough(count: int, length: float, size: float, seed: int) -> tuple[float, float, float]:
    """What of the field others do not predict at a landmark, the bound, and the estimate by the truth."""
    generator = np.random.default_rng(seed)
    places, logarithms = generator.uniform(0.05, 0.95, (count, 2)) * SIDE, np.log([size**2, 144.0, length**2])
    whole = gaussian_field(places, logarithms)
    exact = np.linalg.inv(whole - (size**2 - 1e-6) * np.eye(count))
    found = likely_sigma(places, np.linalg.cholesky(whole) @ generator.normal(size=(count, 2))).sigma
    return float(np.median(np.diag(exact) ** -0.5)), bound_of_logarithm(places, logarithms), found / size


def outliers(repeat: int) -> None:
    """Planted landmarks that are found, and others that are named."""
    print("noise | found of 20, least | others, most")
    for size in (0.0, 0.3, 1.0, 2.0, 3.0):
        found, others = [], []
        for seed in range(repeat):
            pairs, planted = misplaced(noisy_pairs(200, size, seed), 20, seed)
            named = set(find_outliers(pairs, SHAPE).numbers)
            found.append(len(named & planted))
            others.append(len(named - planted))
        print(f"{size:4.1f} | {min(found)} | {max(others)}", flush=True)


def certificates(repeat: int) -> None:
    """Seconds of the proof, of all pixels, and of positions, exact and from a coarse grid."""
    print("landmarks | solve | proof | every pixel | positions exact, coarse | proved | least det J by both")
    shape = (2 * SIDE, 2 * SIDE)
    for count in (40, 500):
        small = noisy_pairs(count, 0.0, 4)
        pairs, seconds = LandmarkPairs(2.0 * small.moving, 2.0 * small.fixed), [perf_counter()]
        found = register(pairs, shape)
        certify(found)
        seconds = [perf_counter()]
        found = register(pairs, shape)
        seconds.append(perf_counter())
        proof = certify(found)
        seconds.append(perf_counter())
        every = certify_with_positions(found)[0]
        seconds.append(perf_counter())
        sources(found, shape)
        seconds.append(perf_counter())
        sources(found, shape, spacing="auto")
        seconds.append(perf_counter())
        spent = " | ".join(f"{value:.2f}" for value in np.diff(seconds))
        print(f"{count} | {spent} | {proof.proved} | {proof.det_min:.6f} {every.det_min:.6f}", flush=True)


PARTS = {"noise": noise, "rough": rough, "outliers": outliers, "certificates": certificates}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=list(PARTS))
    parser.add_argument("--repeat", type=int, default=20)
    arguments = parser.parse_args()
    for part in arguments.parts:
        PARTS[part](arguments.repeat)
