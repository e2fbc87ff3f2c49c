"""Sweeps that end before their last case: what is said then, what --resume says, and the stores that it refuses."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

import pytest
import xarray
from command_lines import ORBIT, assert_refused, contents, run

import codegen
from codegen.batch.store import Store
from codegen.errors import ClusterError, FileError, Interrupted
from codegen.files import journal_of, refused

WORDS = ("sweep", ORBIT, "--vary", "r1=5.9,-6,6,6.1", "--chunk", 1, "--steps", 20, "--workers", 1, "--out", "s.zarr")
ENDS = {
    "interrupt": (KeyboardInterrupt(), Interrupted, "interrupted; 2 of 4 cases are in s.zarr; --resume does the rest"),
    "disk": (
        refused(OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)), Path("s.zarr")),
        FileError,
        "s.zarr cannot be written (No space left on device), 2 of 4 cases are in s.zarr; make room on that disk, or "
        "choose another folder; --resume does the rest",
    ),
    "scheduler": (
        ClusterError("the scheduler was lost", "begin it again, and give --resume"),
        ClusterError,
        "the scheduler was lost, 2 of 4 cases are in s.zarr; begin it again, and give --resume",
    ),
}


@pytest.fixture(autouse=True)
def _compiled(orbital_transfer):
    """Machine code is there."""


@pytest.fixture
def ending(monkeypatch):
    """Have the third chunk end the sweep by an error, until the function that is returned is called without one."""
    write = Store.write

    def end_by(error):
        written = []

        def until_the_third(store, region, rows):
            written.append(region)
            if error is not None and len(written) == 3:
                raise error
            write(store, region, rows)

        monkeypatch.setattr(Store, "write", until_the_third)

    return end_by


@pytest.mark.parametrize(("error", "kind", "told"), ENDS.values(), ids=ENDS)
def test_any_end_tells_how_many_cases_are_there(folder, ending, error, kind, told):
    ending(error)
    axes = {"r1": [5.9, -6.0, 6.0, 6.1]}
    with pytest.raises(kind) as raised:
        codegen.sweep(ORBIT, axes, chunk=1, steps=20, workers=1, out="s.zarr")
    assert str(raised.value) == told
    ending(None)
    whole = codegen.sweep(ORBIT, axes, chunk=1, steps=20, workers=1, out="s.zarr", resume=True)
    assert list(whole.status.values) == ["solved", "unusable", "solved", "solved"]


def test_resume_tells_new_cases_from_those_of_before(folder, ending):
    ending(KeyboardInterrupt())
    done = run(*WORDS)
    told = "codegen: interrupted; 2 of 4 cases are in s.zarr; --resume does the rest\n"
    assert (done.exit_code, done.stdout, done.stderr) == (130, "", told)
    ending(None)
    done = run(*WORDS, "--resume")
    assert "\n2 cases in " in done.stdout
    assert " s, 2 of 4 were there already: s.zarr\n" in done.stdout
    assert '"cases": 4, "before": 4, "solved": 3' in run(*WORDS, "--resume", "--json").stdout


def test_nothing_is_left_of_a_file_that_is_written_at_the_end(folder, monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("codegen.batch.sweep.write_netcdf", interrupted)
    done = run(*WORDS[:-1], "s.nc")
    assert (done.exit_code, done.stderr) == (130, "codegen: interrupted; no file was left half written\n")
    assert not list(folder.iterdir())


@pytest.mark.parametrize("gone", ["q", "q/c", "q/c/1/0/0", "q/zarr.json", "message/c/2", "r1", "coordinate/c/0"])
def test_a_store_without_what_its_journal_notes_is_refused(folder, gone):
    run(*WORDS)
    place = folder / "s.zarr" / gone
    shutil.rmtree(place) if place.is_dir() else place.unlink()
    before = contents(folder)
    lacking = {"q/c": "q/c/0/0/0"}.get(gone, gone)
    told = f"--resume: s.zarr lacks {lacking}, which was written; delete the store, or choose another name"
    assert_refused(run(*WORDS, "--resume"), told)
    assert contents(folder) == before


def test_chunks_that_the_journal_does_not_note_may_lack_files(folder):
    run(*WORDS)
    journal = journal_of(folder / "s.zarr")
    journal.write_text("".join(journal.read_text().splitlines(keepends=True)[:-1]))
    (folder / "s.zarr/q/c/3/0/0").unlink()
    assert run(*WORDS, "--resume").exit_code == 1
    assert not xarray.open_zarr("s.zarr", chunks=None).q.isel(r1=3).isnull().any()


def test_one_case_is_one_case(folder):
    done = run("sweep", ORBIT, "--vary", "r1=-6", "--steps", 20, "--out", "s.zarr", "--workers", 1)
    assert "\n1 case in " in done.stdout
    assert done.stderr.startswith("codegen: 1 of 1 case failed; ")
