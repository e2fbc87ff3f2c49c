"""Processes on this machine that solve chunks, and are replaced when they are lost.

On Linux workers are forks and have the modules of this process, whose machine code is loaded already; elsewhere they
load it from the disk. A worker ends by itself when the process that began it is no longer there.
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

START = "fork" if sys.platform == "linux" else "spawn"  # elsewhere libraries do not survive a fork
TRIES = 3
"""How many workers may be lost with a chunk before its cases count as lost."""
_SECONDS = 5.0
"""After so long without an order a worker looks whether the process that began it is still there."""


@contextmanager
def running(work: Work, workers: int) -> Iterator[Callable[[Sequence[int]], Solved]]:
    """Start the processes, and make sure that they end with the block; see `codegen.batch.executors.Executor`."""
    pool = _Pool(work, workers)
    try:
        yield pool.solve
    finally:
        pool.end()


@dataclass(eq=False)
class _Worker:
    """A process, the connection to it, and the chunk that it is at."""

    process: BaseProcess
    connection: Connection[Any, Any]
    chunk: int | None = None


class _Pool:
    def __init__(self, work: Work, workers: int) -> None:
        self._context: Any = multiprocessing.get_context(START)
        self._work = work.loaded() if START == "fork" else work
        self._workers: list[_Worker] = []
        for _ in range(workers):
            self._workers.append(self._started())

    def _started(self) -> _Worker:
        here, there = self._context.Pipe()
        others = [worker.connection for worker in self._workers]
        process = self._context.Process(target=_serve, args=(self._work, there, [here, *others]), daemon=True)
        process.start()
        there.close()
        return _Worker(process, here)

    def solve(self, numbers: Sequence[int]) -> Solved:
        """Give each worker a chunk, and the next one when it is done."""
        waiting, losses = list(reversed(numbers)), dict.fromkeys(numbers, 0)
        for worker in self._workers:
            self._order(worker, waiting)
        while busy := [worker for worker in self._workers if worker.chunk is not None]:
            ready = wait([worker.connection for worker in busy])
            for worker in (worker for worker in busy if worker.connection in ready):
                number, done = worker.chunk, self._received(worker)
                assert number is not None, "only workers with a chunk are listened to"
                if done is None:
                    losses[number] += 1
                    worker.connection.close()
                    worker.process.join()
                    self._workers.remove(worker)
                    self._workers.append(self._started())
                    worker = self._workers[-1]
                    if losses[number] < TRIES:
                        waiting.append(number)
                    else:
                        done = self._work.lost(number, f"{TRIES} workers were lost with its chunk; look for memory")
                worker.chunk = None
                self._order(worker, waiting)
                if done is not None:
                    yield number, done

    def _order(self, worker: _Worker, waiting: list[int]) -> None:
        if waiting:
            worker.chunk = waiting.pop()
            with suppress(OSError):  # that it is lost shows when it is listened to
                worker.connection.send(worker.chunk)

    def _received(self, worker: _Worker) -> Done | None:
        """What a worker has done, or None where it is lost; what it could not do is raised here."""
        try:
            done = worker.connection.recv()
        except (EOFError, OSError):
            return None
        if isinstance(done, BaseException):
            raise done
        assert isinstance(done, Done), "workers send what they have done, or why they could not"
        return done

    def end(self) -> None:
        """End the processes; what they are at is of no use."""
        for worker in self._workers:
            worker.connection.close()
            worker.process.kill()
        for worker in self._workers:
            worker.process.join()


def _serve(work: Work, orders: Connection[Any, Any], inherited: Sequence[Connection[Any, Any]]) -> None:
    """Solve the chunks that are ordered until there are no more orders, or nobody who gives them."""
    for connection in inherited:  # so that the end of the process that has them shows
        connection.close()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # it is the other process that is interrupted, and ends this one
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
