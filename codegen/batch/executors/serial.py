"""The executor that solves chunks one after the other in this process."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

from codegen.batch.executors import Solved
from codegen.batch.executors.chunks import Work


@contextmanager
def running(work: Work, workers: int) -> Iterator[Callable[[Sequence[int]], Solved]]:
    """Yield a function that solves chunks in this process, with one thread for linear algebra; see `Executor`."""
    assert workers == 1, "the serial executor has one process"
    with threadpool_limits(1):
        yield lambda numbers: ((number, work.solve(work.piece(number))) for number in numbers)
