"""The registry of executors, which solve the chunks of a sweep in parallel, and the call of an executor.

An executor is a function in this folder and one row of EXECUTORS.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeAlias, TypeVar

from codegen.batch.executors.chunks import Done, Tally, Work
from codegen.errors import ArgumentError, ExtraError, NumericsError, clause

Item = TypeVar("Item")
Result = TypeVar("Result")
Results: TypeAlias = Iterator[tuple[Item, Result]]
"""An iterator over items, such as numbers of chunks, with their results, in any order."""
Executor: TypeAlias = Callable[[Work, int], AbstractContextManager[Callable[[Iterable[int]], Results[int, Done]]]]
"""A function (work, number of workers) -> context manager of a function (numbers of chunks) -> results.

Each chunk has exactly one result. If the workers of a chunk were lost several times, its result is `work.lost(...)`.
"""
LOCAL = "local"  # value of `cluster` that starts a cluster of dask on this machine
EXECUTORS = {"threads": "local", "processes": "local", "dask": "dask"}
"""The files of all executors, whose functions have the names of the executors; tests cover each of them."""


def executor(name: str) -> Executor:
    """Return the executor with a name; its file is imported on demand."""
    return getattr(import_module(f"codegen.batch.executors.{EXECUTORS[name]}"), name)  # type: ignore[no-any-return]


def executor_for(work: Work, workers: int, cluster: object = None) -> Executor:
    """Return the dask executor if a cluster is given, else threads, or processes for work that is mostly Python."""
    if cluster is not None:
        running: Any = executor("dask")
        return partial(running, cluster=cluster)
    return executor("threads" if work.is_compiled or workers == 1 else "processes")


def connected(cluster: object) -> AbstractContextManager[object]:
    """Return a context manager with the dask client of a cluster, or with None if `cluster` is None.

    Raises ExtraError if dask is not installed, ClusterError if no scheduler answers or the cluster has no workers, and
    ArgumentError for an invalid value of `cluster`.
    """
    if cluster is None:
        return nullcontext()
    if find_spec("distributed") is None:
        raise ExtraError("a cluster needs dask, which is not installed", "pip install dask distributed xarray zarr")
    client: AbstractContextManager[object] = import_module("codegen.batch.executors.dask").connected(cluster)
    return client


Progress: TypeAlias = Callable[[str, int], AbstractContextManager[Callable[[int, str], None]]]
"""A function (action, number of parts) -> context manager of a function (finished parts, text) that shows progress."""
Working: TypeAlias = Callable[[str], AbstractContextManager[object]]
"""A function (action) -> context manager, which shows activity during a long step."""


@contextmanager
def silent(what: str, count: int) -> Iterator[Callable[[int, str], None]]:
    """Show no progress; a function of type Progress."""
    yield lambda done, text: None


@dataclass(frozen=True)
class Team:
    """The workers (threads or processes of this machine, or a cluster), the display of progress, and their notes."""

    workers: int
    cluster: object = None
    working: Working = nullcontext
    progress: Progress = silent
    notes: dict[str, None] = field(default_factory=dict)

    def do(
        self, work: Work, numbers: Sequence[int], total: int, before: Tally, keep: Callable[[int, Done], None],
        what: tuple[str, str] = ("Solving", "cases"),
    ) -> Tally:  # fmt: skip
        """Solve the chunks `numbers`, pass each result to `keep`, and return `before` plus the tally of the results.

        `total` is the number of all cases; `what` is the action and the unit of the progress display.
        """
        if not numbers:
            return before
        used, tally, begin = min(self.workers, len(numbers)), before, time.perf_counter()
        with executor_for(work, used, self.cluster)(work, used) as solve, self.progress(what[0], total) as shown:
            for number, done in solve(numbers):
                keep(number, done)
                tally = tally + done.tally
                self.notes.update(dict.fromkeys(done.notes))
                rate = (tally.cases - before.cases) / (time.perf_counter() - begin)
                remaining, failed = (total - tally.cases) / rate, tally.cases - tally.solved
                shown(tally.cases, f"{rate:.3g} {what[1]}/s, {failed} failed, about {remaining:.0f} s left")
        return tally


def team_size(workers: object, cluster: object) -> int:
    """Return the number of workers, by default the number of available processors.

    Raises NumericsError for an invalid number, ArgumentError for a number with a cluster that has its own workers.
    """
    if workers is None:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if isinstance(workers, bool) or not isinstance(workers, int) or workers < 1:
        raise NumericsError(f"--workers {clause(repr(workers))}", "give a positive integer")
    if cluster not in (None, LOCAL):
        raise ArgumentError("--workers with a cluster that has its own", "leave --workers out, or give --cluster local")
    return workers
