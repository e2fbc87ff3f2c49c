"""Batches: which files belong together, what one bad pair does to the others, and what is not done again."""

import csv
import errno
import re
from pathlib import Path

import numpy as np
import pytest

from codegen.batch.executors import Abandoned
from codegen.errors import ArgumentError, FileError, ImageError
from codegen.files import journal_of, refused, replacing
from codegen.registration.batch import BatchRequest, outcome_of
from codegen.registration.batch_pairs import (
    COLUMNS,
    BatchWork,
    Pair,
    Places,
    SharedFile,
    jobs_in_folder,
    jobs_in_table,
    read_summary,
)
from codegen.registration.images import write_image
from codegen.registration.job import Options
from codegen.registration.pair_report import Outcome

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
    return Outcome(record=record, pairs=None)


def done(jobs, options, summary, run_one=stand_in, **request):
    """The batch in this process, without a solver."""
    asked = BatchRequest(jobs, options, Places(), summary, **request)
    return outcome_of(asked, run_one=run_one, prepare=lambda *_: None)


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
    found = done(jobs, Options(), tmp_path / "summary.csv")
    assert [line["status"] for line in found.lines] == ["solved", "wrong input", "not converged", "defect"]
    assert len(found.failed) == 3
    with (tmp_path / "summary.csv").open(newline="") as file:
        assert [*csv.DictReader(file)] == [*found.lines]
    assert "b is damaged; give another" in found.lines[1]["message"]
    assert "ZeroDivisionError: a defect" in found.lines[3]["message"]
    assert not journal_of(tmp_path / "summary.csv").exists()


def test_only_what_changed_is_done_again(folder, tmp_path):
    summary = tmp_path / "summary.csv"
    seen = []

    def counting(job, options):
        seen.append(job.moving.name)
        return stand_in(job, options)

    def again(options=Options()):  # noqa: B008
        seen.clear()
        jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
        return done([job for job in jobs if job.moving.stem in "ac"], options, summary, counting)

    assert again().unchanged == 0
    assert again().unchanged == 1
    assert seen == ["c.TIF"]  # which failed
    assert again(Options(sigma=1.0)).unchanged == 0
    assert again(Options(sigma=1.0)).unchanged == 1
    (folder / "a.csv").write_text(HEADER + "1,1,2,3\n")
    assert again(Options(sigma=1.0)).unchanged == 0
    (tmp_path / "a.png").unlink()
    assert again(Options(sigma=1.0)).unchanged == 0
    (tmp_path / "a.png").write_bytes(b"ima")  # as if a copy had broken off
    assert again(Options(sigma=1.0)).unchanged == 0
    summary.write_text("something else")
    assert again(Options(sigma=1.0)).unchanged == 0
    assert again(Options(sigma=1.0)).unchanged == 1
    text = summary.read_text()
    summary.write_text(text[: len(text) // 2])
    assert again(Options(sigma=1.0)).unchanged == 0


def test_outputs_that_are_asked_for_later_are_made(folder, tmp_path):
    jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
    assert done(jobs[:1], Options(), tmp_path / "s.csv").unchanged == 0
    (tmp_path / "f").mkdir()
    with_fields, _ = jobs_in_folder(folder, Places(tmp_path, tmp_path / "f"), None, ())
    assert done(with_fields[:1], Options(), tmp_path / "s.csv").unchanged == 0
    assert done(jobs[:1], Options(), tmp_path / "s.csv").unchanged == 1


def interrupted(job, options):
    """Somebody interrupts the third pair."""
    if job.moving.stem == "c":
        raise KeyboardInterrupt
    return stand_in(job, options)


def test_an_interrupted_batch_keeps_what_it_did_and_what_was_done_before(folder, tmp_path):
    jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
    jobs = [jobs[0], jobs[2]]
    summary = tmp_path / "summary.csv"
    done(jobs, Options(), summary)
    with pytest.raises(KeyboardInterrupt):
        done(jobs, Options(sigma=2.0), summary, interrupted)
    assert [line["out"] for line in read_summary(summary)] == [str(job.out) for job in jobs]
    assert done(jobs, Options(sigma=2.0), summary).unchanged == 1


def test_what_was_killed_is_gone_on_with_from_the_journal(folder, tmp_path, monkeypatch):
    """A kill leaves no summary, a journal that may be cut off within a line, and temporary files."""
    jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
    summary = tmp_path / "summary.csv"
    with monkeypatch.context() as patched:
        patched.setattr("codegen.registration.batch_pairs.write_summary", lambda path, lines: None)
        patched.setattr("pathlib.Path.unlink", lambda path, missing_ok=False: None)
        with pytest.raises(KeyboardInterrupt):
            # The interrupted pair is the last: a later one may be finished by another thread, and is then kept too.
            done([jobs[0], jobs[2]], Options(), summary, interrupted)
    journal = journal_of(summary)
    assert journal.read_text().count("\n") == 2
    with journal.open("a") as file:
        file.write('{"moving": "half of a li')
    with replacing(tmp_path / "other.png") as temporary:
        left = temporary.with_name(temporary.name.replace("other", "a"))
    left.write_text("half of an im")
    mine = tmp_path / ".a.original.png"
    mine.write_text("of somebody else")
    with pytest.raises(ArgumentError, match="tells of another batch"):
        done(jobs, Options(sigma=3.0), summary, resume=True)
    found = done(jobs, Options(), summary, resume=True)
    assert found.unchanged == 1
    assert [Path(line["out"]).name for line in found.lines] == ["a.png", "b.jpg", "c.TIF", "d.png"]
    assert not journal.exists()
    assert not left.exists()
    assert mine.exists()
    with pytest.raises(ArgumentError, match=r"summary\.csv is that of another batch"):
        done(jobs, Options(sigma=3.0), summary, resume=True)


def test_a_full_disk_ends_a_batch_and_what_is_written_stays(folder, tmp_path):
    def full(job, options):
        if job.moving.stem == "b":
            raise refused(OSError(errno.ENOSPC, "No space left on device"), job.out)
        return stand_in(job, options)

    jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
    with pytest.raises(FileError, match="make room"):
        done(jobs, Options(), tmp_path / "s.csv", full)
    # Another thread may have finished a later pair, which is then kept too.
    written = [Path(line["out"]).stem for line in read_summary(tmp_path / "s.csv")]
    assert written[0] == "a"
    assert "b" not in written


def test_a_chunk_that_nobody_wants_is_left(folder, tmp_path):
    jobs, _ = jobs_in_folder(folder, Places(tmp_path), None, ())
    pairs = [Pair(number, job.absolute(), {}) for number, job in enumerate(jobs)]
    work = BatchWork(pairs, Options(), 3, 1, SharedFile.of(folder), run_one=stand_in)
    assert [len(work.piece(number).pairs) for number in work.chunks] == [3, 1]
    with pytest.raises(Abandoned):
        work.solve(work.piece(0), lambda: False)
    lost = work.lost(1, "nobody knows").rows
    assert [(own.number, own.line["status"], set(own.line)) for own in lost] == [(3, "worker lost", set(COLUMNS))]


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
        ("moving,landmarks,out,interpolation\na.png,a.csv,b,best\n", "pairs.csv:2: unknown interpolation 'best'"),
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
