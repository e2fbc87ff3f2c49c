"""Volumes that `codegen warp` refuses: in one line, with status 2, and nothing is written."""

import gzip
import struct
import sys

import numpy as np
import pytest
from typer.testing import CliRunner
from volume_samples import MOVING, asked, filled, pairs_of, refused, table, volume

from codegen.cli import main
from codegen.errors import ExtraError
from codegen.registration.images import write_image
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.volumes import is_volume, read_volume, write_volume

itk = pytest.importorskip("SimpleITK")
tifffile = pytest.importorskip("tifffile")
pytestmark = pytest.mark.usefixtures("space_solver")

HEADER = "moving_x,moving_y,moving_z,fixed_x,fixed_y,fixed_z"


@pytest.fixture
def files(tmp_path):
    return filled(tmp_path)


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
    with pytest.raises(ExtraError, match=f"pip install {missing}"):
        read_volume(files / name)
    if missing == "SimpleITK":
        assert "pip install SimpleITK" in refused(*asked(files))
    assert written(files) == before
