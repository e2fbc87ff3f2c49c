"""A cluster of dask: its scheduler gives chunks to workers, which compile modules and write what they solve.

The client keeps a bounded number of chunks in flight, so that neither its memory nor the scheduler's grows with the
cases. What is lost with a worker the scheduler has done again; what is lost with the scheduler is left to work that
is resumed: chunks count when they are in the journal, and writing one twice writes the same numbers.
"""

from __future__ import annotations

import logging
import signal
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from queue import Empty, SimpleQueue
from typing import Any

import dask
from distributed import Client, KilledWorker, LocalCluster, WorkerPlugin, get_worker
from threadpoolctl import ThreadpoolController

from codegen.batch.executors import LOCAL, Solved
from codegen.batch.executors.chunks import Done, Parcel, Work
from codegen.errors import ArgumentError, ClusterError, CodegenError, clause, one_line

TRIES = 3
"""How many workers of a cluster of our own may be lost with a chunk before its cases count as lost."""
PATIENCE = 8.0
"""Seconds to wait for a scheduler to answer, and then for it to have a worker."""
DESERTED = 120.0
"""Seconds to wait for another worker when the last one is lost."""
AHEAD = 2
"""Chunks in flight for each thread of a worker: one that it solves, and one that is waiting there."""
_POLL = 2.0
_CLIENT: Any = Client  # dask has few types
_CLUSTER: Any = LocalCluster
_LOGGERS = ("distributed", "tornado", "asyncio", "bokeh")
_RESUME = "what is written stays; begin the cluster again, and give --resume"


@contextmanager
def connected(cluster: Any) -> Iterator[Any]:
    """A client of the scheduler at an address; a client, and the word for a cluster of our own, stay what they are.

    Raises ClusterError when nothing answers or there are no workers, and ArgumentError for what is neither.
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
        client = _client(cluster)
        try:
            _require_workers(client)
            yield client
        finally:
            _close(client)


@contextmanager
def running(work: Work, workers: int, cluster: Any = LOCAL) -> Iterator[Callable[[Sequence[int]], Solved]]:
    """Have workers of a cluster get ready, a local one of so many if it is none yet; see `codegen.batch.executors`."""
    parcel = work.parcel()
    with ExitStack() as stack:
        is_ours = cluster == LOCAL
        client = stack.enter_context(_local(workers)) if is_ours else cluster
        crew = _Crew(client, work, Solver(parcel, is_ours))
        try:
            yield crew.solve
        finally:
            crew.end()


def _client(address: str) -> Any:
    remedy = "give the address that `dask scheduler` prints, such as tcp://10.0.0.5:8786, or local"
    if not address.strip():
        raise ArgumentError("--cluster without an address", remedy)
    try:
        return _CLIENT(address, timeout=PATIENCE, set_as_default=False)
    except Exception as error:  # whatever the part of the address is that dask cannot read
        reason = one_line(str(error) or type(error).__name__, 120)
        raise ClusterError(clause(f"--cluster {address}: no scheduler answers ({reason})"), remedy) from None


def _require_workers(client: Any) -> None:
    try:
        client.wait_for_workers(1, timeout=PATIENCE)
    except Exception:  # also where the scheduler is lost meanwhile
        remedy = "begin some, as `dask worker ADDRESS --nthreads 1 --nworkers 8`"
        raise ClusterError("the cluster has no workers", remedy) from None


@contextmanager
def _local(workers: int) -> Iterator[Any]:
    with _quiet(), dask.config.set({"distributed.scheduler.allowed-failures": TRIES - 1}):
        cluster = _CLUSTER(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            dashboard_address=None,
            scheduler_kwargs={"dashboard_address": ":0"},  # any port: another cluster may have the usual one
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
        with cluster, _CLIENT(cluster, set_as_default=False) as client:
            yield client


@contextmanager
def _quiet() -> Iterator[None]:
    """Nothing of dask on the terminal: what matters is an error of ours."""
    known = [name for name in logging.root.manager.loggerDict if name.partition(".")[0] in _LOGGERS]
    levels = {logging.getLogger(name): logging.getLogger(name).level for name in (*known, *_LOGGERS)}
    for logger in levels:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in levels.items():
            logger.setLevel(level)


def _close(client: Any) -> None:
    with suppress(Exception):  # it is of no use any longer, whatever became of it
        client.close(timeout=1.0)


class _Crew:
    """The workers of a cluster, as far as this work has to do with them."""

    def __init__(self, client: Any, work: Work, solver: Solver) -> None:
        self._client, self._work, self._name = client, work, f"codegen-{uuid.uuid4().hex}"
        self._flying: dict[str, tuple[int, Any]] = {}
        self._arrived: SimpleQueue[str] = SimpleQueue()
        self._sent = 0
        self._threads, self._asked, self._seen = 0, 0.0, time.monotonic()
        _require_workers(client)
        try:
            client.register_plugin(solver, name=self._name)
        except Exception as error:  # raised there, where codegen may not even be installed
            reason = one_line(f"{type(error).__name__}: {error}", 200)
            remedy = "install the same version of variational-codegen for the scheduler and all workers"
            raise ClusterError(clause(f"workers of the cluster cannot be made ready ({reason})"), remedy) from None

    def solve(self, numbers: Sequence[int]) -> Solved:
        """Keep as many chunks in flight as workers need; each is done when it comes back.

        A chunk whose workers were lost may only have waited beside the one that was to blame. So it is tried again at
        the end, alone.
        """
        left, suspects = iter(numbers), list[int]()
        while True:
            while len(self._flying) < self._most() and (number := next(left, None)) is not None:
                self._send(number)
            if not self._flying:
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
        self._sent += 1  # one that comes back without result gets another key
        key = f"{self._name}-{self._sent}"
        piece = self._work.piece(number)
        try:
            future = self._client.submit(_solve, self._name, piece, key=key, pure=False)
        except Exception as error:
            raise self._lost(error) from None
        self._flying[key] = number, future
        future.add_done_callback(lambda finished: self._arrived.put(finished.key))

    def _next(self) -> str:
        """The key of a chunk that has come back; ClusterError where none can any longer."""
        while True:
            try:
                return self._arrived.get(timeout=_POLL)
            except Empty:
                self._most()  # which looks for workers
                if time.monotonic() > self._seen + DESERTED:
                    raise ClusterError(f"the cluster has had no workers for {DESERTED:.0f} s", _RESUME) from None

    def _received(self) -> tuple[int, Done | None]:
        """The next chunk, where it belongs, or None if its workers were lost; what a worker could not do is raised."""
        number, future = self._flying.pop(self._next())
        try:
            done = future.result()
        except KilledWorker:
            return number, None
        except Exception as error:  # none of our own, which are values
            raise self._lost(error) from None
        future.release()
        if isinstance(done, BaseException):
            raise done
        assert isinstance(done, Done), "workers send what they have done, or why they could not"
        return number, self._work.returned(number, done)

    def _lost(self, error: Exception) -> CodegenError:
        reason = one_line(str(error) or type(error).__name__, 150)
        return ClusterError(clause(f"the scheduler of the cluster was lost ({reason})"), _RESUME)

    def _most(self) -> int:
        """How many chunks may be in flight, as workers come and go: one waits where there are none."""
        now = time.monotonic()
        if now > self._asked + _POLL:
            try:
                self._threads, self._asked = sum(self._client.nthreads().values()), now
            except Exception as error:
                raise self._lost(error) from None
            self._seen = now if self._threads else self._seen
        return max(1, AHEAD * self._threads)

    def end(self) -> None:
        """Take back what is in flight, and leave nothing with the workers, as far as they can be reached."""
        if self._client.status != "running":
            return
        with suppress(Exception):
            self._client.cancel([future for _, future in self._flying.values()], force=True)
            self._client.unregister_worker_plugin(self._name)


class Solver(WorkerPlugin):
    """What a worker has of the work: the parcel until the first chunk comes, then the work, and one thread to do it."""

    def __init__(self, parcel: Parcel, is_ours: bool) -> None:
        self._parcel, self._is_ours = parcel, is_ours

    def setup(self, worker: Any) -> None:
        """Be there; compiling would keep the worker from answering."""
        self._lock = threading.Lock()
        self._libraries = ThreadpoolController()
        self._work: Work | None = None
        if self._is_ours and threading.current_thread() is threading.main_thread():
            # A terminal interrupts all of its processes. It is the client that is meant, and ends this one.
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def __call__(self, piece: Any) -> Done:
        """Solve a chunk; what is to be said of this machine comes with the first."""
        with self._lock, self._libraries.limit(limits=1):
            notes: tuple[str, ...] = ()
            if self._work is None:
                self._work, notes = self._parcel.unpacked()
            done = self._work.solve(piece)
            return replace(done, notes=(*notes, *done.notes))


def _solve(name: str, piece: Any) -> Done | Exception:
    """Solve a chunk on a worker; what it could not do is a value, which dask does not take for its own failure."""
    try:
        solver: Any = get_worker().plugins[name]
        return solver(piece)  # type: ignore[no-any-return]
    except Exception as error:
        return error if isinstance(error, CodegenError | OSError | MemoryError) else RuntimeError(repr(error))
