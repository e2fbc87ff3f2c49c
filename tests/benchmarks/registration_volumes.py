"""Registration of volumes, measured: known maps, real volumes, labels, folds; beside SimpleITK and thin plates.

    python tests/benchmarks/registration_volumes.py [maps folds labels field noise size many hard] [--repeat R]

`maps` registers volumes by landmarks of a known map: a synthetic one, and what nibabel ships of brains (data of its
tests: anisotropic, and oblique). `folds` draws random pairs, whose displacements are no smooth map, and counts those
where the determinant of differences is not positive somewhere. `labels` compares labels. `field` reads displacement
fields with SimpleITK. `noise` adds known errors to landmarks. `size` runs the command on 256 x 256 x 256 voxels with
40 landmarks in a process of its own, and `many` batches of 1 to 8 volumes of 128 x 128 x 128, with the largest memory
of any process. `hard` are permutations, turns and near duplicates.

The thin plate is scipy's with the kernel r and an affine part, which is what ITK's ThinPlateSplineKernelTransform is in
space; SimpleITK itself has no thin plate, but fits a B-spline to landmarks (LandmarkBasedTransformInitializer, which
refuses landmarks of some oblique volumes and is given upright copies). Both map the fixed volume to the moving one, as
resampling needs it. Seconds are those of this run; ratios count.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
import SimpleITK as sitk
from known_volumes import (
    UPRIGHT,
    Map,
    Points,
    b_spline,
    brains,
    determinants,
    inner_points,
    known_map,
    texture,
    thin_plate,
)
from registration_volume_files import many, size

from codegen.errors import CodegenError
from codegen.registration import register
from codegen.registration.certificate import certify, in_provable_steps
from codegen.registration.grid import Grid
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import Nodes, Volume, warped, write_field


def measured(function: Map, pairs: LandmarkPairs, truth: Map | None, points: Points, pixel: float) -> list[float]:
    """Root mean square error, largest residual, in voxels, and the share of points at which the map folds."""
    error = np.nan if truth is None else np.sqrt(((function(points) - truth(points)) ** 2).sum(axis=1).mean()) / pixel
    residual = np.linalg.norm(function(pairs.fixed) - pairs.moving, axis=1).max() / pixel
    return [float(error), float(residual), float((determinants(function, points, 1e-3 * pixel) <= 0.0).mean())]


def maps(repeat: int) -> None:
    print(
        "volume, landmarks | rms error in voxels: codegen, thin plate, B-spline | largest residual | seconds to solve"
    )
    synthetic = Grid((96, 80, 48), (-30.0, 20.0, 5.0), (0.8, 0.8, 1.6), UPRIGHT, "mm")
    for name, volume in [("synthetic", texture(synthetic)), *brains()]:
        grid = volume.grid
        for count in (10, 40, 150):
            rows, seconds = [], []
            for seed in range(repeat):
                truth = known_map(grid, 0.03, seed)
                fixed = inner_points(grid, count, seed)
                pairs, probe = LandmarkPairs(truth(fixed), fixed), inner_points(grid, 500, 100 + seed)
                begin = perf_counter()
                found = register(pairs, grid)
                middle = perf_counter()
                plate = thin_plate(pairs)
                after = perf_counter()
                spline = b_spline(pairs, grid)
                seconds.append([middle - begin, after - middle, perf_counter() - after])
                functions = (found.map_points_inverse, plate, spline)
                rows.append([measured(f, pairs, truth, probe, grid.pixel) for f in functions])
            table, times = np.median(np.array(rows), axis=0), np.median(np.array(seconds), axis=0)
            errors, residuals = (" ".join(f"{x:8.3g}" for x in table[:, k]) for k in (0, 1))
            print(f"{name:24s} {count:4d} | {errors} | {residuals} | {' '.join(f'{x:6.3f}' for x in times)}")


def folds(repeat: int) -> None:
    print(
        "landmarks, displacement | pairs with folds: codegen, thin plate, B-spline | proved | largest residual (voxels)"
    )
    grid = Grid((64, 64, 64), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), UPRIGHT, "mm")
    probe = grid.samples(20)
    for count, far in ((10, 4.0), (20, 4.0), (20, 8.0), (40, 4.0), (40, 8.0)):
        counts, proved, worst, refused = np.zeros(3), 0, 0.0, 0
        for seed in range(repeat):
            generator = np.random.default_rng(seed)
            fixed = inner_points(grid, count, seed)
            pairs = LandmarkPairs(fixed + far * generator.normal(size=fixed.shape) / np.sqrt(3.0), fixed)
            # Folds are looked for where they are likely: about landmarks as well.
            near = np.vstack([probe, (fixed[:, None] + generator.normal(size=(count, 20, 3))).reshape(-1, 3)])
            try:
                found = in_provable_steps(register(pairs, grid, align="none"))
            except CodegenError:
                refused += 1
            else:
                proved += certify(found).proved
                _, residual, share = measured(found.map_points_inverse, pairs, None, near, 1.0)
                counts[0] += share > 0.0
                worst = max(worst, residual)
            counts[1] += measured(thin_plate(pairs), pairs, None, near, 1.0)[2] > 0.0
            counts[2] += measured(b_spline(pairs, grid), pairs, None, near, 1.0)[2] > 0.0
        said = " ".join(f"{int(n):4d}" for n in counts)
        print(f"{count:4d} {far:4.0f} | {said} of {repeat} | {proved}, refused {refused} | {worst:.1e}")


def labels(repeat: int) -> None:
    print(
        "volume | labels kept | Dice of warped labels with the true ones: unregistered, codegen, thin plate, B-spline"
    )
    for name, volume in brains():
        grid = volume.grid
        levels = np.quantile(volume.samples, (0.5, 0.75, 0.9))
        parts = Volume((np.digitize(volume.samples, levels) * 10).astype(np.uint8), grid)
        rows, kept = [], True
        for seed in range(repeat):
            truth, fixed = known_map(grid, 0.03, seed), inner_points(grid, 60, seed)
            pairs = LandmarkPairs(truth(fixed), fixed)
            found = register(pairs, grid)
            functions = (lambda p: p, found.map_points_inverse, thin_plate(pairs), b_spline(pairs, grid))
            true = warped(parts, Nodes.of(truth, grid, fixed), "nearest").samples
            made = [warped(parts, Nodes.of(f, grid, fixed), "nearest").samples for f in functions]
            kept &= all(set(np.unique(m)) <= {0, 10, 20, 30} for m in made)
            rows.append([[2.0 * ((m == v) & (true == v)).sum() / ((m == v).sum() + (true == v).sum())
                          for v in (10, 20, 30)] for m in made])  # fmt: skip
        dice = np.mean(np.array(rows), axis=(0, 2))
        print(f"{name:24s} | {kept} | {' '.join(f'{x:.4f}' for x in dice)}")


def field(repeat: int) -> None:
    print("volume, kind | largest distance in voxels from our map: at voxels, at random points, at landmarks")
    for name, volume in brains():
        grid = volume.grid
        truth, fixed = known_map(grid, 0.03, 0), inner_points(grid, 40, 0)
        pairs = LandmarkPairs(truth(fixed), fixed)
        found = register(pairs, grid)
        made = warped(volume, Nodes.of(found.map_points_inverse, grid, fixed), "linear", with_field=True)
        assert made.field is not None
        for kind in (".nii.gz", ".mha", ".nrrd"):
            with tempfile.TemporaryDirectory() as scratch:
                path = Path(scratch) / f"field{kind}"
                write_field(path, made.field, grid)
                image = sitk.Cast(sitk.ReadImage(str(path)), sitk.sitkVectorFloat64)
            transform = sitk.DisplacementFieldTransform(image)
            errors = []
            for points in (grid.samples(24), inner_points(grid, 5000, 3), fixed):
                theirs = np.array([transform.TransformPoint(point) for point in points.tolist()])
                errors.append(np.linalg.norm(theirs - found.map_points_inverse(points), axis=1).max() / grid.pixel)
            print(f"{name:24s} {kind:8s} | {' '.join(f'{error:.1e}' for error in errors)}")


def noise(repeat: int) -> None:
    print(
        "landmarks, noise in voxels | residual/sigma | auto/noise | rms error: sigma, auto, exact, thin plate | seconds"
    )
    grid = Grid((128, 128, 128), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), UPRIGHT, "mm")
    for count in (20, 80, 200):
        for deviation in (1.0, 3.0):
            rows = []
            for seed in range(repeat):
                truth, fixed = known_map(grid, 0.03, seed), inner_points(grid, count, seed)
                errors = deviation * np.random.default_rng(seed).normal(size=fixed.shape)
                pairs = LandmarkPairs(truth(fixed) + errors, fixed)
                probe = inner_points(grid, 500, 100 + seed)
                begin = perf_counter()
                given = register(pairs, grid, sigma=deviation)
                seconds = perf_counter() - begin
                found = register(pairs, grid, sigma="auto"), register(pairs, grid)
                maps = [given.map_points_inverse, *(f.map_points_inverse for f in found), thin_plate(pairs)]
                errors_of_maps = [float(np.sqrt(((m(probe) - truth(probe)) ** 2).sum(axis=1).mean())) for m in maps]
                residual = float(np.sqrt((given.residuals**2).mean() / 3.0)) / deviation
                rows.append([residual, found[0].sigma / deviation, *errors_of_maps, seconds])
            table = np.array(rows)
            middle = np.median(table, axis=0)
            ranges = " | ".join(f"{table[:, k].min():.2f}-{table[:, k].max():.2f}" for k in (0, 1))
            far = " ".join(f"{x:.2f}" for x in middle[2:6])
            print(f"{count:4d} {deviation:3.0f} | {ranges} | {far} | {middle[6]:.2f}")


def hard(repeat: int) -> None:
    print("case | outcome | least det J by differences")
    grid = Grid((64, 64, 64), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), UPRIGHT, "mm")
    points = inner_points(grid, 20, 0)
    centre = points.mean(axis=0)
    cases: list[tuple[str, Points, Points]] = []
    for angle in (45, 90, 135, 180):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        cases.append((f"turn of {angle} degrees", points, (points - centre) @ turn.T + centre))
    for seed in range(3):
        order = np.random.default_rng(seed).permutation(12)
        cases.append((f"permutation {seed} of 12", points[:12], points[:12][order]))
    swapped = points.copy()
    swapped[[0, 1]] = swapped[[1, 0]]
    cases.append(("two change places", points, swapped))
    for apart in (1e-1, 1e-3, 1e-5, 1e-7, 1e-9, 1e-12):
        close = np.vstack([points, points[0] + [apart, 0.0, 0.0]])
        cases.append((f"two {apart:g} voxels apart", close, known_map(grid, 0.03, 1)(close)))
    for count in (200, 500, 1000):
        many = inner_points(grid, count, 1)
        cases.append((f"{count} landmarks", many, known_map(grid, 0.03, 1)(many)))
    for name, fixed, moving in cases:
        begin = perf_counter()
        try:
            found = in_provable_steps(register(LandmarkPairs(moving, fixed), grid, align="none"))
        except CodegenError as error:
            print(f"{name:26s} | refused: {error}")
            continue
        seconds, seen = perf_counter() - begin, certify(found)
        least = determinants(found.map_points_inverse, grid.samples(16), 1e-3).min()
        said = "proved" if seen.proved else f"{seen.folded} voxels fold"
        met = f"residual {found.residuals.max():.0e}, {seconds:.2f} s"
        print(f"{name:26s} | {found.steps} steps, {said}, {met} | {least:.3f}")


PARTS = {
    "maps": maps, "folds": folds, "labels": labels, "field": field, "noise": noise, "size": size, "many": many,
    "hard": hard,
}  # fmt: skip

if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", default=[], choices=[[], *PARTS])
    parser.add_argument("--repeat", type=int, default=5)
    arguments = parser.parse_args()
    for part in arguments.parts or PARTS:
        print(f"\n{part}", flush=True)
        PARTS[part](arguments.repeat)
