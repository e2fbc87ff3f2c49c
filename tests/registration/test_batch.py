"""Batches: which files belong together, what one bad pair does to the others, and what is not done again."""

import csv
import re

import numpy as np
import pytest

from codegen.errors import ArgumentError, ImageError
from codegen.registration import batch
from codegen.registration.batch import Places, jobs_in_folder, jobs_in_table, run_all
from codegen.registration.images import write_image
from codegen.registration.jobs import Options, Result

HEADER = "moving_x,moving_y,fixed_x,fixed_y\n"


@pytest.fixture
def folder(tmp_path):
    """Images with landmarks in every way in which they can have some, and one without."""
    made = tmp_path / "in"
    made.mkdir()
    for name in ("a.png", "b.jpg", "c.TIF", "d.png", "e.png"):
        write_image(made / name, np.zeros((6, 5), np.uint8))
    for name in ("a.csv", "b.tps", "c.moving.pts", "c.fixed.pts", "d.moving.mrk.json", "d.fixed.mrk.json"):
        (made / name).write_text(HEADER + "1,1,2,2\n")
    (made / "e.moving.pts").write_text("half of a pair")
    return made


def stand_in(job, options, record=None):
    """Instead of a registration: an image is written, or the pair fails as its name says."""
    if job.moving.stem == "b":
        raise ImageError("b is damaged", "give another")
    if job.moving.stem == "d":
        raise ZeroDivisionError("a defect")
    status = "not converged" if job.moving.stem == "c" else "solved"
    if status == "solved":
        for path in job.written:
            path.write_bytes(b"image")
    files = {"moving": str(job.moving), "fixed": None, "landmarks": [str(path) for path in job.landmarks]}
    found = {"status": status, "message": "as told", "summary": {"landmarks": 1}, "seconds": {}}
    record = {**files, "out": str(job.out), **found}
    return Result(record, None, None, None)


def _silent(done, text):
    """Nobody watches."""


def test_files_of_one_stem_belong_together(folder, tmp_path):
    jobs, without = jobs_in_folder(folder, Places(tmp_path / "out", tmp_path / "f", tmp_path / "r"), None, ())
    assert [job.moving.name for job in jobs] == ["a.png", "b.jpg", "c.TIF", "d.png"]
    assert [[path.name for path in job.landmarks] for job in jobs] == [
        ["a.csv"], ["b.tps"], ["c.moving.pts", "c.fixed.pts"], ["d.moving.mrk.json", "d.fixed.mrk.json"],
    ]  # fmt: skip
    assert [path.name for path in without] == ["e.png"]
    assert [path.relative_to(tmp_path).as_posix() for path in jobs[0].written] == ["f/a.npz", "r/a.html", "out/a.png"]
    (folder / "a.tps").write_text("LM=0\n")
    with pytest.raises(ArgumentError, match=r"a\.csv and a\.tps both belong to a\.png"):
        jobs_in_folder(folder, Places(tmp_path), None, ())


def test_one_fixed_image_and_one_landmark_file_may_serve_all(folder, tmp_path):
    jobs, without = jobs_in_folder(folder, Places(tmp_path), folder / "e.png", (folder / "a.csv",))
    assert [job.moving.name for job in jobs] == ["a.png", "b.jpg", "c.TIF", "d.png"]
    assert {job.fixed for job in jobs} == {folder / "e.png"}
    assert {job.landmarks for job in jobs} == {(folder / "a.csv",)}
    assert without == []
    jobs, _ = jobs_in_folder(folder, Places(tmp_path), tmp_path, ())
    assert jobs[0].fixed == tmp_path / "a.png"


def test_bad_pairs_do_not_stop_the_others(folder, tmp_path):
    jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
    told = []
    done = run_all(jobs, Options(), tmp_path / "summary.csv", lambda done, text: told.append((done, text)), stand_in)
    assert [line["status"] for line in done.lines] == ["solved", "wrong input", "not converged", "defect"]
    assert len(done.failed) == 3
    assert told == [(0, "a.png"), (1, "b.jpg"), (2, "c.TIF"), (3, "d.png")]
    with (tmp_path / "summary.csv").open(newline="") as file:
        assert [*csv.DictReader(file)] == [*done.lines]
    assert "b is damaged; give another" in done.lines[1]["message"]
    assert "ZeroDivisionError: a defect" in done.lines[3]["message"]


def test_only_what_changed_is_done_again(folder, tmp_path):
    summary = tmp_path / "summary.csv"
    seen = []

    def counting(job, options):
        seen.append(job.moving.name)
        return stand_in(job, options)

    def again(options=Options()):  # noqa: B008
        seen.clear()
        jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
        return run_all([job for job in jobs if job.moving.stem in "ac"], options, summary, _silent, counting)

    assert again().unchanged == 0
    assert again().unchanged == 1
    assert seen == ["c.TIF"]  # which failed
    assert again(Options(sigma=1.0)).unchanged == 0
    assert again(Options(sigma=1.0)).unchanged == 1
    (folder / "a.csv").write_text(HEADER + "1,1,2,3\n")
    assert again(Options(sigma=1.0)).unchanged == 0
    (tmp_path / "a.png").unlink()
    assert again(Options(sigma=1.0)).unchanged == 0
    summary.write_text("something else")
    assert again(Options(sigma=1.0)).unchanged == 0
    assert again(Options(sigma=1.0)).unchanged == 1


def test_an_interrupted_batch_keeps_what_it_did_and_what_was_done_before(folder, tmp_path):
    jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
    jobs = [jobs[0], jobs[2]]
    summary = tmp_path / "summary.csv"
    run_all(jobs, Options(), summary, _silent, stand_in)

    def interrupted(job, options):
        if job.moving.stem == "c":
            raise KeyboardInterrupt
        return stand_in(job, options)

    with pytest.raises(KeyboardInterrupt):
        run_all(jobs, Options(sigma=2.0), summary, _silent, interrupted)
    assert [line["out"] for line in batch._read_summary(summary)] == [str(job.out) for job in jobs]
    assert run_all(jobs, Options(sigma=2.0), summary, _silent, stand_in).unchanged == 1


def test_tables_name_their_pairs(tmp_path):
    table = tmp_path / "pairs.csv"
    table.write_text("moving, fixed, landmarks, out\na.png, f.png, a.pts; b.pts, x.png\nb.png,, b.csv, y.tif\n")
    one, two = jobs_in_table(table, Places(), tmp_path / "all.png")
    assert [path.name for path in (*one.landmarks, one.out, one.fixed)] == ["a.pts", "b.pts", "x.png", "f.png"]
    assert (two.fixed, two.out) == (tmp_path / "all.png", tmp_path / "y.tif")


@pytest.mark.parametrize(
    ("text", "finding"),
    [
        ("", "pairs.csv: the columns are missing"),
        ("a,b\n1,2\n", "pairs.csv: the columns are a,b"),
        ("moving,landmarks,out\n", "pairs.csv holds no pairs"),
        ("moving,landmarks,out\na.png,a.csv\n", "pairs.csv:2: not as many values"),
        ("moving,landmarks,out\na.png,a.csv,b,c\n", "pairs.csv:2: not as many values"),
        ("moving,landmarks,out\na.png,,b.png\n", "pairs.csv:2: an image and its landmarks are missing"),
        ("moving,landmarks\na.png,a.csv\n", "pairs.csv:2: there is no place for the result"),
        ("moving,landmarks,out\na.png,a.csv,b.png\nc.png,c.csv,b.png\n", "would both be written to"),
        ("moving,landmarks,out\n\xff\n".encode("latin-1"), "pairs.csv cannot be read"),
    ],
)
def test_tables_that_are_none_are_refused(text, finding, tmp_path):
    table = tmp_path / "pairs.csv"
    table.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(ArgumentError, match=re.escape(finding)):
        jobs_in_table(table, Places(), None)
