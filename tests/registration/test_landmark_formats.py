"""Landmark files: what the programs' forms mean in pixels, round trips, and what is refused."""

import json
import os

import numpy as np
import pytest
from landmark_samples import REFUSED, SAMPLES, SHAPE

from codegen.errors import PointsError
from codegen.registration.formats import FORMATS, landmark_texts, parse_landmarks, read_landmarks
from codegen.registration.formats import write_landmarks as write
from codegen.registration.formats.base import MOST_BYTES, MOST_LANDMARKS, Frames
from codegen.registration.pairs import LandmarkPairs

FRAMES = Frames(SHAPE, SHAPE, "left.jpg", "right.jpg")
ENDINGS = {"csv": (".csv",), "bigwarp": (".csv",), "elastix": (".a.pts", ".b.pts"), "tps": (".tps",),
           "slicer": (".a.mrk.json", ".b.mrk.json"), "fcsv": (".a.fcsv", ".b.fcsv")}  # fmt: skip


def contents(files):
    return [(name, text.encode()) for name, text in files]


def awkward_pairs(count=50):
    """Numbers without short decimals, signs and sizes mixed, and names with what tables use as marks."""
    random = np.random.default_rng(3)
    moving, fixed = random.normal(size=(2, count, 2)) * 10.0 ** random.integers(-3, 5, (2, count, 1))
    return LandmarkPairs(moving, fixed, tuple(f'Pt "{k}", §;' for k in range(count)))


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda sample: sample.name)
def test_files_of_each_program_mean_what_their_documents_say(sample):
    pairs = parse_landmarks(contents(sample.files), frames=FRAMES)
    np.testing.assert_allclose(pairs.moving, sample.moving, rtol=0, atol=1e-12)
    np.testing.assert_allclose(pairs.fixed, sample.fixed, rtol=0, atol=1e-12)
    assert pairs.names == sample.names


@pytest.mark.parametrize("form", FORMATS)
def test_every_format_has_a_sample_and_returns_what_it_was_given(form, tmp_path):
    assert any(sample.form == form for sample in SAMPLES)
    pairs = awkward_pairs()
    paths = [tmp_path / f"pairs{ending}" for ending in ENDINGS[form]]
    write(*paths, pairs=pairs, frames=FRAMES, name=form)
    again = read_landmarks(*paths, frames=FRAMES)
    for before, after in ((pairs.moving, again.moving), (pairs.fixed, again.fixed)):
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-12 * max(1.0, np.abs(before).max()))
        if form != "tps":  # whose y is counted from the lower edge
            assert (after == before).all()
    assert again.names == (pairs.names if form in ("csv", "bigwarp", "slicer", "fcsv") else again.names)
    texts = [path.read_bytes() for path in paths]
    write(*paths, pairs=again, frames=FRAMES, name=form)
    if form != "tps":
        assert [path.read_bytes() for path in paths] == texts
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(path.name for path in paths)


@pytest.mark.parametrize(("files", "finding"), REFUSED, ids=lambda value: value if isinstance(value, str) else "")
def test_what_cannot_be_read_is_named(files, finding):
    with pytest.raises(PointsError) as caught:
        parse_landmarks(contents(files), frames=FRAMES)
    assert finding in str(caught.value)
    assert caught.value.remedy


def test_heights_are_asked_for_where_y_points_up():
    (sample,) = [sample for sample in SAMPLES if sample.form == "tps"]
    with pytest.raises(PointsError, match="height of the fixed image is not known"):
        parse_landmarks(contents(sample.files), frames=Frames(moving_shape=SHAPE))
    taller = parse_landmarks(contents(sample.files), frames=Frames(SHAPE, (SHAPE[0] + 10, 9)))
    np.testing.assert_allclose(taller.fixed[:, 1], np.array(sample.fixed)[:, 1] + 10)
    with pytest.raises(PointsError, match="height of the moving image"):
        landmark_texts(awkward_pairs(), "tps")


def test_specimens_are_chosen_by_the_names_of_the_images():
    blocks = [f"LM=1\n{k} {k}\nIMAGE=C:\\photos\\S{k}.JPG\n" for k in range(5)]
    data = [("all.tps", "".join(blocks).encode())]
    pairs = parse_landmarks(data, frames=Frames((10, 10), (10, 10), "s3.jpg", "folder/s1.jpg"))
    assert pairs.moving.tolist() == [[3.0, 6.0]]
    assert pairs.fixed.tolist() == [[1.0, 8.0]]
    with pytest.raises(PointsError, match=r"5 specimens, and their IMAGE= lines do not name 's3\.jpg' and 's9\.jpg'"):
        parse_landmarks(data, frames=Frames((10, 10), (10, 10), "s3.jpg", "s9.jpg"))
    two = [("two.tps", "".join(blocks[:2]).encode())]
    assert parse_landmarks(two, frames=Frames((10, 10), (10, 10), "s1.jpg", "x.jpg")).moving.tolist() == [[1.0, 8.0]]


def test_points_that_are_not_placed_are_left_out_in_both_lists_and_labels_match():
    sample = next(sample for sample in SAMPLES if sample.name == "Slicer, LPS")
    moving, fixed = (json.loads(text) for _, text in sample.files)
    moving["markups"][0]["controlPoints"][1]["positionStatus"] = "undefined"
    fixed["markups"][0]["controlPoints"].reverse()
    pairs = parse_landmarks(
        [(f"{name}.json", json.dumps(text).encode()) for name, text in (("a", moving), ("b", fixed))]
    )
    assert pairs.names == ("F-1", "F-3")
    np.testing.assert_array_equal(pairs.fixed, np.array(sample.fixed)[[0, 2]])


def test_a_million_lines_are_refused_soon(tmp_path):
    path = tmp_path / "many.csv"
    for row, finding in (("1,2,3,4\n", f"more than {MOST_LANDMARKS} landmarks"), ("1.25,2.25,3.25,4.25\n", "8 MB")):
        path.write_text("moving_x,moving_y,fixed_x,fixed_y\n" + row * 1_000_000)
        with pytest.raises(PointsError, match=finding):
            read_landmarks(path)
    assert os.path.getsize(path) > MOST_BYTES


def test_a_file_that_cannot_be_written_leaves_the_old_one(tmp_path):
    path = tmp_path / "pairs.tps"
    path.write_text("old")
    with pytest.raises(PointsError, match="height"):
        write(path, pairs=awkward_pairs())
    with pytest.raises(PointsError, match="takes 2 files, and 1 were given"):
        write(path, pairs=awkward_pairs(), name="elastix")
    assert path.read_text() == "old"
    with pytest.raises(PointsError, match=r"no/such\.csv cannot be read"):
        read_landmarks(tmp_path / "no" / "such.csv")
