"""`codegen warp` on volumes: kinds of files, fields beside SimpleITK, labels, memory, places between nodes."""

import json

import numpy as np
import pytest
from volume_samples import FIXED, MOVING, OBLIQUE, asked, filled, pairs_of, refused, run, table, volume

from codegen.registration import register
from codegen.registration.grid import Grid, corners
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import Nodes, read_volume, write_volume

itk = pytest.importorskip("SimpleITK")
tifffile = pytest.importorskip("tifffile")
pytestmark = pytest.mark.usefixtures("space_solver")


@pytest.fixture
def files(tmp_path):
    return filled(tmp_path)


@pytest.mark.parametrize("kind", ["nii", "nii.gz", "mha", "mhd", "nrrd"])
def test_a_field_read_by_simpleitk_moves_points_as_the_map_does(files, kind):
    """At the centres of voxels to a thousandth of a voxel; and resampling there gives the same volume."""
    field, out = files / f"field.{kind}", f"out.{kind}"
    run(*asked(files, "--field", field, "--json", out=out))
    transform = itk.DisplacementFieldTransform(itk.Cast(itk.ReadImage(str(field)), itk.sitkVectorFloat64))
    found = register(pairs_of(), MOVING, fixed_shape=FIXED)
    places = FIXED.samples(6)
    moved = np.array([transform.TransformPoint(place.tolist()) for place in places])
    assert np.linalg.norm(moved - found.map_points_inverse(places), axis=1).max() < 1e-3 * FIXED.pixel
    moving, fixed = (itk.ReadImage(str(files / name)) for name in ("moving.nii.gz", "fixed.mha"))
    theirs = itk.GetArrayFromImage(itk.Resample(moving, fixed, transform, itk.sitkLinear, 0.0)).astype(float)
    ours = itk.ReadImage(str(files / out))
    np.testing.assert_allclose(ours.GetDirection(), fixed.GetDirection(), atol=1e-7)
    np.testing.assert_allclose(ours.GetOrigin(), fixed.GetOrigin(), rtol=1e-6)
    differences = np.abs(itk.GetArrayFromImage(ours) - theirs)[1:-1, 1:-1, 1:-1]
    inside = (theirs != 0)[1:-1, 1:-1, 1:-1]
    assert differences[inside].max() <= 1.0  # both round to integers


def test_a_header_names_its_file_of_bare_samples_and_both_are_replaced_as_a_whole(files):
    run(*asked(files, out="a b.mhd"))
    assert "ElementDataFile = a b.raw" in (files / "a b.mhd").read_text().splitlines()
    samples = read_volume(files / "a b.mhd").samples
    bare = np.fromfile(files / "a b.raw", samples.dtype).reshape(samples.shape)
    np.testing.assert_array_equal(bare, samples)
    np.testing.assert_array_equal(samples, _written(files, "out.mha"))
    before = {path.name: path.read_bytes() for path in files.iterdir()}
    (files / "new.raw").mkdir()
    assert "new.raw is a folder" in refused(*asked(files, out="new.mhd"))
    (files / "new.raw").rmdir()
    assert {path.name: path.read_bytes() for path in files.iterdir()} == before


def _written(files, out):
    run(*asked(files, out=out))
    return read_volume(files / out).samples


@pytest.mark.parametrize("option", ["--out", "--field"])
def test_samples_that_a_header_names_are_not_overwritten(files, option):
    write_volume(files / "moving.mhd", volume(MOVING), MOVING)
    (files / "moving.raw").rename(files / "other.raw")
    header = files / "moving.mhd"
    header.write_text(header.read_text().replace("moving.raw", "other.raw"))
    kept = (files / "other.raw").read_bytes()
    outputs = ["--out", files / "out.nii.gz", option, files / "other.mhd"]
    sizes = " ".join(map(str, MOVING.size))
    lines = ["NRRD0004", "type: short", "endian: little", "dimension: 3", f"sizes: {sizes}", "encoding: raw"]
    (files / "moving.nhdr").write_text("\n".join([*lines, "data file: other.raw", ""]))
    for name in ("moving.mhd", "moving.nhdr"):
        given = [files / name, "--landmarks", files / "pairs.csv", *outputs]
        assert "other.raw is read and would be overwritten" in refused(*given)
    assert (files / "other.raw").read_bytes() == kept
    assert not (files / "other.mhd").exists()


def test_the_warped_volume_is_like_the_fixed_one_and_the_record_says_how(files):
    done = run(*asked(files, "--report", files / "r.html", "--interpolation", "cubic", "--json"))
    record = json.loads(done.stdout)
    assert (record["status"], record["direction"], record["summary"]["unit"]) == ("solved", "moving to fixed", "mm")
    before, after = read_volume(files / "moving.nii.gz").samples, read_volume(files / "out.nii.gz").samples
    target = read_volume(files / "fixed.mha").samples
    assert after.dtype == before.dtype == np.int16
    middle = (slice(6, 16), slice(8, 20), slice(8, 20))
    error = np.sqrt(((after.astype(float) - target)[middle] ** 2).mean())
    assert error < 0.15 * np.std(target[middle].astype(float))
    seen = record["summary"]
    assert seen["proved"]
    assert seen["round_trip"] < 1e-8
    assert record["residual"] < 1e-6
    assert len(seen["leave_one_out"]) == 12
    assert len(seen["det_min_at"]) == 3
    assert FIXED.contains(np.array([seen["det_min_at"]])).all()
    text = (files / "r.html").read_text()
    assert text.count("<img ") == 6
    assert "nowhere, which is proved" in text
    assert "fixed z" in text


def test_labels_keep_their_values(files):
    labels = np.random.default_rng(0).choice([0, 3, 7, 4000], size=MOVING.shape).astype("u2")
    write_volume(files / "labels.nrrd", labels, MOVING)
    run(*asked(files, "--interpolation", "nearest", "--json", moving="labels.nrrd"))
    found = read_volume(files / "out.nii.gz").samples
    assert found.dtype == np.uint16
    assert set(np.unique(found)) == {0, 3, 7, 4000}
    transform = register(pairs_of(), MOVING, fixed_shape=FIXED)
    places = FIXED.samples(99)
    indices = MOVING.to_indices(transform.map_points_inverse(places))
    near = np.abs(indices - np.floor(indices) - 0.5).min(axis=1) > 0.01  # what is not half way between voxels
    inside = near & ((indices >= 0) & (indices <= np.array(MOVING.size) - 1)).all(axis=1)
    column, row, slab = np.rint(indices[inside]).astype(int).T
    np.testing.assert_array_equal(found.ravel()[inside], labels[slab, row, column])


def test_the_other_direction_brings_the_fixed_volume_to_the_moving_one(files):
    done = run(*asked(files, "--inverse", "--field", files / "f.mha", "--json"))
    assert json.loads(done.stdout)["direction"] == "fixed to moving"
    assert read_volume(files / "out.nii.gz").samples.shape == MOVING.shape
    transform = itk.DisplacementFieldTransform(itk.Cast(itk.ReadImage(str(files / "f.mha")), itk.sitkVectorFloat64))
    places = MOVING.samples(5)
    moved = np.array([transform.TransformPoint(place.tolist()) for place in places])
    wanted = register(pairs_of(), MOVING, fixed_shape=FIXED).map_points(places)
    assert np.linalg.norm(moved - wanted, axis=1).max() < 1e-3 * MOVING.pixel


def test_stacks_of_tiff_have_the_spacing_of_imagej(files):
    samples = volume(MOVING, kind="u2")
    tifffile.imwrite(
        files / "stack.tif", samples, imagej=True, resolution=(1 / 0.5, 1 / 0.25),
        metadata={"axes": "ZYX", "spacing": 2.0, "unit": "um"},
    )  # fmt: skip
    read = read_volume(files / "stack.tif")
    assert read.grid.spacing == (0.5, 0.25, 2.0)
    assert read.grid.unit == "µm"
    np.testing.assert_array_equal(read.samples, samples)
    fixed = read.grid.to_places(np.random.default_rng(1).uniform(4, 15, (8, 3)))
    table(files / "stack.csv", LandmarkPairs(fixed + np.sin(fixed[:, ::-1]) / 4, fixed))
    done = run(files / "stack.tif", "--landmarks", files / "stack.csv", "--out", files / "o.tif", "--json")
    assert json.loads(done.stdout)["summary"]["unit"] == "µm"
    again = read_volume(files / "o.tif")
    assert (again.grid.spacing, again.grid.unit, again.samples.dtype) == ((0.5, 0.25, 2.0), "µm", np.uint16)


def test_memory_is_used_in_slabs_and_the_result_does_not_depend_on_them(files, monkeypatch):
    run(*asked(files, "--field", files / "a.mha", "--json"))
    whole, field = read_volume(files / "out.nii.gz").samples, itk.GetArrayFromImage(itk.ReadImage(str(files / "a.mha")))
    monkeypatch.setattr("codegen.registration.volumes.BLOCKS_PORTION", 3 * 28 * 27)
    run(*asked(files, "--field", files / "a.mha", "--json"))
    np.testing.assert_array_equal(read_volume(files / "out.nii.gz").samples, whole)
    # The flow works on blocks of points, which are others; rounding is all that may differ.
    np.testing.assert_allclose(itk.GetArrayFromImage(itk.ReadImage(str(files / "a.mha"))), field, atol=1e-6)


def test_slices_are_named_by_the_axes_of_the_patient():
    from codegen.registration.pair_report import Plane

    lying = Grid(
        (9, 8, 7), (0.0, 0.0, 0.0), (1.0, 1.0, 2.0), ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)), "mm"
    )
    assert [Plane(lying, axis, 3).name for axis in range(3)] == [
        "coronal, column 3",
        "axial, row 3",
        "sagittal, slice 3",
    ]
    ramp = np.arange(lying.count).reshape(lying.shape)
    for axis in range(3):
        plane = Plane(lying, axis, 3)
        places, shape = plane.places(99)
        column, row, number = np.rint(lying.to_indices(places)).astype(int).T
        np.testing.assert_array_equal(plane.shown(ramp), ramp[number, row, column].reshape(shape))


@pytest.mark.parametrize("size", [(40, 36, 33), (70, 64, 5), (3, 50, 50)])
def test_splines_between_nodes_are_as_near_as_they_say(size):
    grid = Grid(size, (3.0, -2.0, 1.0), (0.7, 0.7, 0.7 * 70 / size[2] / 2), OBLIQUE)
    middle = corners(grid).mean(axis=0)

    def kinked(places):
        shift = 0.4 * np.exp(-np.linalg.norm(places - middle, axis=1)[:, None] / 6.0)
        return places + shift * [1.0, -1.0, 0.5] + 0.3 * np.sin(places / 9.0)

    nodes = Nodes.of(kinked, grid, middle[None])
    shifts = np.concatenate([nodes.slab(slice(0, 2)), nodes.slab(slice(2, size[2]))])
    places = grid.samples(99)
    errors = np.linalg.norm(shifts.reshape(-1, 3) - (kinked(places) - places), axis=1)
    assert errors.max() <= 1e-3 * grid.pixel
    assert 0.0 < nodes.exact <= 1.0
    assert nodes.bound <= 5e-4 * grid.pixel
