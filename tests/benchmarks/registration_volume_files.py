"""Volumes from files to files: seconds and memory by the command; a part of registration_volumes.py."""

import json
import resource
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

import SimpleITK as sitk
from known_volumes import UPRIGHT, inner_points, known_map, texture, thin_plate

from codegen.registration.formats import landmark_texts
from codegen.registration.grid import Grid
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import write_volume


def size(repeat: int) -> None:
    """256 x 256 x 256 voxels and 40 landmarks by the command, and its parts; the peak of its memory."""
    grid = Grid((256, 256, 256), (-100.0, -90.0, -80.0), (0.8, 0.8, 0.8), UPRIGHT, "mm")
    truth, fixed = known_map(grid, 0.02, 0), inner_points(grid, 40, 0)
    pairs = LandmarkPairs(truth(fixed), fixed)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        write_volume(folder / "moving.nii.gz", texture(grid).samples, grid)
        write_volume(folder / "fixed.nii.gz", texture(grid, 1).samples, grid)
        (folder / "pairs.csv").write_text(landmark_texts(pairs, "csv")[0])
        names = "warp moving.nii.gz --landmarks pairs.csv --fixed fixed.nii.gz --out warped.nii.gz --json".split()
        for more in ([], ["--field", "field.nii.gz", "--report", "r.html"], ["--interpolation", "cubic"]):
            begin = perf_counter()
            command = [sys.executable, "-m", "codegen", *names, *more]
            done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
            seconds = perf_counter() - begin
            record = json.loads(done.stdout)
            parts = ", ".join(f"{name} {value:.2f}" for name, value in record["seconds"].items())
            peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024.0
            print(f"{' '.join(more) or 'warp alone'}: {seconds:.1f} s, at most {peak:.0f} MB so far ({parts})")
        moving, reference = sitk.ReadImage(f"{scratch}/moving.nii.gz"), sitk.ReadImage(f"{scratch}/fixed.nii.gz")
        flat = (pairs.fixed.ravel().tolist(), pairs.moving.ravel().tolist())
        begin = perf_counter()
        transform = sitk.LandmarkBasedTransformInitializer(
            sitk.BSplineTransform(3), *flat, referenceImage=reference, numberOfControlPoints=8
        )
        sitk.Resample(moving, reference, transform, sitk.sitkLinear)
        print(f"SimpleITK's B-spline and its resampling alone: {perf_counter() - begin:.1f} s")
        begin = perf_counter()
        thin_plate(pairs)(grid.samples(64))
        print(f"thin plate at every 64th voxel, times 64: {64.0 * (perf_counter() - begin):.1f} s")


def many(repeat: int) -> None:
    """Batches of one worker, with a field of each specimen: memory must not grow with their number."""
    grid = Grid((128, 128, 128), (-50.0, -45.0, -40.0), (0.8, 0.8, 0.8), UPRIGHT, "mm")
    for count in (1, 2, 4, 8):
        with tempfile.TemporaryDirectory() as scratch:
            folder = Path(scratch) / "in"
            folder.mkdir()
            for seed in range(count):
                fixed = inner_points(grid, 20, seed)
                pairs = LandmarkPairs(known_map(grid, 0.02, seed)(fixed), fixed)
                write_volume(folder / f"{seed}.nii.gz", texture(grid, seed).samples, grid)
                (folder / f"{seed}.csv").write_text(landmark_texts(pairs, "csv")[0])
            words = f"warp {folder} --out {scratch}/out --field {scratch}/fields --workers 1 --json".split()
            begin = perf_counter()
            # A process of its own, whose children are those of this batch alone.
            script = (
                "import resource, subprocess, sys; subprocess.run(sys.argv[1:], check=True, stdout=subprocess.DEVNULL);"
                "print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)"
            )
            command = [sys.executable, "-c", script, sys.executable, "-m", "codegen", *words]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
            megabytes = int(done.stdout) / 1024.0
            print(f"{count} volumes: {perf_counter() - begin:.1f} s, at most {megabytes:.0f} MB a process")
