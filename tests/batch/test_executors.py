"""Every executor does any chunks, each once, and none is left to those who are killed by it."""

from __future__ import annotations

import os

import pytest
from stand_in import StandIn

from codegen.batch.executors import EXECUTORS, LOST, executor, executor_for

pytest.importorskip("distributed")


@pytest.mark.parametrize("name", EXECUTORS)
def test_every_executor_solves_every_chunk_once(tmp_path, name):
    work = StandIn(tmp_path)
    with executor(name)(work, 1) as solve:
        found = {number: done.rows["square"][0] for number, done in solve([3, 1, 4])}
    assert found == {3: 9, 1: 1, 4: 16}
    assert {path.name for path in tmp_path.iterdir()} == {"1", "3", "4"}


def test_workers_that_are_killed_are_replaced_and_a_chunk_that_kills_all_is_lost(tmp_path):
    work = StandIn(tmp_path, once=(0,), always=(2,))
    with executor_for(work, 2, "local")(work, 2) as solve:
        found = {number: done.tally.counts for number, done in solve(range(6))}
    assert found == {number: {LOST: 1} if number == 2 else {"solved": 1} for number in range(6)}
    tries = (tmp_path / "0").read_text().split()
    assert len(tries) > 1
    assert len(set(tries)) == len(tries)


def test_compiled_work_is_shared_by_threads_of_this_process(tmp_path):
    work = StandIn(tmp_path, is_compiled=True)
    with executor_for(work, 2)(work, 2) as solve:
        found = sorted((number, done.tally.counts["solved"]) for number, done in solve(range(20)))
    assert found == [(number, 1) for number in range(20)]
    assert {path.read_text() for path in tmp_path.iterdir()} == {f"{os.getpid()}\n"}


@pytest.mark.parametrize("is_compiled", [True, False])
def test_an_error_of_a_chunk_is_raised_and_ends_the_others(tmp_path, is_compiled):
    work = StandIn(tmp_path, broken=(1,), is_compiled=is_compiled)
    with executor_for(work, 2)(work, 2) as solve, pytest.raises(OSError, match="no space"):
        list(solve(range(1000)))
    assert len(list(tmp_path.iterdir())) < 1000
