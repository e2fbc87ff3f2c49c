"""The registry of executors: who does the chunks of some work. One file for each; another one is a file and a row.

Who does some work, and the way of it: an executor does the chunks, what is done is kept, and progress is told.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeAlias

from codegen.batch.executors.chunks import Done, Tally, Work
from codegen.errors import ArgumentError, ExtraError, NumericsError, clause

Solved: TypeAlias = "Iterator[tuple[int, Done]]"
"""Chunks by their numbers as they are finished, in any order."""
Executor: TypeAlias = "Callable[[Work, int], AbstractContextManager[Callable[[Sequence[int]], Solved]]]"
"""(work, workers) -> a context with workers that are ready, in which a function solves chunks by their numbers.

Each chunk comes exactly once. One whose workers are lost time and again comes as `work.lost` makes it.
"""


@dataclass(frozen=True)
class Row:
    """Name and summary of an executor; its file has a function `running` that is an Executor."""

    name: str
    summary: str

    @property
    def running(self) -> Executor:
        """The executor, imported when it is asked for."""
        return getattr(import_module(f"codegen.batch.executors.{self.name}"), "running")  # type: ignore[no-any-return]  # noqa: B009


LOCAL = "local"
"""The word for a cluster that is begun for the work, on this machine."""
EXECUTORS = {
    row.name: row
    for row in (
        Row("serial", "one chunk after the other in this process"),
        Row("processes", "processes on this machine, each with one thread"),
        Row("dask", "workers of a cluster of dask, on any machines"),
    )
}
"""Every executor by name; tests run over this table."""


def executor_for(workers: int, cluster: Any = None) -> Executor:
    """The executor of a cluster, if there is one, or the one that so many workers of this machine need."""
    if cluster is not None:
        running: Any = EXECUTORS["dask"].running
        return partial(running, cluster=cluster)
    return EXECUTORS["serial" if workers == 1 else "processes"].running


def connected(cluster: Any) -> AbstractContextManager[Any]:
    """A client of the cluster that is asked for, or None where none is; it is looked for before anything takes long.

    Raises ExtraError without dask, ClusterError when nothing answers or nobody works there, and ArgumentError for what
    is no cluster.
    """
    if cluster is None:
        return nullcontext()
    if find_spec("distributed") is None:
        raise ExtraError("a cluster needs dask, which is not installed", "pip install 'variational-codegen[cluster]'")
    made: AbstractContextManager[Any] = import_module("codegen.batch.executors.dask").connected(cluster)
    return made


Progress: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[int, str], None]]]
"""(what, count) -> a context that is told (parts done, what is going on)."""
Working: TypeAlias = Callable[[str], AbstractContextManager[Any]]
"""A sign of life while something takes long."""


@contextmanager
def silent(what: str, count: int) -> Iterator[Callable[[int, str], None]]:
    """Progress that nobody watches."""
    yield lambda done, text: None


@dataclass(frozen=True)
class Team:
    """Processes or a client of a cluster; signs of life, of one thing that takes long and of many; what they say."""

    workers: int
    cluster: Any = None
    working: Working = nullcontext
    progress: Progress = silent
    notes: dict[str, None] = field(default_factory=dict)

    def do(
        self, work: Work, numbers: Sequence[int], total: int, before: Tally, keep: Callable[[int, Done], None],
        what: tuple[str, str] = ("Solving", "cases"),
    ) -> Tally:  # fmt: skip
        """Have chunks done and what comes of them kept; the tally of these and those before, `total` cases in all."""
        if not numbers:
            return before
        used, tally, begin = min(self.workers, len(numbers)), before, time.perf_counter()
        with executor_for(used, self.cluster)(work, used) as solve, self.progress(what[0], total) as shown:
            for number, done in solve(numbers):
                keep(number, done)
                tally = tally + done.tally
                self.notes.update(dict.fromkeys(done.notes))
                rate = (tally.cases - before.cases) / (time.perf_counter() - begin)
                left, failed = (total - tally.cases) / rate, tally.cases - tally.solved
                shown(tally.cases, f"{rate:.3g} {what[1]}/s, {failed} failed, about {left:.0f} s left")
        return tally


def team_size(workers: Any, cluster: Any) -> int:
    """How many processes are to be begun, unless said one for each processor.

    Raises NumericsError for what is no number of processes, ArgumentError beside a cluster that has its own workers.
    """
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise NumericsError(f"--workers {clause(repr(workers))}", "give a positive integer")
    if cluster not in (None, LOCAL):
        raise ArgumentError("--workers with a cluster that has its own", "leave --workers out, or give --cluster local")
    return workers
