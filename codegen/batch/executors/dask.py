"""The executor for a cluster of dask, whose workers compile modules and store the results of their chunks.

The client bounds the number of chunks in flight, which are sent to workers and not yet returned. So the memory of
client and scheduler does not grow with the number of cases. The scheduler repeats chunks of lost workers. After the
loss of the scheduler the work can be resumed from its journal: a chunk that is written twice has the same numbers.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any

from dask import config
from distributed import Client, KilledWorker, LocalCluster, WorkerPlugin, get_worker
from threadpoolctl import ThreadpoolController

from codegen.batch.executors import LOCAL, Done, Parcel, Results, Work
from codegen.errors import ArgumentError, ClusterError, CodegenError, clause, one_line

TRIES = 3  # number of lost workers of a local cluster after which the cases of a chunk count as lost
PATIENCE = 8.0  # seconds to wait for the scheduler, and then for a worker
DESERTED = 120.0  # seconds to wait for a new worker when all are lost
AHEAD = 2
"""Number of chunks in flight for each thread of a worker: one in progress and one in its queue."""
_POLL = 2.0
_CLIENT: Any = Client  # dask has few types
_CLUSTER: Any = LocalCluster
_LOGGERS = ("distributed", "tornado", "asyncio", "bokeh")
_RESUME = "what is written stays; begin the cluster again, and give --resume"


@contextmanager
def connected(cluster: object) -> Iterator[Any]:
    """Yield a client of the scheduler at an address, or `cluster` itself if it is a client or LOCAL.

    Raises ClusterError if no scheduler answers or there are no workers, and ArgumentError for other values.
    """
    if isinstance(cluster, Client):
        if cluster.asynchronous:
            raise ArgumentError("the client of the cluster is asynchronous", "give a distributed.Client(address)")
        _require_workers(cluster)
        yield cluster
        return
    if not isinstance(cluster, str):
        raise ArgumentError(f"cluster is {clause(repr(cluster))}", "give an address, a distributed.Client, or local")
    if cluster == LOCAL:
        yield cluster
        return
    with _quiet():
        remedy = "give the address that `dask scheduler` prints, such as tcp://10.0.0.5:8786, or local"
        if not cluster.strip():
            raise ArgumentError("--cluster without an address", remedy)
        try:
            client = _CLIENT(cluster, timeout=PATIENCE, set_as_default=False)
        except Exception as error:  # dask raises errors of many types for an invalid address
            reason = one_line(str(error) or type(error).__name__, 120)
            raise ClusterError(clause(f"--cluster {cluster}: no scheduler answers ({reason})"), remedy) from None
        try:
            _require_workers(client)
            yield client
        finally:
            with suppress(Exception):  # the client is not used any more: its errors do not matter
                client.close(timeout=1.0)


@contextmanager
def dask(
    work: Work, workers: int, cluster: object = LOCAL
) -> Iterator[Callable[[Iterable[int]], Results[int, Done]]]:  # fmt: skip
    """Prepare the workers of a cluster, or start a local cluster, and yield the function that solves chunks."""
    parcel = work.parcel()
    with ExitStack() as stack:
        is_local = cluster == LOCAL
        client = stack.enter_context(_local(workers)) if is_local else cluster
        crew = _Crew(client, work, Solver(parcel, is_local))
        try:
            yield crew.solve
        finally:
            crew.end()


def _require_workers(client: Any) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except Exception:  # also when the scheduler is lost
        remedy = "begin some, as `dask worker ADDRESS --nthreads 1 --nworkers 8`"
        raise ClusterError("the cluster has no workers", remedy) from None


@contextmanager
def _local(workers: int) -> Iterator[Any]:
    with _quiet(), config.set({"distributed.scheduler.allowed-failures": TRIES - 1}):
        cluster = _CLUSTER(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": ":0"},  # any port: another cluster may use the default port
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
        client = _CLIENT(cluster, set_as_default=False)
        try:
            yield client
        finally:
            with suppress(Exception):  # a worker that is still starting cannot be closed: distributed raises an error
                client.wait_for_workers(workers, timeout=PATIENCE)
            for connection in (client, cluster):
                with suppress(Exception):  # all results have arrived, or another error is being raised
                    connection.close()


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the loggers of dask: this package reports errors itself."""
    known = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] in _LOGGERS]
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in (*known, *_LOGGERS)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


class _Crew:
    """The workers of a cluster that solve the chunks of one work, and the chunks in flight."""

    def __init__(self, client: Any, work: Work, solver: Solver) -> None:
        self._client, self._work, self._name = client, work, f"codegen-{uuid.uuid4().hex}"
        self._in_flight: dict[str, tuple[int, Any]] = {}
        self._arrived: SimpleQueue[str] = SimpleQueue()
        self._sent = 0
        self._threads, self._asked, self._seen = 0, 0.0, time.monotonic()
        _require_workers(client)
        try:
            client.register_plugin(solver, name=self._name)
        except Exception as error:  # raised on the worker, where codegen may be missing
            reason = one_line(f"{type(error).__name__}: {error}", 200)
            remedy = "install the same version of variational-codegen for the scheduler and all workers"
            raise ClusterError(clause(f"workers of the cluster cannot be made ready ({reason})"), remedy) from None

    def solve(self, numbers: Iterable[int]) -> Results[int, Done]:
        """Keep the queues of the workers filled, and yield the result of each chunk when it is finished.

        A chunk can be lost because of another chunk that ended its worker. So lost chunks are repeated one at a time
        after all others.
        """
        waiting, suspects = iter(numbers), list[int]()
        while True:
            while len(self._in_flight) < self._capacity() and (number := next(waiting, None)) is not None:
                self._send(number)
            if not self._in_flight:
                break
            number, done = self._received()
            if done is None:
                suspects.append(number)
            else:
                yield number, done
        for number in suspects:
            self._send(number)
            _, done = self._received()
            yield number, done or self._work.lost(number, "several workers were lost with its chunk; look for memory")

    def _send(self, number: int) -> None:
        self._sent += 1  # a chunk that is sent again gets another key
        key = f"{self._name}-{self._sent}"
        piece = self._work.piece(number)
        try:
            future = self._client.submit(_solve, self._name, piece, key=key, pure=False)
        except Exception as error:
            raise self._lost(error) from None
        self._in_flight[key] = number, future
        future.add_done_callback(lambda finished: self._arrived.put(finished.key))

    def _received(self) -> tuple[int, Done | None]:
        """Return number and result of the next finished chunk, with None as result if its workers were lost.

        Raises the error of a worker, and ClusterError if the cluster has had no workers for DESERTED seconds.
        """
        key = None
        while key is None:
            try:
                key = self._arrived.get(timeout=_POLL)
            except Empty:
                self._capacity()  # this counts the workers
                if time.monotonic() > self._seen + DESERTED:
                    raise ClusterError(f"the cluster has had no workers for {DESERTED:.0f} s", _RESUME) from None
        number, future = self._in_flight.pop(key)
        try:
            done = future.result()
        except KilledWorker:
            return number, None
        except Exception as error:  # an error of dask: errors of this package are returned as values
            raise self._lost(error) from None
        future.release()
        if isinstance(done, BaseException):
            raise done
        assert isinstance(done, Done), "workers return results or errors"
        return number, self._work.returned(number, done)

    def _lost(self, error: Exception) -> CodegenError:
        reason = one_line(str(error) or type(error).__name__, 150)
        return ClusterError(clause(f"the scheduler of the cluster was lost ({reason})"), _RESUME)

    def _capacity(self) -> int:
        """Return the number of chunks, at least one, that may be in flight with the present workers."""
        now = time.monotonic()
        if now > self._asked + _POLL:
            try:
                self._threads, self._asked = sum(self._client.nthreads().values()), now
            except Exception as error:
                raise self._lost(error) from None
            self._seen = now if self._threads else self._seen
        return max(1, AHEAD * self._threads)

    def end(self) -> None:
        """Cancel the chunks in flight and unregister the work, if the workers can be reached."""
        if self._client.status != "running":
            return
        with suppress(Exception):
            self._client.cancel([future for _, future in self._in_flight.values()], force=True)
            self._client.unregister_worker_plugin(self._name)


class Solver(WorkerPlugin):
    """The plugin by which a dask worker solves chunks, one at a time; the first chunk unpacks the parcel."""

    def __init__(self, parcel: Parcel, is_local: bool) -> None:
        self._parcel, self._is_local = parcel, is_local

    def setup(self, worker: object) -> None:
        """Prepare the worker, without compilation: during compilation the worker would not answer the scheduler."""
        self._lock = threading.Lock()
        self._libraries = ThreadpoolController()
        self._work: Work | None = None
        if self._is_local and threading.current_thread() is threading.main_thread():
            # A terminal interrupts all of its processes. The client handles the interrupt and ends the workers.
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def __call__(self, piece: object) -> Done:
        """Solve a chunk; the first result has the notes about this machine."""
        with self._lock, self._libraries.limit(limits=1):
            notes: tuple[str, ...] = ()
            if self._work is None:
                self._work, notes = self._parcel.unpacked()
            done = self._work.solve(piece)
            return replace(done, notes=(*notes, *done.notes))


def _solve(name: str, piece: object) -> Done | Exception:
    """Solve a chunk on a worker and return the result or the error: dask treats exceptions as its own failures."""
    try:
        solver: Any = get_worker().plugins[name]
        return solver(piece)  # type: ignore[no-any-return]
    except Exception as error:
        return error if isinstance(error, CodegenError | OSError | MemoryError) else RuntimeError(repr(error))
