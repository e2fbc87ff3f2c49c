"""Pictures as NIfTI, NRRD and MetaImage in the page: pixels, lengths in the file's unit, and what is refused."""

import gzip

import numpy as np
import pytest
from typer.testing import CliRunner

from codegen.cli import main
from codegen.errors import ImageError
from codegen.registration.app import reading
from codegen.registration.images import read_image

itk = pytest.importorskip("SimpleITK")
nibabel = pytest.importorskip("nibabel")

PIXELS = np.arange(20, dtype=np.int16).reshape(4, 5) - 7


def written(path, pixels=PIXELS, spacing=(0.5, 0.25), **options):
    """The bytes of a file that SimpleITK makes."""
    image = itk.GetImageFromArray(pixels, **options)
    image.SetSpacing(spacing)
    itk.WriteImage(image, str(path))
    return path.read_bytes()


def nifti(path, unit, pixels=PIXELS.T, size=(0.5, 0.25, 1.0)):
    """The bytes of a file that nibabel makes, with a unit of its own."""
    image = nibabel.Nifti1Image(pixels, np.diag([*size, 1.0]))
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path.read_bytes()


def nrrd(lines):
    head = ["NRRD0004", "type: short", "endian: little", "dimension: 2", "sizes: 5 4", "encoding: raw", *lines, "", ""]
    return "\n".join(head).encode() + PIXELS.astype("<i2").tobytes()


@pytest.mark.parametrize("kind", ["nii", "nii.gz", "nrrd", "mha"])
def test_a_picture_is_read_with_the_size_of_its_pixels_whatever_its_name(tmp_path, kind):
    found = reading.picture_from(written(tmp_path / f"a.{kind}"), "scan.bin")
    np.testing.assert_array_equal(found.pixels, PIXELS)
    assert found.pixels.dtype == np.int16
    assert found.kind == {"nrrd": "NRRD", "mha": "MetaImage"}.get(kind, "NIfTI")
    assert found.name == "scan.bin"
    assert (found.spacing.x, found.spacing.y, found.spacing.unit) == (0.5, 0.25, "mm")


@pytest.mark.parametrize(("shape", "expected"), [((1, 4, 5), (2, 3)), ((4, 1, 5), (2, 5)), ((4, 5, 1), (3, 5))])
def test_a_slice_along_any_axis_is_a_picture(tmp_path, shape, expected):
    found = reading.picture_from(written(tmp_path / "a.mha", PIXELS.reshape(shape), (2.0, 3.0, 5.0)), "a.mha")
    np.testing.assert_array_equal(found.pixels, PIXELS)
    assert (found.spacing.x, found.spacing.y) == expected


@pytest.mark.parametrize(
    ("shape", "axes", "expected"),
    [
        ((5, 4, 1), np.diag([-1.0, -1.0, 1.0]), ("R", "L", "A", "P")),  # as radiologists look at an axial slice
        ((5, 4, 1), np.diag([1.0, 1.0, 1.0]), ("L", "R", "P", "A")),
        ((5, 1, 4), np.diag([-1.0, 1.0, -1.0]), ("R", "L", "S", "I")),  # coronal
        ((1, 5, 4), np.diag([1.0, -1.0, -1.0]), ("A", "P", "S", "I")),  # sagittal
        ((5, 4, 1), [[-0.8, 0.6, 0.0], [-0.6, -0.8, 0.0], [0.0, 0.0, 1.0]], ("RA", "LP", "AL", "PR")),
        ((5, 4, 1), [[-0.98, 0.2, 0.0], [-0.2, -0.98, 0.0], [0.0, 0.0, 1.0]], ("R", "L", "A", "P")),
    ],
)
def test_edges_are_named_by_the_side_of_the_patient(tmp_path, shape, axes, expected):
    """The affine map of NIfTI leads to right, anterior, superior."""
    affine = np.eye(4)
    affine[:3, :3] = axes
    image = nibabel.Nifti1Image(PIXELS.T.reshape(shape), affine)
    nibabel.save(image, tmp_path / "a.nii.gz")
    placed = itk.ReadImage(str(tmp_path / "a.nii.gz"))
    itk.WriteImage(placed, str(tmp_path / "a.nrrd"))
    itk.WriteImage(placed, str(tmp_path / "a.mha"))
    for kind in ("nii.gz", "nrrd", "mha"):
        found = reading.picture_from((tmp_path / f"a.{kind}").read_bytes(), "a")
        assert found.edges == expected
        np.testing.assert_array_equal(found.pixels, PIXELS)


def test_edges_have_no_names_where_a_file_places_nothing_in_space(tmp_path):
    assert reading.picture_from(written(tmp_path / "a.nii"), "a").edges is None  # in two dimensions
    assert reading.picture_from(nrrd([]), "a").edges is None
    image = nibabel.Nifti1Image(PIXELS.T[..., None], None)
    image.header["qform_code"] = image.header["sform_code"] = 0
    nibabel.save(image, tmp_path / "b.nii")
    assert reading.picture_from((tmp_path / "b.nii").read_bytes(), "b").edges is None


def test_colours_are_kept(tmp_path):
    pixels = np.random.default_rng(0).integers(0, 255, (4, 5, 3)).astype(np.uint8)
    for kind in ("nii", "nrrd", "mha"):
        found = reading.picture_from(written(tmp_path / f"a.{kind}", pixels, isVector=True), "a")
        np.testing.assert_array_equal(found.pixels, pixels)


@pytest.mark.parametrize(
    ("unit", "expected"),
    [("unknown", (0.5, "mm")), ("mm", (0.5, "mm")), ("micron", (0.5, "µm")), ("meter", (500, "mm"))],
)
def test_units_of_nifti(tmp_path, unit, expected):
    found = reading.picture_from(nifti(tmp_path / "a.nii.gz", unit), "a").spacing
    assert (pytest.approx(found.x), found.unit) == expected


def test_units_of_nrrd():
    for lines in (
        ["spacings: 0.5 0.25", 'units: "um" "um"'],
        ["space dimension: 2", "space directions: (0.5,0) (0,0.25)", 'space units: "um" "um"'],
    ):
        found = reading.picture_from(nrrd(lines), "a").spacing
        assert (found.x, found.y, found.unit) == (0.5, 0.25, "µm")


def test_a_size_of_one_means_something_where_there_is_a_unit(tmp_path):
    one = (1.0, 1.0, 1.0)
    assert reading.picture_from(written(tmp_path / "a.mha", spacing=(1.0, 1.0)), "a").spacing is None
    assert reading.picture_from(nrrd([]), "a").spacing is None
    assert reading.picture_from(nifti(tmp_path / "a.nii", "unknown", size=one), "a").spacing is None
    assert reading.picture_from(nifti(tmp_path / "a.nii", "mm", size=one), "a").spacing.unit == "mm"
    assert reading.picture_from(nrrd(['units: "cm" "cm"']), "a").spacing.unit == "cm"


@pytest.fixture
def refusal():
    def refused(data, name):
        with pytest.raises(ImageError) as caught:
            reading.picture_from(data, name)
        assert "codegen-" not in str(caught.value)  # no names of temporary folders
        return str(caught.value)

    return refused


def test_volumes_are_refused_in_one_line_that_says_what_takes_them(tmp_path, refusal):
    for kind in ("nii.gz", "nrrd", "mha"):
        said = refusal(written(tmp_path / f"a.{kind}", np.zeros((6, 4, 5), "u1"), (1.0, 1.0, 2.0)), f"brain.{kind}")
        assert f"brain.{kind} is a volume (5 x 4 x 6 voxels), and the page is for pictures" in said
        assert "codegen warp" in said
        assert "\n" not in said


def test_files_that_name_others_are_not_followed(tmp_path, refusal):
    secret = tmp_path / "secret.raw"
    secret.write_bytes(bytes(range(40)))
    for lines in ([f"data file: {secret}"], [f"datafile: {secret}"], [f"DATA FILE: {secret}"]):
        assert "names another file" in refusal(nrrd(lines), "a.nrrd")
        assert "names another file" in refusal(nrrd(lines).replace(b"\n", b"\r\n"), "a.nrrd")
    long = [f"# {'x' * 70}"] * 2000
    assert "names another file" in refusal(nrrd([*long, f"data file: {secret}"]), "a.nrrd")
    written(tmp_path / "a.mhd")
    header = (tmp_path / "a.mhd").read_bytes().replace(b"a.raw", str(secret).encode())
    comments = b"".join(b"Comment = %s\n" % (b"x" * 70) for _ in range(2000))
    hidden = b"Comment = ElementDataFile = LOCAL\n" + header
    for variant in (header, header.replace(b"DataFile =", b"DataFile:"), comments + header, hidden):
        for kind in ("mhd", "mha"):
            assert "names another file" in refusal(variant, f"a.{kind}")
    assert "names another file" in refusal(nrrd([f"data file: {secret}"]), "a.png")  # whatever it is called


def test_damaged_and_unfit_files_are_refused(tmp_path, refusal):
    whole = {
        kind: written(tmp_path / f"a.{kind}", np.tile(PIXELS, (20, 20))) for kind in ("nii", "nii.gz", "nrrd", "mha")
    }
    for kind, data in whole.items():
        assert f"cut.{kind}" in refusal(data[: len(data) * 3 // 5], f"cut.{kind}")
    assert "no PNG" in refusal(gzip.compress(b"nothing"), "a.nii.gz").replace("is a volume", "no PNG")
    assert "2 numbers in each pixel" in refusal(
        written(tmp_path / "v.mha", np.zeros((4, 5, 2)), isVector=True), "v.mha"
    )
    assert "samples of int64" in refusal(written(tmp_path / "i.nrrd", PIXELS.astype("i8")), "i.nrrd")
    large = nrrd([]).replace(b"sizes: 5 4", b"sizes: 500000 400000")
    assert "more than" in refusal(large, "large.nrrd")
    many = nrrd(["kinds: vector domain domain"]).replace(b"dimension: 2", b"dimension: 3")
    many = many.replace(b"sizes: 5 4", b"sizes: 1000000000 5 4")
    assert "1000000000 numbers in each pixel" in refusal(many, "many.nrrd")
    bomb = bytearray(nifti(tmp_path / "b.nii", "mm"))
    assert "cut off" in refusal(gzip.compress(bytes(bomb[:353])), "b.nii.gz")


def test_a_volume_on_the_command_line_is_refused_before_a_page_is_served(tmp_path):
    written(tmp_path / "brain.nii.gz", np.zeros((6, 4, 5), "u1"), (1.0, 1.0, 2.0))
    done = CliRunner().invoke(main, ["app", str(tmp_path / "brain.nii.gz"), "--no-browser"])
    assert done.exit_code == 2
    (line,) = done.stderr.strip().splitlines()
    assert "brain.nii.gz is a volume" in line


def test_read_image_is_for_pictures_still(tmp_path):
    written(tmp_path / "a.nrrd")
    with pytest.raises(ImageError, match="is a volume"):
        read_image(tmp_path / "a.nrrd")
