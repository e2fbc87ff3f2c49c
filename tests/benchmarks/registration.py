"""Registration, measured: folding, speed, dragging; beside scikit-image's thin-plate spline.

    python tests/benchmarks/registration.py [folding speed drag hard large first] [--pairs P] [--repeat R]

`folding` maps the landmarks of data/trilobite40.csv and P random pairs of the trilobite cephala of the package ktch,
and counts the pixels at which each map folds. `speed` warps 1024 x 1024 pixels by 40 landmarks, `drag` moves one of 20
landmarks on a preview of 512 x 512 pixels. `hard` takes up to 2000 landmarks, turns, swaps and permutations, and looks
for folds by differences of places. `large` runs the command on 8000 x 6000 pixels, and scikit-image's spline on
what fits into memory; `first` runs it with an empty cache. The extra `bench` has what this needs. Times are wall clock,
of `speed` and `drag` the best of R warm runs, with the time of all processors in brackets.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import platform
import warnings
from collections.abc import Callable
from importlib.metadata import version
from time import perf_counter, process_time
from typing import Any

import numpy as np
from particles import TRILOBITES, aligned, specimens
from planar_maps import CONSOLE, determinants_by_differences, in_pixels
from registration_hard import hard
from registration_large import first, large
from rich.table import Table
from skimage.transform import ThinPlateSplineTransform
from skimage.transform import warp as skimage_warp

from codegen.errors import RegistrationError
from codegen.problem.points import PointSet, read_points
from codegen.registration import register
from codegen.registration.certificate import certify
from codegen.registration.grid import coarse_grid, pixel_grid
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.warp import sources, warp_reported

SIDE = 128
"""Pixels along an image on which folding is looked for."""


def thin_plate(pairs: LandmarkPairs) -> Any:
    """scikit-image's thin-plate spline from the moving to the fixed landmarks."""
    return ThinPlateSplineTransform.from_estimate(pairs.moving, pairs.fixed)


def folding(count: int, repeat: int) -> None:
    """Least determinants and folded pixels of both maps."""
    del repeat
    trilobites, everyone = read_points(TRILOBITES, 2), specimens()
    generator = np.random.default_rng(6)
    chosen = [generator.choice(len(everyone), 2, replace=False) for _ in range(count)]
    named = [("40 trilobite landmarks", trilobites)]
    named += [(f"specimens {i} and {j}", aligned(everyone[i], everyone[j])) for i, j in chosen]
    rows, unsolved = list[tuple[str, float, int, float, int, int, float, float]](), list[str]()
    for name, points in named:
        pairs = in_pixels(points, SIDE)
        try:
            found = register(pairs, (SIDE, SIDE), tolerance=0.05)
        except RegistrationError as error:
            unsolved.append(name)
            CONSOLE.print(f"{name}: {error}")
            continue
        ours, theirs = certify(found), determinants_by_differences(thin_plate(pairs), pixel_grid((SIDE, SIDE)))
        folded = int((theirs <= 0.0).sum())
        rows.append((name, ours.det_min, ours.folded, theirs.min(), folded, found.steps, ours.round_trip, found.error))
        CONSOLE.print(f"{len(rows)}/{len(named)} {name}: det J {ours.det_min:.4f}, thin plate {theirs.min():.4f}, "
                      f"{found.steps} steps")  # fmt: skip
    shown = Table("pairs", "least det J", "folded maps", "folded pixels", "thin plate: least det J", "folded maps",
                  "folded share of pixels", title=f"{SIDE} x {SIDE} pixels")  # fmt: skip
    for name, part in ((rows[0][0], rows[:1]), (f"{len(rows) - 1} random pairs of ktch", rows[1:])):
        least, spline = min(row[1] for row in part), min(row[3] for row in part)
        share = sum(row[4] for row in part) / len(part) / SIDE**2
        shown.add_row(
            name, f"{least:.4f}", str(sum(row[2] > 0 for row in part)), str(sum(row[2] for row in part)),
            f"{spline:.4f}", str(sum(row[4] > 0 for row in part)), f"{share:.3%}",
        )  # fmt: skip
    CONSOLE.print(shown)
    CONSOLE.print(f"no motion was found for {len(unsolved)} pairs {', '.join(unsolved)}")
    steps, trips = [row[5] for row in rows], [row[6] for row in rows]
    CONSOLE.print(f"steps chosen: {min(steps)} to {max(steps)}, median {np.median(steps):g}")
    CONSOLE.print(f"estimated error of the maps at most {max(row[7] for row in rows):.4f} px")
    CONSOLE.print(f"round trip at most {max(trips):.1e} px")
    worst = sorted(rows, key=lambda row: row[3])[:3]
    for row in worst:
        CONSOLE.print(f"{row[0]}: thin plate folds {row[4]} pixels (det {row[3]:.3f}), ours none below {row[1]:.3f}")


def timed(run: Callable[[], Any], repeat: int) -> tuple[Any, float, float]:
    """The last result, and the least wall-clock time of several warm runs with its processor time."""
    result, best = run(), (np.inf, np.inf)
    for _ in range(repeat):
        begin, used = perf_counter(), process_time()
        result = run()
        best = min(best, (perf_counter() - begin, process_time() - used))
    return result, *best


def speed(count: int, repeat: int) -> None:
    """1024 x 1024 pixels, 40 landmarks, linear interpolation of 8 bits in one channel.

    The schemes' errors are distances from the map of 64 steps of rk4, the coarse grid's from all pixels exactly.
    """
    del count
    side = 1024
    pairs = in_pixels(read_points(TRILOBITES, 2), side)
    picture = (255 * np.random.default_rng(0).random((side, side))).astype(np.uint8)
    shown = Table("warp", "seconds", "(processors)", "largest error, px", "bound, px", "exact pixels",
                  title=f"{side} x {side} pixels, 40 landmarks")  # fmt: skip
    grid = coarse_grid((side, side), 65)
    converged = register(pairs, (side, side), steps=64).map_points_inverse(grid)
    for scheme, given in (("rk4", None), ("explicit-euler", 10), ("midpoint", 10)):
        found, seconds, used = timed(
            lambda s=scheme, n=given: register(pairs, (side, side), steps=n, scheme=s), repeat
        )  # fmt: skip
        name = f"{scheme}, N = {found.steps}" + (" (chosen)" if given is None else "")
        error = np.linalg.norm(found.map_points_inverse(grid) - converged, axis=1).max()
        shown.add_row(f"{name}: landmarks solved", f"{seconds:.3f}", f"({used:.3f})", f"{error:.1e}", "", "")
        exact = sources(found, (side, side)).places
        for way, spacing in (("all pixels exact", None), ("coarse grid", "auto")):
            (_, report), seconds, used = timed(
                lambda f=found, s=spacing: warp_reported(picture, f, spacing=s), repeat
            )  # fmt: skip
            error = np.linalg.norm(sources(found, (side, side), spacing=spacing).places - exact, axis=-1).max()
            way = f"{name}: {way}" + ("" if spacing is None else f", every {report.spacing} pixels")
            shown.add_row(
                way, f"{seconds:.3f}", f"({used:.3f})", f"{error:.1e}", f"{report.bound:.1e}", f"{report.exact:.1%}"
            )
    spline = ThinPlateSplineTransform.from_estimate(pairs.fixed, pairs.moving)
    _, seconds, used = timed(lambda: skimage_warp(picture, spline, order=1, preserve_range=True), min(repeat, 2))
    shown.add_row("scikit-image's thin-plate spline", f"{seconds:.3f}", f"({used:.3f})", "", "", "")
    CONSOLE.print(shown)


def drag(count: int, repeat: int) -> None:
    """Frames a second while one of 20 landmarks is dragged: registered from the frame before, then warped to 0.1 px."""
    del count
    side, frames = 512, 40
    points = read_points(TRILOBITES, 2)
    pairs = in_pixels(PointSet(points.start[::2], points.target[::2], points.sigma[::2]), side)
    shown = Table("preview", "frames a second", "slowest frame, s", "(processors, a frame)", "largest residual, px")
    for channels in (1, 3):
        picture = (255 * np.random.default_rng(0).random((side, side, channels))).astype(np.uint8)
        best = (0.0, 0.0, 0.0, 0.0)
        for _ in range(max(1, repeat // 2)):
            found, times, residual, used = register(pairs, (side, side)), list[float](), 0.0, process_time()
            for k in range(frames):
                fixed = pairs.fixed.copy()
                fixed[7] += 15.0 * np.array([np.sin(0.2 * k), 1.0 - np.cos(0.2 * k)])
                begin = perf_counter()
                moved = LandmarkPairs(pairs.moving, fixed)
                found = register(moved, (side, side), steps=found.steps, start=found)
                warp_reported(picture, found, spacing=8, bound=0.1)
                times.append(perf_counter() - begin)
                residual = max(residual, float(found.residuals.max()))
            used = (process_time() - used) / frames
            best = max(best, (frames / sum(times), max(times), used, residual))
        name = f"{side} x {side}, {channels} channel{'s' if channels > 1 else ''}"
        shown.add_row(name, f"{best[0]:.1f}", f"{best[1]:.3f}", f"({best[2]:.3f})", f"{best[3]:.1e}")
    CONSOLE.print(shown)


def environment() -> str:
    """The machine and the versions that times depend on."""
    libraries = ", ".join(f"{name} {version(name)}" for name in ("numpy", "scipy", "numba", "scikit-image"))
    machine = f"{os.cpu_count()} processors, {platform.machine()}, Python {platform.python_version()}"
    return f"{machine}, {libraries}; load {os.getloadavg()[0]:.1f}"


def main() -> None:
    """Run the named parts, or all."""
    parts: dict[str, Callable[[int, int], None]] = {f.__name__: f for f in (folding, speed, drag, hard, large, first)}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", choices=[*parts, []])
    parser.add_argument("--pairs", type=int, default=100)
    parser.add_argument("--repeat", type=int, default=5)
    chosen = parser.parse_args()
    warnings.simplefilter("ignore")
    CONSOLE.print(environment())
    for name in chosen.parts or parts:
        CONSOLE.rule(name)
        parts[name](chosen.pairs, chosen.repeat)


if __name__ == "__main__":
    main()
