"""Who does some work, and the way of it: an engine does the chunks, what is done is kept, and progress is told."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Any, TypeAlias

from codegen.batch.executors import LOCAL, engine_for
from codegen.batch.executors.work import Done, Tally, Work
from codegen.errors import ArgumentError, NumericsError, clause

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
        with engine_for(used, self.cluster)(work, used) as solve, self.progress(what[0], total) as shown:
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
