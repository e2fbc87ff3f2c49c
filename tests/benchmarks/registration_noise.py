"""Errors of landmarks, measured: sigma, outliers, near duplicates, certificates; beside scikit-image's thin plate.

    python tests/benchmarks/registration_noise.py [noise outliers certificates] [--repeat R]

`noise` registers known warps of 512 x 512 pixels by 20 to 200 landmarks with errors of 1, 3 and 10 pixels, with the
true sigma and with an estimated one; errors of maps are root mean squares over the image, medians of R warps.
`outliers` plants 20 of 200. `certificates` times proof, every pixel and the positions that a warp needs, on 1024 x 1024
pixels. The thin plate is exact: scikit-image has no smoothing one. The extra `bench` has what this needs.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from skimage.transform import ThinPlateSplineTransform

sys.path.insert(0, str(Path(__file__).parents[1] / "registration"))
from noisy_landmarks import SIDE, known_warp, misplaced, noisy_pairs

from codegen.registration import LandmarkPairs, certify, find_outliers, register
from codegen.registration.certificate import certify_with_positions
from codegen.registration.frame import coarse_grid
from codegen.registration.warp import sources

SHAPE = (SIDE, SIDE)
GRID = coarse_grid(SHAPE, 25)


def distance(function: Any, seed: int) -> float:
    """The root mean square distance of a map from the known warp."""
    return float(np.sqrt(((function(GRID) - known_warp(seed)(GRID)) ** 2).sum(axis=1).mean()))


def noise(repeat: int) -> None:
    """Residuals, estimates, errors of maps, solves and seconds."""
    print("landmarks noise | residual/sigma | auto/noise | error: sigma auto, thin plate | solves most | seconds")
    for count in (20, 80, 200):
        for size in (1.0, 3.0, 10.0):
            rows = []
            for seed in range(repeat):
                pairs = noisy_pairs(count, size, seed)
                begin = perf_counter()
                given = register(pairs, SHAPE, sigma=size)
                seconds = perf_counter() - begin
                auto = register(pairs, SHAPE, sigma="auto")
                deviation = np.sqrt((given.residuals**2).mean() / 2.0) / size
                plate = ThinPlateSplineTransform.from_estimate(pairs.moving, pairs.fixed)
                errors = [distance(f, seed) for f in (given.map_points, auto.map_points, plate)]
                rows.append([deviation, auto.sigma / size, *errors, max(given.solves, auto.solves), seconds])
            table = np.array(rows)
            middle = np.median(table, axis=0)
            print(f"{count:4d} {size:4.0f} | {table[:, 0].min():.2f}-{table[:, 0].max():.2f} | "
                  f"{table[:, 1].min():.2f}-{table[:, 1].max():.2f} | "
                  f"{middle[2]:.2f} {middle[3]:.2f} thin plate {middle[4]:.2f} | {table[:, 5].max():.0f} | "
                  f"{middle[6]:.2f}", flush=True)  # fmt: skip


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


PARTS = {"noise": noise, "outliers": outliers, "certificates": certificates}

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], default=list(PARTS))
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    for part in arguments.parts:
        PARTS[part](arguments.repeat)
