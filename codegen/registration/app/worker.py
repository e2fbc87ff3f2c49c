"""Background work of the page: jobs in threads, and the compilation of solvers in a separate process.

Deriving and compiling a solver takes about 15 s, once on a machine. The separate process keeps the page responsive. Its
command is `python -m codegen.registration.app.worker SCHEME`.
"""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import TypeAlias, TypeVar

from codegen.errors import CodegenError, ModuleError
from codegen.registration.solver import is_compiled, registration_module

Deliver: TypeAlias = Callable[[Callable[[], None]], object]
T = TypeVar("T")

# Sessions take turns, one job each. Long jobs have their own thread, so that the drag of a point is not delayed.
quick = ThreadPoolExecutor(1, thread_name_prefix="registration-quick")
slow = ThreadPoolExecutor(1, thread_name_prefix="registration-slow")
saving = ThreadPoolExecutor(1, thread_name_prefix="registration-saving")


class Worker:
    """A queue that runs the jobs of one session one after the other in the thread of a pool.

    A newer job replaces a waiting job of the same kind. Waiting jobs are started by kind, in the order of the tuple
    `order`, and then the other kinds. `deliver` calls a function in the thread of the session.
    """

    def __init__(self, deliver: Deliver, order: tuple[str, ...], pool: ThreadPoolExecutor = quick) -> None:
        self._pool = pool
        self._deliver = deliver
        self._order = order
        self._waiting: dict[str, Callable[[], Callable[[], None]]] = {}
        self._running = False
        self._lock = threading.Lock()

    def ask(
        self, kind: str, job: Callable[[], T], done: Callable[[T], None], failed: Callable[[Exception], None]
    ) -> None:
        """Do a job as soon as possible. In the thread of the session, `done` gets its result or `failed` its error."""

        def attempt() -> Callable[[], None]:
            try:
                result = job()
            except Exception as error:  # the error is shown, and the session goes on
                return partial(failed, error)
            return lambda: done(result)

        with self._lock:
            self._waiting[kind] = attempt
            if self._running:
                return
            self._running = True
        self._pool.submit(self._run)

    def drop(self, kind: str) -> None:
        """Cancel the waiting job of a kind."""
        with self._lock:
            self._waiting.pop(kind, None)

    @property
    def busy(self) -> bool:
        """True if a job runs or waits."""
        return self._running

    def _run(self) -> None:
        with self._lock:
            kind = next((kind for kind in (*self._order, *self._waiting) if kind in self._waiting), None)
            if kind is None:
                self._running = False
                return
            attempt = self._waiting.pop(kind)
        report = attempt()

        def then() -> None:
            """Report the result, and only then start the next job, so that results never accumulate."""
            try:
                report()
            finally:
                self._pool.submit(self._run)

        if not delivered(self._deliver, then):
            with self._lock:
                self._waiting.clear()
                self._running = False


def delivered(deliver: Deliver, act: Callable[[], None]) -> bool:
    """Let `deliver` call `act` in the thread of the session; return False if the session is closed."""
    try:
        deliver(act)
    except Exception:  # the page is closed
        return False
    return True


COMPILING = "The solver is being compiled, once on this machine (up to half a minute)"
MODULE = "codegen.registration.app.worker"
_LOCK = threading.Lock()
_solvers: dict[str, Future[None]] = {}


def prepared(scheme: str) -> Future[None]:
    """Return the future of the preparation of a solver, begun at the first call; it may end with a CodegenError."""
    future: Future[None] = Future()

    def prepare() -> None:
        try:
            if not is_compiled(scheme):
                compile_elsewhere(scheme)
            registration_module(scheme)
        except Exception as error:  # all waiting sessions show the error
            future.set_exception(error)
        else:
            future.set_result(None)

    with _LOCK:
        if scheme not in _solvers:
            _solvers[scheme] = future
            threading.Thread(target=prepare, name=f"registration-{scheme}", daemon=True).start()
        return _solvers[scheme]


def compile_elsewhere(scheme: str) -> None:
    """Derive and compile the solver of a scheme in a separate process; ModuleError if that fails."""
    command = [sys.executable, "-m", MODULE, scheme]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        message = (done.stderr.strip().splitlines() or ["it said nothing"])[-1]
        raise ModuleError(f"the solver could not be compiled: {message[:300]}", "mend this and start the page again")


def main(scheme: str) -> int:
    """Derive and compile the solver of a scheme; return the exit status, and write errors to stderr in one line."""
    try:
        registration_module(scheme)
    except CodegenError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
