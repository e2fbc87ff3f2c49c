"""Work beside the event loop: of what is asked for in a hurry only the newest is done.

The solver of registrations, made ready beside the server: the page can be used while it is being compiled. Deriving and
compiling it takes some 15 s of work, once on a machine. A process of its own does that, so that the page answers
meanwhile; `python -m codegen.registration.app.worker SCHEME` is that process.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache
from typing import Any, TypeAlias

from codegen.errors import CodegenError, ModuleError
from codegen.registration.solver import is_compiled, registration_module

Job: TypeAlias = Callable[[], Any]
Deliver: TypeAlias = Callable[[Callable[[], Any]], None]

# Sessions take turns, one job each; what takes long must not keep anyone's dragged point waiting.
quick = ThreadPoolExecutor(1, thread_name_prefix="registration-quick")
slow = ThreadPoolExecutor(1, thread_name_prefix="registration-slow")
# Nor may anything keep a work from being saved.
saving = ThreadPoolExecutor(1, thread_name_prefix="registration-saving")


class Worker:
    """Runs jobs of one session one after the other in the thread of a pool.

    `deliver` hands a function to the session's own thread. A job that was not begun when a newer one of the same
    `kind` comes is dropped; kinds are begun in the order of `order`, others after them.
    """

    def __init__(self, deliver: Deliver, order: tuple[str, ...], pool: ThreadPoolExecutor = quick) -> None:
        self._pool = pool
        self._deliver = deliver
        self._order = order
        self._waiting: dict[str, tuple[Job, Callable[[Any], None], Callable[[Exception], None]]] = {}
        self._running = False
        self._lock = threading.Lock()

    def ask(self, kind: str, job: Job, done: Callable[[Any], None], failed: Callable[[Exception], None]) -> None:
        """Do a job as soon as possible; `done` gets its result, `failed` what it raised."""
        with self._lock:
            self._waiting[kind] = (job, done, failed)
            if self._running:
                return
            self._running = True
        self._pool.submit(self._run)

    def drop(self, kind: str) -> None:
        """Forget a job that was not begun."""
        with self._lock:
            self._waiting.pop(kind, None)

    @property
    def busy(self) -> bool:
        """Whether anything runs or waits."""
        return self._running

    def _run(self) -> None:
        with self._lock:
            kind = next((kind for kind in (*self._order, *self._waiting) if kind in self._waiting), None)
            if kind is None:
                self._running = False
                return
            job, done, failed = self._waiting.pop(kind)
        try:
            result = job()
        except Exception as error:  # whatever happens to one job is shown, and the session goes on
            caught = error  # the name `error` ends with this block
            self._finish(lambda: failed(caught))
            return
        self._finish(lambda: done(result))

    def _finish(self, report: Callable[[], None]) -> None:
        """Report in the session's thread, and only then begin the next job: results never pile up."""

        def then() -> None:
            try:
                report()
            finally:
                self._pool.submit(self._run)

        if not delivered(self._deliver, then):
            with self._lock:
                self._waiting.clear()
                self._running = False


def delivered(deliver: Deliver, act: Callable[[], Any]) -> bool:
    """Hand a function to a session's thread; False when the session has been closed."""
    try:
        deliver(act)
    except Exception:  # its page is gone, and nobody can be told
        return False
    return True


COMPILING = "The solver is being compiled, once on this machine (up to half a minute)"
MODULE = "codegen.registration.app.worker"
_LOCK = threading.Lock()


def prepared(scheme: str) -> Future[None]:
    """The solver of a scheme, which begins to be made ready when it is asked for the first time in this process.

    The future fails with a CodegenError where the solver cannot be derived or compiled.
    """
    with _LOCK:
        return _begun(scheme)


@cache
def _begun(scheme: str) -> Future[None]:
    future: Future[None] = Future()

    def prepare() -> None:
        try:
            if not is_compiled(scheme):
                compile_elsewhere(scheme)
            registration_module(scheme)
        except Exception as error:  # every session that waits is told
            future.set_exception(error)
        else:
            future.set_result(None)

    threading.Thread(target=prepare, name=f"registration-{scheme}", daemon=True).start()
    return future


def compile_elsewhere(scheme: str) -> None:
    """Derive and compile the solver in a process of its own; ModuleError says why that failed."""
    command = [sys.executable, "-m", MODULE, scheme]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        said = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise ModuleError(f"the solver could not be compiled: {said[:300]}", "mend this and start the page again")


def main(scheme: str) -> int:
    """Derive and compile; what is wrong goes to stderr as one line."""
    try:
        registration_module(scheme)
    except CodegenError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
