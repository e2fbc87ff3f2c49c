"""`codegen warp` on volumes: kinds of files, landmarks of other programs, fields beside SimpleITK, refusals."""

import gzip
import json
import struct
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from codegen.cli import main
from codegen.errors import ExtraError
from codegen.registration import LandmarkPairs, register
from codegen.registration.formats import Frames, landmark_texts, parse_landmarks
from codegen.registration.grid import Grid
from codegen.registration.volumes.files import is_volume, read_volume, write_volume
from codegen.registration.volumes.nodes import Nodes

itk = pytest.importorskip("SimpleITK")
tifffile = pytest.importorskip("tifffile")
pytestmark = pytest.mark.usefixtures("space_solver")

C, S = np.cos(0.3), np.sin(0.3)
OBLIQUE = ((C, -S, 0.0), (S, C, 0.0), (0.0, 0.0, 1.0))
MOVING = Grid((30, 26, 20), (-12.0, 31.5, -40.0), (0.9, 0.9, 1.6), OBLIQUE, "mm")
FIXED = Grid((28, 27, 22), (-10.0, 30.0, -41.0), (1.0, 0.9, 1.5), OBLIQUE, "mm")


def waves(points):
    """Where the place of a fixed voxel comes from: about a millimetre away."""
    x, y, z = points.T
    return points + np.stack([np.sin(y / 7), np.cos(z / 8), 1.2 * np.sin((x + z) / 9)], axis=1)


def texture(points):
    x, y, z = points.T
    return 500 + 200 * np.sin(x / 2.5) * np.cos(y / 3) + 150 * np.sin(z / 3)


def volume(grid, function=texture, kind="i2"):
    return function(grid.samples(99)).reshape(grid.shape).astype(kind)


def pairs_of(count=12):
    fixed = FIXED.to_places(np.random.default_rng(0).uniform(0.15, 0.85, (count, 3)) * (np.array(FIXED.size) - 1))
    return LandmarkPairs(waves(fixed), fixed)


def table(path, pairs):
    text = landmark_texts(pairs, "csv")[0]
    path.write_text(text)
    return path


@pytest.fixture
def files(tmp_path):
    write_volume(tmp_path / "moving.nii.gz", volume(MOVING), MOVING)
    write_volume(tmp_path / "fixed.mha", volume(FIXED, lambda p: texture(waves(p))), FIXED)
    table(tmp_path / "pairs.csv", pairs_of())
    return tmp_path


def run(*arguments, expect=0):
    done = CliRunner().invoke(main, ["warp", *map(str, arguments)])
    assert done.exit_code == expect, (done.output, done.exception)
    return done


def refused(*arguments):
    """The one line that says what is wrong with the input."""
    done = run(*arguments, expect=2)
    assert done.stdout == ""
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith("codegen: error: ")
    return line


def asked(files, *more, moving="moving.nii.gz", landmarks="pairs.csv", fixed="fixed.mha", out="out.nii.gz"):
    return [
        files / moving, "--landmarks", files / landmarks, "--fixed", files / fixed, "--out", files / out, *more,
    ]  # fmt: skip


# ---- From files to files ----


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
    monkeypatch.setattr("codegen.registration.volumes.blocks.PORTION", 3 * 28 * 27)
    run(*asked(files, "--field", files / "a.mha", "--json"))
    np.testing.assert_array_equal(read_volume(files / "out.nii.gz").samples, whole)
    # The flow works on blocks of points, which are others; rounding is all that may differ.
    np.testing.assert_allclose(itk.GetArrayFromImage(itk.ReadImage(str(files / "a.mha"))), field, atol=1e-6)


def test_slices_are_named_by_the_axes_of_the_patient():
    from codegen.registration.volumes.pictures import Plane

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


# ---- Places between nodes ----


@pytest.mark.parametrize("size", [(40, 36, 33), (70, 64, 5), (3, 50, 50)])
def test_splines_between_nodes_are_as_near_as_they_say(size):
    grid = Grid(size, (3.0, -2.0, 1.0), (0.7, 0.7, 0.7 * 70 / size[2] / 2), OBLIQUE)
    middle = grid.corners().mean(axis=0)

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


# ---- Landmarks of other programs ----


def frames():
    return Frames(grids=(MOVING, FIXED))


@pytest.mark.parametrize("form", ["csv", "bigwarp", "elastix", "slicer", "fcsv"])
def test_landmarks_in_space_are_written_and_read(form):
    pairs = pairs_of()
    texts = landmark_texts(pairs, form, frames())
    suffix = {"csv": "csv", "bigwarp": "csv", "elastix": "pts", "slicer": "mrk.json", "fcsv": "fcsv"}[form]
    contents = [(f"{k}.{suffix}", text.encode()) for k, text in enumerate(texts)]
    again = parse_landmarks(contents, frames=frames())
    np.testing.assert_allclose(again.moving, pairs.moving, atol=1e-12)
    np.testing.assert_allclose(again.fixed, pairs.fixed, atol=1e-12)


def test_what_programs_mean_by_their_numbers():
    """3D Slicer in RAS, elastix in indices, BigWarp in spacings from the first voxel."""
    place = MOVING.to_places(np.array([[3.0, 5.0, 7.0]]))[0]
    x, y, z = place
    markup = {"markups": [{"coordinateSystem": "RAS", "controlPoints": [{"label": "a", "position": [-x, -y, z]}]}]}
    both = [(name, json.dumps(markup).encode()) for name in ("a.mrk.json", "b.mrk.json")]
    np.testing.assert_allclose(parse_landmarks(both, frames=frames()).moving, [place])
    fcsv = f"# CoordinateSystem = 0\na,{-x!r},{-y!r},{z!r},0,0,0,1,1,1,0,a,,\n".replace("np.float64(", "").replace(
        ")", ""
    )
    both = [(name, fcsv.encode()) for name in ("a.fcsv", "b.fcsv")]
    np.testing.assert_allclose(parse_landmarks(both, frames=frames()).moving, [place])
    index = [("a.pts", b"index\n1\n3 5 7\n"), ("b.pts", b"index\n1\n3 5 7\n")]
    found = parse_landmarks(index, frames=frames())
    np.testing.assert_allclose(found.moving, [place])
    np.testing.assert_allclose(found.fixed, FIXED.to_places(np.array([[3.0, 5.0, 7.0]])))
    row = f'"Pt-0","true","{3 * 0.9}","{5 * 0.9}","{7 * 1.6}","3.0","{5 * 0.9}","{7 * 1.5}"\n'
    found = parse_landmarks([("a.csv", row.encode())], frames=frames())
    np.testing.assert_allclose(found.moving, [place])
    np.testing.assert_allclose(found.fixed, FIXED.to_places(np.array([[3.0, 5.0, 7.0]])))


HEADER = "moving_x,moving_y,moving_z,fixed_x,fixed_y,fixed_z"


# ---- Refusals: one line, status 2, nothing written ----


def written(files):
    return sorted(path.name for path in files.iterdir())


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("moving_x,moving_y,fixed_x,fixed_y\n1,2,3,4\n", "name the columns moving_x,moving_y,moving_z,fixed_x"),
        ('"Pt-0","true","1","2","3","4"\n', "landmarks have x and y alone, and the images are volumes"),
        (f"{HEADER}\n900,2,3,1,2,3\n", "moving landmark 1 at (900.0, 2.0, 3.0) lies outside the moving volume"),
        (f"{HEADER}\n3,4,5,7,8,9\n", "they look like indices of voxels"),
        ("x,y\n1,2\n", "moving_z"),
    ],
)  # fmt: skip
def test_landmarks_that_do_not_fit_are_named(files, text, said):
    (files / "bad.csv").write_text(text)
    before = written(files)
    assert said in refused(*asked(files, landmarks="bad.csv"))
    assert written(files) == before


def test_landmarks_with_the_signs_of_ras_are_told(files):
    pairs = pairs_of()
    turned = [-1.0, -1.0, 1.0]
    table(files / "ras.csv", LandmarkPairs(pairs.moving * turned, pairs.fixed * turned))
    assert "turn the signs of x and y: they are RAS" in refused(*asked(files, landmarks="ras.csv"))


def changed(path, place, content, to):
    data = bytearray(path.read_bytes())
    data[place : place + len(content)] = content
    to.write_bytes(data)


def test_damaged_volumes_are_refused_in_one_line(files):
    plain = files / "plain.nii"
    write_volume(plain, volume(MOVING), MOVING)
    code = struct.pack("<hh", 0, 1)  # of sform alone
    data = bytearray(plain.read_bytes())
    data[252:256] = code
    data[280:296] = struct.pack("<4f", 1.0, 0.5, 0.0, 0.0)
    (files / "shear.nii").write_bytes(data)
    data[280:296] = struct.pack("<4f", 0.0, 0.0, 0.0, 0.0)
    (files / "flat.nii").write_bytes(data)
    changed(plain, 42, struct.pack("<hhh", 30000, 30000, 30000), files / "huge.nii")
    (files / "cut.nii").write_bytes(plain.read_bytes()[:-100])
    (files / "cut.nii.gz").write_bytes((files / "moving.nii.gz").read_bytes()[:-500])
    (files / "short.nii.gz").write_bytes(gzip.compress(plain.read_bytes()[:-500]))
    (files / "junk.nrrd").write_bytes(b"hello" * 40)
    (files / "empty.mha").write_bytes(b"")
    (files / "junk.tif").write_bytes(b"II*\0" + b"\0" * 40)
    frames4 = itk.JoinSeries([itk.ReadImage(str(plain))] * 2)
    itk.WriteImage(frames4, str(files / "times.nii"))
    vectors = itk.Compose([itk.ReadImage(str(plain))] * 3)
    itk.WriteImage(vectors, str(files / "vectors.mha"))
    itk.WriteImage(itk.ReadImage(str(plain))[:, :, 3:4], str(files / "slice.nii"))
    said = {
        "shear.nii": "axes that are not orthogonal", "flat.nii": "axes that are not orthogonal",
        "huge.nii": "30000 x 30000 x 30000 voxels, more than", "cut.nii": "is cut off", "cut.nii.gz": "is cut off",
        "short.nii.gz": "is cut off", "junk.nrrd": "is damaged or no volume", "empty.mha": "is damaged or no volume",
        "times.nii": "holds 2 volumes", "vectors.mha": "has 3 numbers in each voxel", "slice.nii": "is no volume",
        "none.nii": "no such file", "pairs.csv": "unknown kind of volume", "junk.tif": "junk.tif",
    }  # fmt: skip
    before = written(files)
    for name, finding in said.items():
        assert finding in refused(*asked(files, fixed=name)), name
        if name not in ("pairs.csv", "junk.tif"):
            assert finding in refused(*asked(files, moving=name)), name
    assert written(files) == before


def test_outputs_that_cannot_be_are_refused(files):
    before = written(files)
    assert "let it end in .nii" in refused(*asked(files, out="out.png"))
    assert "let it end in .nii" in refused(*asked(files, out="out.nhdr"))
    assert "--field" in refused(*asked(files, "--field", files / "f.npz"))
    assert "--flip mirrors pictures" in refused(*asked(files, "--flip"))
    assert "two outputs have the same name" in refused(*asked(files, "--field", files / "out.nii.gz"))
    assert "would be overwritten" in refused(*asked(files, out="moving.nii.gz"))
    assert "no such file" in refused(*asked(files, fixed="x.nii")).lower()
    whole = np.zeros(MOVING.shape, np.int64)
    write_volume(files / "whole.mha", whole, MOVING)
    assert "int64" in refused(*asked(files, moving="whole.mha", out="out.tif"))
    (files / "whole.mha").unlink()
    assert written(files) == before


def test_volumes_and_pictures_do_not_go_together(files):
    from codegen.registration.images import write_image

    write_image(files / "flat.png", np.zeros((20, 20), np.uint8))
    assert "unknown kind of volume" in refused(*asked(files, fixed="flat.png"))
    assert "is a volume" in refused(*asked(files, moving="flat.png", fixed="moving.nii.gz", out="o.png"))


def test_the_page_is_for_pictures_and_says_so(files):
    done = CliRunner().invoke(main, ["app", str(files / "moving.nii.gz"), "--no-browser"])
    assert done.exit_code == 2
    (line,) = done.stderr.strip().splitlines()
    assert "moving.nii.gz is a volume (30 x 26 x 20 voxels), and the page is for pictures" in line


def test_units_must_be_the_same(files):
    tifffile.imwrite(files / "stack.tif", volume(MOVING, kind="u2"), photometric="minisblack")
    assert is_volume(files / "stack.tif")
    assert "is in mm" in refused(*asked(files, fixed="stack.tif"))


@pytest.mark.parametrize("missing", ["SimpleITK", "tifffile"])
def test_what_is_missing_is_named_with_the_command_that_installs_it(files, monkeypatch, missing):
    tifffile.imwrite(files / "stack.tif", volume(MOVING, kind="u2"), photometric="minisblack")
    monkeypatch.setitem(sys.modules, missing, None)
    before = written(files)
    name = "moving.nii.gz" if missing == "SimpleITK" else "stack.tif"
    with pytest.raises(ExtraError, match="pip install 'variational-codegen"):
        read_volume(files / name)
    if missing == "SimpleITK":
        assert "pip install 'variational-codegen[volumes]'" in refused(*asked(files))
    assert written(files) == before
