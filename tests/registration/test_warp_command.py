"""`codegen warp` from files to files: directions, samples kept, exit statuses, reports, batches."""

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from volume_samples import refused, run

from codegen.registration import register, warp
from codegen.registration.formats import read_landmarks, write_landmarks
from codegen.registration.grid import Grid
from codegen.registration.images import read_image, write_image
from codegen.registration.pairs import LandmarkPairs

pytestmark = pytest.mark.usefixtures("solver")
CORNERS = np.array([[3.0, 4.0], [24.0, 5.0], [5.0, 20.0], [22.0, 18.0], [13.0, 11.0]])
SHAPE = (24, 30)


def picture(shape=SHAPE, kind="u1", seed=0):
    return (np.random.default_rng(seed).random(shape) * (1.0 if kind[0] == "f" else 250.0)).astype(kind)


@pytest.fixture
def files(tmp_path):
    """A moving and a fixed image in colour, and landmarks that move by a pixel or two."""
    write_image(tmp_path / "moving.png", picture((*SHAPE, 3)))
    write_image(tmp_path / "fixed.png", picture((26, 28), seed=1))
    moved = CORNERS + np.random.default_rng(2).normal(size=CORNERS.shape)
    names = ("<i>eye</i>", "b", "c", "d", "e")
    write_landmarks(tmp_path / "pairs.csv", pairs=LandmarkPairs(CORNERS, moved, names))
    return tmp_path


def test_the_image_is_what_the_core_makes_of_it_and_the_record_says_how(files):
    out, report, field = files / "out.png", files / "out.html", files / "out.npz"
    done = run(
        files / "moving.png", "--landmarks", files / "pairs.csv", "--fixed", files / "fixed.png", "--out", out,
        "--report", report, "--field", field, "--interpolation", "cubic", "--json",
    )  # fmt: skip
    record = json.loads(done.stdout)
    assert (record["status"], record["direction"], record["task"]) == ("solved", "moving to fixed", "warp")
    pairs = read_landmarks(files / "pairs.csv")
    registration = register(pairs, SHAPE, fixed_shape=(26, 28))
    expected = warp(picture((*SHAPE, 3)), registration, interpolation="cubic")
    np.testing.assert_array_equal(read_image(out).pixels, expected)
    assert read_image(out).pixels.shape == (26, 28, 3)
    seen = record["summary"]
    assert record["steps"] == registration.steps
    assert record["residual"] == max(seen["residuals"])
    assert record["residual"] < 1e-6
    assert 0.0 < seen["det_min"] < 1.0 < seen["det_max"]
    assert (seen["folded"], seen["first_fold"], seen["names"]) == (0, None, list(pairs.names))
    assert seen["round_trip"] < 1e-8
    assert len(seen["leave_one_out"]) == 5
    alone = register(pairs.without(2), SHAPE, fixed_shape=(26, 28)).map_points(CORNERS[2:3])[0]
    assert seen["leave_one_out"][2] == pytest.approx(np.linalg.norm(alone - pairs.fixed[2]), rel=1e-2)
    assert set(record["seconds"]) >= {"read", "build", "solve", "certify", "warp", "write"}
    assert field.stat().st_size > 0
    text = report.read_text()
    assert not re.search(r"(src|href)=\"(?!data:image/png;base64,)", text)
    assert "&lt;i&gt;eye&lt;/i&gt;" in text
    assert "<i>" not in text
    assert text.count("<figure>") == 7
    assert str(files) not in text


@pytest.mark.parametrize(
    ("name", "kind", "shape"),
    [("a.png", "u1", (*SHAPE, 4)), ("a.png", "u2", SHAPE), ("a.png", "u2", (*SHAPE, 3)), ("a.tif", "u2", (*SHAPE, 2)),
     ("a.tif", "f4", (*SHAPE, 3)), ("a.tif", "f8", SHAPE)],
)  # fmt: skip
def test_identity_landmarks_leave_every_kind_of_image_as_it_is(name, kind, shape, tmp_path):
    pixels = picture(shape, kind)
    write_image(tmp_path / name, pixels)
    write_landmarks(tmp_path / "same.csv", pairs=LandmarkPairs(CORNERS, CORNERS))
    out = tmp_path / f"out{name}"
    run(tmp_path / name, "--landmarks", tmp_path / "same.csv", "--out", out, "--interpolation", "nearest")
    again = read_image(out).pixels
    assert again.dtype == pixels.dtype
    np.testing.assert_array_equal(again, pixels)


def test_directions_are_as_named(tmp_path):
    """The fixed image lies 3 pixels to the right of the moving one, and 2 pixels below."""
    moving = picture()
    fixed = np.zeros_like(moving)
    fixed[2:, 3:] = moving[:-2, :-3]
    write_image(tmp_path / "moving.png", moving)
    write_image(tmp_path / "fixed.png", fixed)
    points = CORNERS + np.array([3.0, 2.0])
    for paths, pairs in (
        ((tmp_path / "a.pts", tmp_path / "b.pts"), LandmarkPairs(CORNERS, points)),
        ((tmp_path / "a.mrk.json", tmp_path / "b.mrk.json"), LandmarkPairs(CORNERS, points)),
    ):
        name = "elastix" if paths[0].suffix == ".pts" else "slicer"
        write_landmarks(*paths, pairs=pairs, name=name)
        given = [text for path in paths for text in ("--landmarks", path)]
        both = (*given, "--fixed", tmp_path / "fixed.png", "--interpolation", "nearest", "--out")
        run(tmp_path / "moving.png", *both, tmp_path / "forward.png")
        np.testing.assert_array_equal(read_image(tmp_path / "forward.png").pixels, fixed)
        run(tmp_path / "moving.png", *both, tmp_path / "back.png", "--inverse")
        back = read_image(tmp_path / "back.png").pixels
        np.testing.assert_array_equal(back[:-2, :-3], moving[:-2, :-3])
        assert not back[-2:].any()


def test_what_is_wrong_is_said_in_a_line_and_nothing_is_written(files):
    before = {path: path.read_bytes() for path in files.iterdir()}
    good = (files / "moving.png", "--landmarks", files / "pairs.csv")
    write_image(files / "deep.tif", picture(kind="u2"))
    before[files / "deep.tif"] = (files / "deep.tif").read_bytes()
    for arguments, finding in (
        ((*good,), "--out is missing"),
        ((files / "moving.png", "--out", files / "o.png"), "--landmarks is missing"),
        ((*good, "--out", files / "o.gif"), "o.gif: unknown kind of image"),
        ((*good, "--out", files / "moving.png"), "moving.png is read and would be overwritten"),
        ((*good, "--out", files / "no" / "o.png"), "--out: there is no folder"),
        ((*good, "--out", files / "o.png", "--inverse"), "--inverse brings the fixed image"),
        ((*good, "--out", files / "o.png", "--sigma", "-1"), "--sigma -1"),
        ((*good, "--out", files / "o.png", "--sigma", "much"), "--sigma much"),
        ((*good, "--out", files / "o.png", "--report", files / "o.pdf"), "--report"),
        ((*good, "--out", files / "o.png", "--field", files / "o.txt"), "--field"),
        ((*good, "--out", files / "o.png", "--fixed", files / "none.png"), "none.png cannot be read"),
        ((*good, "--out", files / "o.png", "--scheme", "nonsense"), "nonsense"),
        ((*good, "--landmarks", files / "pairs.csv", "--out", files / "o.png"), "pairs.csv is complete, and 2 were"),
        ((files / "none.png", *good[1:], "--out", files / "o.png"), "none.png cannot be read"),
        ((files / "pairs.csv", "--out", files / "o"), "pairs.csv: the columns are"),
        ((files, "--out", files), "--out is missing, or is"),
        ((files / "deep.tif", *good[1:], "--out", files / "o.jpg"), "JPEG holds 8-bit"),
    ):
        assert finding in refused(*arguments)
    assert {path: path.read_bytes() for path in files.iterdir()} == before


def crossing(files, apart):
    """Landmarks some pixels apart that part and change places."""
    moving, fixed = CORNERS.copy(), CORNERS.copy()
    moving[:2], fixed[:2] = [[13.0, 5.0], [13.0 + apart, 5.0]], [[20.0, 5.0], [6.0, 5.0]]
    write_landmarks(files / "crossing.csv", pairs=LandmarkPairs(moving, fixed))
    return files / "moving.png", "--landmarks", files / "crossing.csv", "--align", "none", "--json"


def test_where_no_map_is_found_the_status_is_1_and_the_report_shows_the_images(files):
    out, report = files / "out.png", files / "out.html"
    out.write_bytes(b"old")
    done = run(*crossing(files, 1e-9), "--out", out, "--report", report, expect=1)
    record = json.loads(done.stdout)
    assert record["status"] == "not converged"
    assert "landmarks 1 and 2" in record["message"]
    assert "landmarks 1 and 2" in done.stderr
    assert out.read_bytes() == b"old"
    assert report.read_text().count("<figure>") == 1


def test_where_the_map_folds_the_status_is_1_and_the_place_is_named(files):
    """Two explicit steps carry the landmarks across each other."""
    out = files / "out.png"
    done = run(*crossing(files, 1.0), "--out", out, "--steps", 2, expect=1)
    record = json.loads(done.stdout)
    x, y = record["summary"]["first_fold"]
    assert record["status"] == "folded"
    assert record["summary"]["folded"] > 0
    assert f"the first at ({x:g}, {y:g})" in done.stderr
    assert np.hypot(x - 13.0, y - 5.0) < 10.0
    assert not out.exists()


def test_folders_and_tables_go_on_after_bad_pairs_and_are_taken_up_again(files):
    folder, out = files / "in", files / "out"
    folder.mkdir()
    for name in ("a", "b", "c"):
        write_image(folder / f"{name}.png", picture(seed=ord(name)))
        (folder / f"{name}.csv").write_bytes((files / "pairs.csv").read_bytes())
    (folder / "b.png").write_bytes((folder / "b.png").read_bytes()[:50])
    pages = files / "pages"
    done = run(folder, "--out", out, "--report", pages, "--steps", 5, "--json", expect=1)
    record = json.loads(done.stdout)
    assert (record["pairs"], record["unchanged"], len(record["failed"])) == (3, 0, 1)
    assert "b.png is damaged" in done.stderr
    assert sorted(path.name for path in out.iterdir()) == ["a.png", "c.png", "summary.csv"]
    text = (pages / "index.html").read_text()
    assert sorted(re.findall(r'href="([^"]*)"', text)) == ["a.html", "c.html"]
    assert text.index("b.png") < text.index("a.png")  # what failed comes first
    write_image(folder / "b.png", picture(seed=9))
    stamps = {path: path.stat().st_mtime_ns for path in out.glob("*.png")}
    assert "1 pairs warped, 2 unchanged, 0 failed" in " ".join(run(folder, "--out", out, "--steps", 5).stdout.split())
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in stamps.items())
    table = files / "table.csv"
    table.write_text("moving,landmarks,out\nin/a.png,pairs.csv,one.png\nin/b.png,pairs.csv,two.png\n")
    run(table, "--steps", 5)
    np.testing.assert_array_equal(read_image(files / "one.png").pixels, read_image(out / "a.png").pixels)
    assert (files / "table.summary.csv").read_text().count("solved") == 2


def test_help_imports_nothing_slow():
    code = "import sys, codegen.cli; print([m for m in ('numba', 'sympy', 'PIL', 'numpy') if m in sys.modules])"
    folder = Path(__file__).parents[2]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=folder, check=False)
    assert done.stdout.strip() == "[]", done.stderr


def test_landmarks_that_mirror_the_image_are_refused_and_flipped(files):
    """With --flip the mirror image of a picture is brought back, pixel by pixel."""
    pixels, pairs = picture(SHAPE), files / "mirrored.csv"
    write_image(files / "grey.png", pixels)
    write_landmarks(pairs, pairs=LandmarkPairs(CORNERS * [-1, 1] + [SHAPE[1] - 1, 0], CORNERS))
    asked = (files / "grey.png", "--landmarks", pairs, "--out", files / "flipped.png")
    assert "--flip" in refused(*asked)
    run(*asked, "--flip")
    np.testing.assert_array_equal(read_image(files / "flipped.png").pixels, pixels[:, ::-1])


def test_sigma_loss_and_alignment_are_told(files):
    generator = np.random.default_rng(5)
    moving = generator.uniform(2, 22, (30, 2))
    fixed = moving + generator.normal(size=moving.shape) * 0.3
    fixed[4] += [6.0, 5.0]
    write_landmarks(files / "noisy.csv", pairs=LandmarkPairs(moving, fixed))
    asked = (files / "moving.png", "--landmarks", files / "noisy.csv", "--out", files / "out.png")
    record = json.loads(run(*asked, "--sigma", "auto", "--loss", "tukey", "--json").stdout)
    assert 0.2 < record["sigma"] < 0.45
    assert record["summary"]["outliers"] == ["5"]
    assert record["summary"]["folded"] == 0
    assert "by leave-one-out" in record["summary"]["alignment_choice"]
    assert "give a --sigma" in refused(*asked, "--loss", "huber")


def test_errors_have_the_unit_that_the_fixed_picture_carries(files):
    tifffile = pytest.importorskip("tifffile")
    tifffile.imwrite(
        files / "fixed.tif", picture((26, 28), seed=1), imagej=True, resolution=(2.0, 4.0), metadata={"unit": "mm"}
    )
    asked = ["--landmarks", files / "pairs.csv", "--fixed", files / "fixed.tif", "--sigma", "0.5", "--out"]
    record = json.loads(run(files / "moving.png", *asked, files / "o.png", "--json").stdout)
    pairs = read_landmarks(files / "pairs.csv")
    # The same in millimetres: pixels of the moving picture count as squares as large as those of the fixed one.
    side, axes = np.sqrt(0.5 * 0.25), ((1.0, 0.0), (0.0, 1.0))
    lengths = LandmarkPairs(side * pairs.moving, pairs.fixed * [0.5, 0.25])
    grids = (Grid(size, (0.0, 0.0), spacing, axes, "mm") for size, spacing in
             ((SHAPE[::-1], (side, side)), ((28, 26), (0.5, 0.25))))  # fmt: skip
    moving, fixed = grids
    found = register(lengths, moving, fixed_shape=fixed, sigma=0.5 * side, tolerance=0.001)
    misses = found.map_points(lengths.moving) - lengths.fixed
    seen = record["summary"]
    assert (seen["length_unit"], seen["pixel_lengths"]) == ("mm", [0.5, 0.25])
    np.testing.assert_allclose(seen["residual_lengths"], np.hypot(*misses.T), rtol=1e-2)
    assert len(seen["leave_one_out_lengths"]) == 5
    said = " ".join(run(files / "moving.png", *asked, files / "o.png", "--report", files / "o.html").stdout.split())
    expected = r"residual [0-9.]+ px at most, standard deviation [0-9.]+ px \([0-9.]+ and [0-9.]+ mm\)"
    assert re.search(expected, said)
    assert "<th>residual, mm</th><th>left out, mm</th>" in (files / "o.html").read_text()
