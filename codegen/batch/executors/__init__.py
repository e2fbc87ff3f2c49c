"""The interface of work that is divided into chunks, the registry of executors, and the call of an executor.

Work is small and is pickled once for each worker. Chunks are numbered from zero; a worker receives the number of a
chunk, or a piece with its data. An executor solves chunks in parallel. It is a function in this folder and one row of
EXECUTORS.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Protocol, TypeAlias, TypeVar

from codegen.errors import ArgumentError, ExtraError, NumericsError, clause, is_count
from codegen.solving.progress import Working

SOLVED = "solved"
LOST = "worker lost"  # status of a case whose chunk ended several worker processes


@dataclass(frozen=True)
class Tally:
    """The number of cases by status, the first message of each status, and the seconds of all solves.

    `improved` counts cases whose cost fell by a new solve from the better side of a jump of the cost. `jumps` counts
    cases on the worse side of a remaining jump.
    """

    counts: Mapping[str, int] = field(default_factory=dict)
    messages: Mapping[str, str] = field(default_factory=dict)
    seconds: float = 0.0
    improved: int = 0
    jumps: int = 0

    def __add__(self, other: Tally) -> Tally:
        """Return the sum of both tallies; messages of `self` take precedence."""
        counts = {key: self.counts.get(key, 0) + other.counts.get(key, 0) for key in {**self.counts, **other.counts}}
        sums = (self.seconds + other.seconds, self.improved + other.improved, self.jumps + other.jumps)
        return Tally(counts, {**other.messages, **self.messages}, *sums)

    @staticmethod
    def of(
        statuses: Sequence[str], messages: Sequence[str], seconds: float, improved: int = 0, jumps: int = 0
    ) -> Tally:
        """Return the tally of cases with these statuses and messages, in their order."""
        first = dict(zip(reversed(statuses), reversed(messages), strict=True))
        return Tally(Counter(statuses), first, seconds, improved, jumps)

    @property
    def cases(self) -> int:
        """Number of cases."""
        return sum(self.counts.values())

    @property
    def solved(self) -> int:
        """Number of solved cases."""
        return self.counts.get(SOLVED, 0)

    @property
    def failed(self) -> dict[str, int]:
        """The number of unsolved cases by status, the most frequent status first."""
        rest = ((status, count) for status, count in self.counts.items() if status != SOLVED)
        return dict(sorted(rest, key=lambda pair: (-pair[1], pair[0])))

    def as_record(self) -> dict[str, object]:
        """Return the tally as a JSON object; `from_record` reads it."""
        return {"counts": dict(self.counts), "messages": dict(self.messages), "seconds": self.seconds, **self.won}

    @property
    def won(self) -> dict[str, int]:
        """The numbers of cases with a better optimum from a neighbour and of jumps between optima, if not zero."""
        named = {"improved": self.improved, "jumps": self.jumps}
        return {name: number for name, number in named.items() if number}

    @staticmethod
    def from_record(record: Mapping[str, Any]) -> Tally:
        """Return the tally of a JSON object; raises KeyError, TypeError or ValueError for another object."""
        counts = {str(status): int(count) for status, count in dict(record["counts"]).items()}
        messages = {str(status): str(message) for status, message in dict(record["messages"]).items()}
        jumps = (int(record.get(name, 0)) for name in ("improved", "jumps"))
        return Tally(counts, messages, float(record["seconds"]), *jumps)


def counted(number: int, what: str) -> str:
    """Return a text with a number and its noun `what`, in the singular or the plural."""
    return f"{number} {what}" if number == 1 else f"{number} {what}s"


class Abandoned(Exception):
    """The exception of a worker whose result is no longer wanted."""


@dataclass(frozen=True)
class Done:
    """The result of a chunk: the tally, the rows if the worker did not store them, and notes for the user."""

    tally: Tally
    rows: Any = None
    notes: tuple[str, ...] = ()


class Work(Protocol):
    """The interface of work that executors can do."""

    @property
    def is_compiled(self) -> bool:
        """True if nearly all time is spent in compiled code, which holds no lock of the interpreter."""

    def loaded(self) -> Work:
        """Prepare this process for solves, for example load machine code, and return the work."""

    def piece(self, number: int) -> object:
        """Return the data of a chunk that a worker needs in addition to the work."""

    def solve(self, piece: Any, is_wanted: Callable[[], bool] = ...) -> Done:
        """Solve a chunk and store its results; raises Abandoned as soon as `is_wanted` returns False.

        A failed case is part of the result. An error that ends the whole work is raised.
        """

    def lost(self, number: int, reason: str) -> Done:
        """Return the result of a chunk whose workers were lost."""

    def parcel(self) -> Parcel:
        """Return the work for other machines, without its cases; raises ArgumentError if this is impossible."""

    def returned(self, number: int, done: Done) -> Done:
        """Store, in the client process, the rows that a remote worker could not store."""


class Parcel(Protocol):
    """Work on its way to another machine, without machine code, which depends on the processor."""

    def unpacked(self) -> tuple[Work, tuple[str, ...]]:
        """Return the work, ready to solve on this machine, and notes about the machine; raises CodegenError."""


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
    if not is_count(workers):
        raise NumericsError(f"--workers {clause(repr(workers))}", "give a positive integer")
    if cluster not in (None, LOCAL):
        raise ArgumentError("--workers with a cluster that has its own", "leave --workers out, or give --cluster local")
    return workers
