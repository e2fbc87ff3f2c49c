"""Displacement fields in ANTs and in elastix themselves: points and resampled images beside ours.

python -m pip install antspyx itk-elastix
"""

import subprocess
import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
from registered_images import SHAPE
from scipy.spatial.transform import Rotation
from volume_samples import run, table, texture, volume, waves

from codegen.registration import register
from codegen.registration.grid import Grid
from codegen.registration.images import read_image, write_image
from codegen.registration.linear import chosen_alignment
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import read_volume, write_volume

itk = pytest.importorskip("SimpleITK")
PACKAGES = {"ants": "antspyx", "elastix": "itk-elastix"}
KINDS = ("nii.gz", "nii", "mha", "mhd", "nrrd")

TURN = Rotation.from_euler("zyx", (0.4, -0.3, 0.2)).as_matrix() @ np.diag([-1.0, -1.0, 1.0])
"""Oblique about every axis, with rows and columns that run against LPS, as those of most NIfTI files do."""
AXES = tuple(map(tuple, TURN.tolist()))
MOVING = Grid((30, 26, 20), (12.0, 11.5, -40.0), (0.9, 0.8, 1.6), AXES, "mm")
FIXED = Grid((28, 27, 22), (12.0, 12.0, -41.0), (1.0, 0.7, 1.5), AXES, "mm")
FIXED_SHAPE = (SHAPE[0] + 7, SHAPE[1] + 3)


@pytest.fixture(params=PACKAGES)
def program(request):
    """The name of a program that is installed."""
    try:
        metadata.version(PACKAGES[request.param])
    except metadata.PackageNotFoundError:
        pytest.skip(f"{request.param} is not installed: pip install {PACKAGES[request.param]}")
    return request.param


def _applied(program, fixed, moving, field, points):
    """The moving image in the frame of the fixed one, and where points are moved, by the other program."""
    asked, answer = field.with_name("points.npy"), field.with_name("answer.npz")
    np.save(asked, points)
    script = Path(__file__).with_name("other_programs.py")
    command = [sys.executable, script, program, fixed, moving, field, asked, answer]
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    with np.load(answer) as made:
        return made["warped"], made["moved"]


def _by_simpleitk(field, points):
    """Between voxels all programs interpolate the field linearly."""
    transform = itk.DisplacementFieldTransform(itk.Cast(itk.ReadImage(str(field)), itk.sitkVectorFloat64))
    return np.array([transform.TransformPoint(point.tolist()) for point in points])


def _require_alike(theirs, ours):
    """Theirs are not rounded to integers, and at the rim one of both may find the place outside."""
    inside = (theirs != 0) & (ours != 0)
    assert inside.mean() > 0.5
    assert np.abs(theirs - ours)[inside].max() < 0.51
    assert ((theirs != 0) != (ours != 0)).mean() < 0.01


def _require_moved_alike(theirs, voxels, between, pixel):
    """To a thousandth of a pixel, at voxels as the map does, and in between as linear interpolation."""
    for moved, expected in ((theirs[: len(voxels)], voxels), (theirs[len(voxels) :], between)):
        assert np.linalg.norm(moved - expected, axis=1).max() < 1e-3 * pixel


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("space_solver")
def test_fields_of_oblique_volumes_move_points_and_images_as_the_map_does(tmp_path, program, kind):
    inner = np.random.default_rng(0).uniform(0.15, 0.85, (12, 3)) * (np.array(FIXED.size) - 1)
    pairs = LandmarkPairs(waves(FIXED.to_places(inner)), FIXED.to_places(inner))
    moving, fixed, out = (tmp_path / name for name in ("moving.nii.gz", "fixed.nrrd", "out.mha"))
    write_volume(moving, volume(MOVING), MOVING)
    write_volume(fixed, volume(FIXED, lambda points: texture(waves(points))), FIXED)
    landmarks, field = table(tmp_path / "pairs.csv", pairs), tmp_path / f"field.{kind}"
    run(moving, "--landmarks", landmarks, "--fixed", fixed, "--out", out, "--field", field)
    align = chosen_alignment(pairs, MOVING, fixed_shape=FIXED).kind
    found, voxels = register(pairs, MOVING, fixed_shape=FIXED, align=align), FIXED.samples(6)
    warped, moved = _applied(program, fixed, moving, field, np.vstack([voxels, pairs.fixed]))
    _require_alike(warped, read_volume(out).samples)
    _require_moved_alike(moved, found.map_points_inverse(voxels), _by_simpleitk(field, pairs.fixed), FIXED.pixel)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.usefixtures("solver")
def test_fields_of_pictures_move_points_and_images_as_the_map_does(tmp_path, program, kind):
    generator, (height, width) = np.random.default_rng(0), SHAPE
    y, x = np.mgrid[:height, :width]
    shade = 120 + 60 * np.sin(x / 4) * np.cos(y / 5) + 40 * np.sin((x + y) / 9)
    points = generator.uniform(0.15, 0.85, (12, 2)) * [width, height]
    pairs = LandmarkPairs(points + 1.5 * np.sin(points[:, ::-1] / 9), points)
    moving, fixed, out = (tmp_path / name for name in ("moving.png", "fixed.png", "out.png"))
    write_image(moving, shade.astype(np.uint8))
    write_image(fixed, np.ones(FIXED_SHAPE, np.uint8))
    landmarks, field = table(tmp_path / "pairs.csv", pairs), tmp_path / f"field.{kind}"
    run(moving, "--landmarks", landmarks, "--fixed", fixed, "--out", out, "--field", field)
    align = chosen_alignment(pairs, SHAPE, fixed_shape=FIXED_SHAPE).kind
    found = register(pairs, SHAPE, fixed_shape=FIXED_SHAPE, align=align)
    pixels = generator.integers(5, np.array(SHAPE[::-1]) - 5, (40, 2)).astype(float)
    warped, moved = _applied(program, fixed, moving, field, np.vstack([pixels, points]))
    _require_alike(warped, read_image(out).pixels.astype(float))
    _require_moved_alike(moved, found.map_points_inverse(pixels), _by_simpleitk(field, points), 1.0)
