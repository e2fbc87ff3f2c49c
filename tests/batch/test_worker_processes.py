"""Executors: every chunk once, whatever becomes of the workers. The work is a stand-in that solves nothing."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from stand_in import StandIn

from codegen.batch.executors import LOST, executor_for
from codegen.batch.executors.local import TRIES


def solved(work, workers, numbers):
    with executor_for(work, workers)(work, workers) as solve:
        return sorted((number, done.tally.counts) for number, done in solve(numbers))


def test_two_workers_share_the_chunks(tmp_path):
    assert solved(StandIn(tmp_path), 2, range(20)) == [(number, {"solved": 1}) for number in range(20)]
    workers = {path.read_text() for path in tmp_path.iterdir()}
    assert f"{os.getpid()}\n" not in workers
    assert len(workers) == 2


def test_a_chunk_whose_worker_is_killed_is_done_again_by_another(tmp_path):
    work = StandIn(tmp_path, once=(0, 5))
    assert solved(work, 2, range(8)) == [(number, {"solved": 1}) for number in range(8)]
    first, second = (tmp_path / "5").read_text().split()
    assert first != second


def test_a_chunk_that_kills_every_worker_counts_as_lost(tmp_path):
    found = dict(solved(StandIn(tmp_path, always=(2,)), 2, range(6)))
    assert found == {number: {LOST: 1} if number == 2 else {"solved": 1} for number in range(6)}
    assert len((tmp_path / "2").read_text().split()) == TRIES


def test_what_a_worker_cannot_do_is_raised_and_leaves_no_processes(tmp_path):
    before = _children()
    with pytest.raises(OSError, match="no space"):
        solved(StandIn(tmp_path, broken=(1,)), 2, range(100))
    assert _children() <= before


def test_workers_end_with_the_process_that_began_them(tmp_path):
    """It is killed and can tell them nothing; they look, or find that nobody listens."""
    code = (
        "import sys, time\nfrom pathlib import Path\nsys.path[:0] = sys.argv[2:]\n"
        "from stand_in import StandIn\nfrom codegen.batch.executors.local import processes\n"
        "with processes(StandIn(Path(sys.argv[1])), 2) as solve:\n"
        "    for number, done in solve(range(10)):\n        print(number, flush=True)\n        time.sleep(100)\n"
    )
    words = [sys.executable, "-c", code, str(tmp_path), str(Path(__file__).parent)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(0.2)
        process.kill()
    pids = {int(pid) for path in tmp_path.iterdir() for pid in path.read_text().split()}
    assert len(pids) == 2
    deadline = time.monotonic() + 60.0
    while any(map(_is_running, pids)) and time.monotonic() < deadline:
        time.sleep(0.1)
    assert not any(map(_is_running, pids))


def _children():
    return set(Path(f"/proc/self/task/{os.getpid()}/children").read_text().split())


def _is_running(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
