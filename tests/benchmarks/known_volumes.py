"""Volumes, known maps between them and what other libraries make of landmarks, for benchmarks of registration."""

import importlib.resources
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import SimpleITK as sitk
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.ndimage import gaussian_filter

from codegen.registration.grid import Grid
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import Volume, read_volume

Points = NDArray[np.float64]
Map = Callable[[Points], Points]
UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def known_map(grid: Grid, strength: float, seed: int) -> Map:
    """From the fixed volume to the moving one: waves of about two to an edge; `strength` is a share of the edge."""
    generator = np.random.default_rng(seed)
    length = float(np.min(np.array(grid.size) * grid.spacing))
    waves = generator.normal(size=(3, 3)) * 2.0 / length
    phases = generator.uniform(0.0, 6.0, 3)

    def moved(points: Points) -> Points:
        return points + strength * length * np.sin(points @ waves.T + phases)

    return moved


def texture(grid: Grid, seed: int = 0) -> Volume:
    """Smooth grey of 16 bits."""
    noise = gaussian_filter(np.random.default_rng(seed).normal(size=grid.shape), 2.5)
    return Volume((8000.0 + 3000.0 * noise / noise.std()).clip(0, 30000).astype(np.int16), grid)


def brains() -> list[tuple[str, Volume]]:
    """Volumes of the package nibabel: a small anatomy, and the first of an oblique, anisotropic series."""
    import nibabel

    folder = Path(str(importlib.resources.files(nibabel))) / "tests" / "data"
    found = [("anatomical.nii", read_volume(folder / "anatomical.nii"))]
    series = sitk.ReadImage(str(folder / "example4d.nii.gz"))[:, :, :, 0]
    with tempfile.TemporaryDirectory() as scratch:
        sitk.WriteImage(series, f"{scratch}/first.nii.gz")
        found.append(("example4d.nii.gz, first", read_volume(Path(scratch) / "first.nii.gz")))
    return found


def inner_points(grid: Grid, count: int, seed: int) -> Points:
    share = np.random.default_rng(seed).uniform(0.12, 0.88, (count, 3))
    return grid.to_places(share * (np.array(grid.size) - 1.0))


def thin_plate(pairs: LandmarkPairs) -> Map:
    return RBFInterpolator(pairs.fixed, pairs.moving, kernel="linear", degree=1)


def b_spline(pairs: LandmarkPairs, grid: Grid, controls: int = 8) -> Map:
    """SimpleITK's B-spline through landmarks, with so many control points along each axis, on an upright grid."""
    axes = np.array(grid.direction)
    fixed, moving = ((points - grid.origin) @ axes for points in (pairs.fixed, pairs.moving))
    reference = sitk.Image([int(n) for n in grid.size], sitk.sitkUInt8)
    reference.SetSpacing(grid.spacing)
    transform = sitk.LandmarkBasedTransformInitializer(
        sitk.BSplineTransform(3), fixed.ravel().tolist(), moving.ravel().tolist(), referenceImage=reference,
        numberOfControlPoints=controls,
    )  # fmt: skip

    def mapped(points: Points) -> Points:
        moved = [transform.TransformPoint(point) for point in ((points - grid.origin) @ axes).tolist()]
        return np.array(moved) @ axes.T + grid.origin

    return mapped


def determinants(function: Map, points: Points, step: float) -> NDArray[np.float64]:
    """By central differences."""
    columns = [(function(points + step * e) - function(points - step * e)) / (2.0 * step) for e in np.eye(3)]
    return np.asarray(np.linalg.det(np.stack(columns, axis=2)))
