"""The executors of this machine: threads and worker processes.

Threads share compiled code and data, and nothing is sent between them. But only one thread at a time runs Python code:
work that is not mostly compiled is done in processes, of which lost ones are replaced. On Linux, processes are forks of
this process and have its machine code. On other systems they load the machine code from the disk. A process ends by
itself when its parent process has ended.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent import futures
from contextlib import contextmanager, suppress
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from threadpoolctl import threadpool_limits

from codegen.batch.executors import Abandoned, Done, Results, Work

Item = TypeVar("Item")
Result = TypeVar("Result")
AHEAD = 2
"""Number of chunks in flight for each thread: one in progress and one that waits."""


@contextmanager
def in_threads(
    solved: Callable[[Item, Callable[[], bool]], Result], workers: int
) -> Iterator[Callable[[Iterable[Item]], Results[Item, Result]]]:
    """Yield a function that calls `solved` for items in threads, and yields each item with its result when finished.

    The second argument of `solved` is a function that returns False as soon as results are no longer wanted.
    """
    ended = threading.Event()
    with threadpool_limits(1), futures.ThreadPoolExecutor(workers) as pool:

        def solve(items: Iterable[Item]) -> Results[Item, Result]:
            waiting, in_flight = iter(items), dict[futures.Future[Result], Item]()
            while True:
                while len(in_flight) < AHEAD * workers and (item := next(waiting, None)) is not None:
                    in_flight[pool.submit(solved, item, lambda: not ended.is_set())] = item
                if not in_flight:
                    return
                done = futures.wait(in_flight, return_when=futures.FIRST_COMPLETED).done
                # Results before an error, so that no finished item is lost.
                for future in sorted(done, key=lambda future: future.exception() is not None):
                    yield in_flight.pop(future), future.result()

        try:
            yield solve
        finally:
            ended.set()
            pool.shutdown(cancel_futures=True)


@contextmanager
def threads(work: Work, workers: int) -> Iterator[Callable[[Iterable[int]], Results[int, Done]]]:
    """Yield the function that solves chunks in threads, see `Executor`.

    At the end each thread finishes its present chunk.
    """
    work = work.loaded()

    def solved(number: int, is_wanted: Callable[[], bool]) -> Done:
        return work.solve(work.piece(number), is_wanted)

    with in_threads(solved, workers) as solve:
        yield solve


START = "fork" if sys.platform == "linux" else "spawn"  # on other systems libraries do not survive a fork
TRIES = 3  # number of lost workers after which the cases of a chunk count as lost
_SECONDS = 5.0  # interval in seconds at which an idle worker checks that its parent process is alive


@contextmanager
def processes(work: Work, workers: int) -> Iterator[Callable[[Iterable[int]], Results[int, Done]]]:
    """Start processes, yield the function that solves chunks, and kill the processes at the end; see `Executor`."""
    context: Any = multiprocessing.get_context(START)
    if START == "fork":
        work = work.loaded()
    crew: dict[Connection[int, Done | BaseException], BaseProcess] = {}
    busy: dict[Connection[int, Done | BaseException], int] = {}

    def start() -> Connection[int, Done | BaseException]:
        local_end: Connection[int, Done | BaseException]
        local_end, remote_end = context.Pipe()
        crew[local_end] = context.Process(target=_serve, args=(work, remote_end, [*crew, local_end]), daemon=True)
        crew[local_end].start()
        remote_end.close()
        return local_end

    def solve(numbers: Iterable[int]) -> Results[int, Done]:
        """Yield the result of each chunk; a worker receives its next chunk when it has returned a result."""
        waiting, losses, idle = [*numbers][::-1], Counter[int](), [*crew]
        results, error = list[tuple[int, Done]](), None
        while True:
            while idle and waiting:
                busy[idle[-1]] = waiting.pop()
                with suppress(OSError):  # a lost worker is detected below
                    idle[-1].send(busy[idle[-1]])
                idle.pop()
            yield from results  # before an error, so that no finished chunk is lost
            if error is not None:
                raise error
            if not busy:
                return
            ready, results = wait([*busy]), []
            for connection in [connection for connection in busy if connection in ready]:
                number = busy.pop(connection)
                try:
                    done: Done | BaseException = connection.recv()
                    idle.append(connection)
                except (EOFError, OSError):  # the worker is lost
                    losses[number] += 1
                    connection.close()
                    crew.pop(connection).join()
                    idle.append(start())
                    if losses[number] < TRIES:
                        waiting.append(number)
                        continue
                    done = work.lost(number, f"{TRIES} workers were lost with its chunk; look for memory")
                if isinstance(done, BaseException):
                    error = done
                else:
                    results.append((number, done))

    try:
        for _ in range(workers):
            start()
        yield solve
    finally:
        for connection, process in crew.items():
            connection.close()
            process.kill()
        for process in crew.values():
            process.join()


def _serve(
    work: Work,
    orders: Connection[Done | BaseException, int],
    inherited: Sequence[Connection[int, Done | BaseException]],
) -> None:
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
