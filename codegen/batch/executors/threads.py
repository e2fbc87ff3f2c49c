"""The executor with threads of this process, for work that mostly runs compiled code without the interpreter's lock."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

from codegen.batch.executors import Solved
from codegen.batch.executors.chunks import Done, Work

AHEAD = 2
"""Number of chunks in flight for each thread: one in progress and one that waits."""


@contextmanager
def running(work: Work, workers: int) -> Iterator[Callable[[Sequence[int]], Solved]]:
    """Yield the function that solves chunks in threads, which end with the chunks they are at; see `Executor`."""
    work, ended = work.loaded(), threading.Event()
    with threadpool_limits(1), ThreadPoolExecutor(workers) as pool:

        def solved(number: int) -> Done:
            return work.solve(work.piece(number), lambda: not ended.is_set())

        def solve(numbers: Sequence[int]) -> Solved:
            """Yield the result of each chunk as soon as it is finished."""
            waiting, in_flight = iter(numbers), dict[Future[Done], int]()
            while True:
                while len(in_flight) < AHEAD * workers and (number := next(waiting, None)) is not None:
                    in_flight[pool.submit(solved, number)] = number
                if not in_flight:
                    return
                done = wait(in_flight, return_when=FIRST_COMPLETED).done
                # Results before an error, so that no finished chunk is lost.
                for future in sorted(done, key=lambda future: future.exception() is not None):
                    yield in_flight.pop(future), future.result()

        try:
            yield solve
        finally:
            ended.set()
            pool.shutdown(cancel_futures=True)
