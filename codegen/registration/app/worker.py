"""Work beside the event loop: of what is asked for in a hurry only the newest is done."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, TypeAlias

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
