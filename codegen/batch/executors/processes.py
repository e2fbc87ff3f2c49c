"""The executor with worker processes on this machine, which replaces lost workers.

On Linux, workers are forks of this process and have its machine code. On other systems workers load the machine code
from the disk. A worker ends by itself when its parent process has ended.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any

from threadpoolctl import threadpool_limits

from codegen.batch.executors import Solved
from codegen.batch.executors.chunks import Abandoned, Done, Work

START = "fork" if sys.platform == "linux" else "spawn"  # on other systems libraries do not survive a fork
TRIES = 3
"""Number of lost workers after which the cases of a chunk count as lost."""
_SECONDS = 5.0
"""Interval in seconds at which an idle worker checks that its parent process is alive."""


@dataclass(eq=False)
class _Worker:
    """A process, the connection to it, and its current chunk."""

    process: BaseProcess
    connection: Connection[Any, Any]
    chunk: int | None = None

    def order(self, waiting: list[int]) -> None:
        """Send the last number in `waiting` to the worker, and remove the number from the list."""
        if waiting:
            self.chunk = waiting.pop()
            with suppress(OSError):  # `solve` detects a lost worker
                self.connection.send(self.chunk)


@contextmanager
def running(work: Work, workers: int) -> Iterator[Callable[[Sequence[int]], Solved]]:
    """Start processes, yield the function that solves chunks, and kill the processes at the end; see `Executor`."""
    context: Any = multiprocessing.get_context(START)
    if START == "fork":
        work = work.loaded()
    crew: list[_Worker] = []

    def start() -> _Worker:
        local_end, remote_end = context.Pipe()
        others = [worker.connection for worker in crew]
        process = context.Process(target=_serve, args=(work, remote_end, [local_end, *others]), daemon=True)
        process.start()
        remote_end.close()
        crew.append(_Worker(process, local_end))
        return crew[-1]

    def solve(numbers: Sequence[int]) -> Solved:
        """Yield the result of each chunk; a worker receives its next chunk when it has returned a result."""
        waiting, losses = list(reversed(numbers)), dict.fromkeys(numbers, 0)
        for worker in crew:
            worker.order(waiting)
        while busy := [worker for worker in crew if worker.chunk is not None]:
            ready = wait([worker.connection for worker in busy])
            for worker in (worker for worker in busy if worker.connection in ready):
                number = worker.chunk
                assert number is not None, "only workers with a chunk are waited for"
                done: Done | BaseException | None
                try:
                    done = worker.connection.recv()
                except (EOFError, OSError):  # the worker is lost
                    done = None
                if isinstance(done, BaseException):
                    raise done
                if done is None:
                    losses[number] += 1
                    worker.connection.close()
                    worker.process.join()
                    crew.remove(worker)
                    worker = start()
                    if losses[number] < TRIES:
                        waiting.append(number)
                    else:
                        done = work.lost(number, f"{TRIES} workers were lost with its chunk; look for memory")
                worker.chunk = None
                worker.order(waiting)
                if done is not None:
                    yield number, done

    try:
        for _ in range(workers):
            start()
        yield solve
    finally:
        for worker in crew:
            worker.connection.close()
            worker.process.kill()
        for worker in crew:
            worker.process.join()


def _serve(work: Work, orders: Connection[Any, Any], inherited: Sequence[Connection[Any, Any]]) -> None:
    """Solve the chunks that `orders` receives, in a worker process, until `orders` closes or the parent has ended."""
    for connection in inherited:  # an open copy of a connection would hide the end of the process on the other side
        connection.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # an interrupt ends the parent, which ends its workers
    if not sys.warnoptions:
        warnings.simplefilter("ignore")
    parent = os.getppid()

    def is_wanted() -> bool:
        return os.getppid() == parent

    with threadpool_limits(1), suppress(EOFError, OSError, Abandoned):
        while True:
            while not orders.poll(_SECONDS):
                if not is_wanted():
                    return
            number = orders.recv()
            try:
                done: Done | Exception = work.solve(work.piece(number), is_wanted)
            except Abandoned:
                raise
            except Exception as error:
                done = error
            orders.send(done)
