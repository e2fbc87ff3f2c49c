"""Batches on every executor: the bits of one process, and every pair once, whatever becomes of workers and client."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest
from command_lines import assert_refused, run
from dask_parts import cluster, kill, until
from small_batches import batch, make

from codegen.batch.executors import EXECUTORS, LOST, executor
from codegen.batch.executors.local import TRIES
from codegen.errors import ClusterError
from codegen.files import journal_of
from codegen.registration.batch_pairs import BatchWork, Pair, Places, SharedFile, jobs_in_folder, read_summary
from codegen.registration.job import Options
from codegen.registration.job import run as run_pair

pytestmark = pytest.mark.usefixtures("solver")


def told(done):
    """What lines say, but for the seconds, and the folder of the outputs."""
    return [{**line, "seconds": "", "out": Path(line["out"]).name} for line in done.lines]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    return make(tmp_path_factory.mktemp("batch") / "in", 12)


@pytest.fixture(scope="module")
def whole(source, solver):
    """The folder of what one process makes, and the batch."""
    out = source.parent / "whole"
    return out, batch(source, out)


def assert_same_images(out: Path, whole: Path) -> None:
    """To the last bit, and nothing else beside the summary."""
    assert {path.name: path.read_bytes() for path in out.iterdir() if path.suffix != ".csv"} == {
        path.name: path.read_bytes() for path in whole.iterdir() if path.suffix != ".csv"
    }
    assert [path.name for path in out.iterdir() if path.suffix == ".csv"] == ["summary.csv"]


@pytest.mark.parametrize("name", EXECUTORS)
def test_every_executor_makes_the_bits_of_one_process(source, whole, tmp_path, name):
    where = {"threads": {}, "processes": {"workers": 2}, "dask": {"workers": 2, "cluster": "local"}}
    done = batch(source, tmp_path / "out", **where[name])
    assert_same_images(tmp_path / "out", whole[0])
    assert told(done) == told(whole[1])
    assert [line["moving"] for line in done.failed] == [str(source / "001.png")]


@pytest.mark.parametrize("name", EXECUTORS)
def test_every_executor_does_any_chunks(source, tmp_path, name):
    """What outcomes of batches decide, which executor and how large a chunk, is no matter here."""
    jobs, _ = jobs_in_folder(source, Places(tmp_path), None, ())
    pairs = [Pair(number, job.absolute(), {}) for number, job in enumerate(jobs)]
    work = BatchWork(pairs, Options(), 5, 1, SharedFile.of(source / "000.png"))
    with executor(name)(work, 1) as solve:
        found = {number: [own.number for own in done.rows] for number, done in solve([2, 0])}
    assert found == {0: [0, 1, 2, 3, 4], 2: [10, 11]}


def deadly(job, options):
    """The registration of a pair that ends its process, as one that needs too much memory would."""
    if job.moving.stem == "007":
        os.kill(os.getpid(), signal.SIGKILL)
    return run_pair(job, options)


@pytest.mark.parametrize("where", [None, "local"])
def test_a_pair_that_kills_its_workers_takes_no_other_with_it(source, whole, tmp_path, monkeypatch, where):
    monkeypatch.setattr("codegen.batch.executors.dask.TRIES", 2)  # workers of dask begin slowly; sweeps lose three
    done = batch(source, tmp_path / "out", deadly, workers=2, cluster=where)
    assert [line["status"] for line in done.failed] == ["wrong input", LOST]
    assert done.failed[1]["moving"] == str(source / "007.png")
    if where is None:
        assert f"{TRIES} workers were lost" in done.failed[1]["message"]
    found = batch(source, tmp_path / "out")
    assert (found.unchanged, len(found.failed)) == (10, 1)
    assert_same_images(tmp_path / "out", whole[0])


@contextmanager
def begun(*words: object) -> Iterator[subprocess.Popen[str]]:
    """A command in the background."""
    command = [sys.executable, "-m", "codegen", "warp", *map(str, words)]
    made = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        yield made
    finally:
        kill(made)
        made.communicate()


def noted(out: Path) -> list[dict[str, str]]:
    """The lines of the journal that are whole."""
    journal = journal_of(out / "summary.csv")
    lines = journal.read_text().splitlines(keepends=True) if journal.exists() else []
    return [json.loads(line) for line in lines[1:] if line.endswith("\n")]


NUMBER = 60


@pytest.fixture(scope="module")
def many(tmp_path_factory, solver):
    """More pairs, beside the folder of what one process makes."""
    folder = make(tmp_path_factory.mktemp("many") / "in", NUMBER)
    batch(folder, folder.parent / "whole")
    return folder


class TestEnds:
    """Of a batch that takes some seconds."""

    @pytest.mark.parametrize("words", [(), ("--cluster", "local")], ids=["processes", "dask"])
    def test_a_client_that_is_killed_has_lost_nothing_and_nothing_is_done_twice(self, many, tmp_path, words):
        out = tmp_path / "out"
        words = ("--workers", 2, *words)
        with begun(many, "--out", out, *words) as process:
            until(lambda: len(noted(out)) > 3)
        lines = noted(out)
        assert 3 < len(lines) < NUMBER
        assert len({line["out"] for line in lines}) == len(lines)
        solved = [Path(line["out"]) for line in lines if line["status"] == "solved"]
        stamps = {path: path.stat().st_mtime_ns for path in solved}
        done = run("warp", many, "--out", out, *words, "--resume", "--json")
        assert done.exit_code == 1  # there is a damaged image
        record = json.loads(done.stdout)
        assert (record["pairs"], record["unchanged"], len(record["failed"])) == (NUMBER, len(solved), 1)
        assert {path: path.stat().st_mtime_ns for path in solved} == stamps
        assert_same_images(out, many.parent / "whole")
        assert process.returncode == -signal.SIGKILL

    def test_an_interrupt_is_one_line_and_leaves_a_summary(self, many, tmp_path):
        out = tmp_path / "out"
        with begun(many, "--out", out, "--workers", 2) as process:
            until(lambda: len(noted(out)) > 3)
            os.killpg(process.pid, signal.SIGINT)  # a terminal interrupts workers as well
            _, error = process.communicate(timeout=60)
        assert process.returncode == 130
        assert error.count("\n") == 1
        assert 3 < len(read_summary(out / "summary.csv")) < NUMBER
        assert not journal_of(out / "summary.csv").exists()

    def test_workers_elsewhere_are_killed_and_lost_with_their_scheduler(self, many, tmp_path, monkeypatch):
        """They run in another folder than the client, whose names are relative."""
        monkeypatch.chdir(tmp_path)
        out = tmp_path / "out"
        with cluster() as (address, scheduler, workers):
            monkeypatch.chdir(many.parent)
            words = ("in", "--out", os.path.relpath(out), "--cluster", address)
            with begun(*words) as process:
                until(lambda: len(noted(out)) > 1)
                kill(workers[0])
                before = len(noted(out))
                until(lambda: len(noted(out)) > before)
                kill(scheduler)
                _, error = process.communicate(timeout=60)
        assert process.returncode == 2
        assert error.startswith("codegen: error: the scheduler of the cluster was lost")
        assert error.count("\n") == 1
        lines = read_summary(out / "summary.csv")
        solved = sum(line["status"] == "solved" for line in lines)
        assert 1 < len(lines) < NUMBER
        found = batch(many, out, workers=2, resume=True)
        assert found.unchanged == solved
        assert_same_images(out, many.parent / "whole")


class TestPlaces:
    """Images travel as paths."""

    def work(self, source, out):
        jobs, _ = jobs_in_folder(source, Places(out), None, ())
        pairs = [Pair(number, job.absolute(), {}) for number, job in enumerate(jobs)]
        return BatchWork(pairs, Options(), 4, 1, SharedFile.of(source / "000.png"))

    @pytest.mark.parametrize("place", [SharedFile(Path("nowhere"), 1), SharedFile(Path(__file__), 1)])
    def test_a_worker_that_sees_another_file_system_refuses(self, source, tmp_path, place):
        parcel = replace(self.work(source, tmp_path), shared=place).parcel()
        with pytest.raises(ClusterError, match=r"does not see .*; images travel as paths"):
            parcel.unpacked()

    def test_a_worker_that_misses_an_image_refuses_and_what_nobody_has_is_a_failed_pair(self, source, tmp_path):
        work, _ = self.work(source, tmp_path).parcel().unpacked()  # notes tell of what had to be compiled
        assert not work.pairs
        piece = self.work(source, tmp_path).piece(0)
        (moved := source / "000.png").rename(source / "elsewhere.png")
        try:
            with pytest.raises(ClusterError, match=r"does not see .*000\.png"):
                work.solve(piece)
            done = work.solve(replace(piece, readable=frozenset()))
        finally:
            (source / "elsewhere.png").rename(moved)
        assert done.tally.counts == {"wrong input": 2, "solved": 2}

    def test_a_worker_with_another_solver_refuses(self, source, tmp_path):
        parcel = replace(self.work(source, tmp_path).parcel(), digest="another")
        with pytest.raises(ClusterError, match="another solver"):
            parcel.unpacked()

    def test_the_line_comes_from_a_cluster(self, source, tmp_path, monkeypatch):
        monkeypatch.setattr(SharedFile, "of", lambda path: SharedFile(path, 1))
        done = run("warp", source, "--out", tmp_path / "out", "--cluster", "local", "--workers", 1)
        assert_refused(done, "does not see", "give all workers the file system")
