"""Warped images, coarse grids, fields: identities to the last bit, closed forms, other programs' readers."""

import builtins
import sys

import numpy as np
import pytest
from registered_images import SHAPE

from codegen.errors import ArgumentError, ExtraError, FileError, ImageError
from codegen.registration import register, warp
from codegen.registration.grid import pixel_grid
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.warp import displacement_field, map_grid, warp_reported, write_field

TYPES = (np.uint8, np.uint16, np.int16, np.float32, np.float64)


def image(dtype, channels=(), seed=0):
    values = np.random.default_rng(seed).random((*SHAPE, *channels))
    return values.astype(dtype) if np.dtype(dtype).kind == "f" else (values * np.iinfo(dtype).max).astype(dtype)


@pytest.fixture(scope="module")
def identity(solver, pairs):
    return register(LandmarkPairs(pairs.moving, pairs.moving), SHAPE)


@pytest.fixture(scope="module")
def shifted(solver, pairs):
    """Half a pixel to the right and three pixels down."""
    return register(LandmarkPairs(pairs.moving, pairs.moving + np.array([0.5, 3.0])), SHAPE)


@pytest.mark.parametrize("channels", [(), (1,), (3,), (4,)])
@pytest.mark.parametrize("dtype", TYPES)
def test_landmarks_that_stay_leave_every_bit(identity, dtype, channels):
    given = image(dtype, channels)
    for interpolation in ("nearest", "linear"):
        for spacing in (None, 8):
            found = warp(given, identity, interpolation=interpolation, spacing=spacing)
            assert found.dtype == dtype
            np.testing.assert_array_equal(found, given)
    smooth = warp(given.astype(float), identity, interpolation="cubic")
    np.testing.assert_allclose(smooth, given, atol=1e-12 * max(1.0, float(given.max())))


def test_half_a_pixel_is_the_mean_of_two_rounded_and_what_comes_from_outside_is_filled(shifted):
    given = image(np.uint8)
    found, report = warp_reported(given, shifted, fill=7)
    below = given[:-3].astype(int)
    np.testing.assert_array_equal(found[3:, 1:], np.rint((below[:, :-1] + below[:, 1:]) / 2))
    np.testing.assert_array_equal(found[3:, 0], given[:-3, 0])  # half a pixel outside: still its pixel
    assert (found[:3] == 7).all()
    assert report.outside == 3 * SHAPE[1]


def test_overshoots_are_clipped_and_not_wrapped(shifted):
    given = np.zeros(SHAPE, np.uint8)
    given[:, 80:] = 255
    found = warp(given, shifted, interpolation="cubic")
    exact = warp(given.astype(float), shifted, interpolation="cubic")
    assert exact.max() > 256
    assert exact.min() < -1
    np.testing.assert_array_equal(found, np.rint(exact.clip(0, 255)))


def test_the_moving_image_shows_landmarks_where_the_fixed_one_has_them(registration, pairs):
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]

    def spots(points):
        return np.stack([np.exp(-((x - a) ** 2 + (y - b) ** 2) / 4) for a, b in points], axis=-1)

    def centres(picture):
        weight = picture.sum(axis=(0, 1))
        return np.stack([(picture * z[..., None]).sum(axis=(0, 1)) / weight for z in (x, y)], axis=1)

    found = centres(warp(spots(pairs.moving), registration, interpolation="cubic"))
    np.testing.assert_allclose(found, pairs.fixed, atol=0.2)
    back = centres(warp(spots(pairs.fixed), registration, interpolation="cubic", inverse=True))
    np.testing.assert_allclose(back, pairs.moving, atol=0.2)
    assert np.abs(pairs.fixed - pairs.moving).max() > 5.0


@pytest.mark.parametrize(
    ("pixels", "error"),
    [
        (np.zeros(5), ImageError), (np.zeros((0, 4)), ImageError), (np.zeros((2, 2, 2, 2)), ImageError),
        (np.zeros((4, 4), complex), ImageError), (np.full((4, 4), "a"), ImageError),
    ],
)  # fmt: skip
def test_what_is_no_image_is_refused(identity, pixels, error):
    with pytest.raises(error):
        warp(pixels, identity)
    with pytest.raises(ArgumentError, match="nearest, linear, cubic"):
        warp(image(np.uint8), identity, interpolation="lanczos")
    with pytest.raises(ArgumentError, match="spacing"):
        warp(image(np.uint8), identity, spacing=3)


# ---- Coarse grids ----


def waves(p):
    return p + np.stack([5 * np.sin(p[:, 1] / 40), 7 * np.cos(p[:, 0] / 30 + p[:, 1] / 50)], axis=1)


def kinked(p):
    """What a landmark's Green's function is near the landmark: r^2 log r."""
    s = ((p - [101.3, 57.8]) ** 2).sum(axis=1)
    return p + (0.02 * s * np.log(s + 1e-300) * np.exp(-s / 2000.0))[:, None]


@pytest.mark.parametrize("spacing", [2, 4, 8, 16, "auto"])
@pytest.mark.parametrize("function", [waves, kinked])
def test_the_bound_of_a_coarse_grid_holds_at_every_pixel(function, spacing):
    shape, singular = (170, 230), np.array([[101.3, 57.8], [-50.0, 9.0]])
    exact = function(pixel_grid(shape)).reshape(*shape, 2)
    found = map_grid(function, shape, singular, spacing)
    error = np.linalg.norm(found.places - exact, axis=-1).max()
    assert error <= found.bound <= 0.01
    assert found.exact < 1.0 or spacing == 16
    assert map_grid(function, shape, singular).bound == 0.0


def test_a_bound_that_is_not_met_by_interpolation_makes_pixels_exact():
    exact = waves(pixel_grid((170, 230))).reshape(170, 230, 2)
    loose, strict = (map_grid(waves, (170, 230), np.empty((0, 2)), 8, bound) for bound in (1e-2, 1e-6))
    assert loose.exact < 0.1 < strict.exact
    assert np.abs(strict.places - exact).max() <= 1e-6


def test_coarse_warps_of_a_registration(registration):
    given = image(np.float64)
    exact = warp(given, registration)
    found, report = warp_reported(given, registration, spacing=2)
    assert report.spacing == 2
    assert report.exact < 0.7
    # A linear interpolation changes by at most twice the range of values over the distance.
    assert np.abs(found - exact).max() <= 2.0 * report.bound + 1e-9
    assert report.bound <= 0.01


# ---- Displacement fields ----


def test_fields_point_from_pixels_to_where_they_go_or_come_from(registration):
    points = pixel_grid(SHAPE)
    for inverse, function in ((False, registration.map_points), (True, registration.map_points_inverse)):
        field = displacement_field(registration, inverse=inverse)
        np.testing.assert_allclose(field.reshape(-1, 2) + points, function(points), atol=1e-10)


def test_files_are_read_by_other_programs_as_they_were_meant(registration, tmp_path):
    itk, nibabel = pytest.importorskip("SimpleITK"), pytest.importorskip("nibabel")
    field = displacement_field(registration, inverse=True)
    for name in ("field.npz", "field.mha", "field.mhd", "field.nrrd", "field.nii.gz", "field.nii"):
        write_field(tmp_path / name, field, "fixed to moving")
    with np.load(tmp_path / "field.npz") as archive:
        np.testing.assert_array_equal(archive["displacement"], field)
        assert str(archive["direction"]) == "fixed to moving"
    data = np.asarray(nibabel.load(tmp_path / "field.nii").dataobj)
    np.testing.assert_array_equal(data[:, :, 0, 0, :], field.transpose(1, 0, 2))
    assert (tmp_path / "field.raw").read_bytes() == field.tobytes()
    points = [(30.0, 40.0), (100.0, 20.0), (75.0, 90.0)]
    expected = registration.map_points_inverse(points)
    for name in ("field.mha", "field.mhd", "field.nrrd", "field.nii.gz"):
        found = itk.ReadImage(str(tmp_path / name), itk.sitkVectorFloat64)
        assert found.TransformIndexToPhysicalPoint((30, 40)) == (30.0, 40.0)
        moved = [itk.DisplacementFieldTransform(itk.Image(found)).TransformPoint(p) for p in points]
        np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_fields_that_cannot_be_written_say_why(tmp_path, monkeypatch):
    field = np.zeros((3, 4, 2))
    for name in ("field.tif", "field.MHD"):
        with pytest.raises(ArgumentError, match="unknown kind"):
            write_field(tmp_path / name, field)
    with pytest.raises(ImageError, match=r"\(3, 4\)"):
        write_field(tmp_path / "field.npz", field[..., 0])
    with pytest.raises(FileError, match="cannot be written"):
        write_field(tmp_path / "none" / "field.npz", field)
    found = builtins.__import__
    for name in ("SimpleITK", "nibabel"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.setattr("importlib.import_module", lambda name: found("no_such_library"))
    for name in ("field.mha", "field.mhd", "field.nrrd", "field.nii"):
        with pytest.raises(ExtraError, match=r"pip install (SimpleITK|nibabel)"):
            write_field(tmp_path / name, field)
        assert not list(tmp_path.iterdir())
