"""The time that numba takes for machine code, compiled or read from the disk, while something runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from numba.core.event import Event, Listener, install_listener


class CodeSeconds(Listener):  # type: ignore[misc, unused-ignore]  # numba is annotated in parts
    """The seconds in which one thread has held numba's compiler, which compiles functions and reads them."""

    def __init__(self) -> None:
        self.seconds, self._thread, self._depth, self._begin = 0.0, threading.get_ident(), 0, 0.0

    def on_start(self, event: Event) -> None:
        """Begin, unless one function is compiled for another one."""
        if threading.get_ident() != self._thread:
            return
        if self._depth == 0:
            self._begin = time.perf_counter()
        self._depth += 1

    def on_end(self, event: Event) -> None:
        """Add the time of the outermost function."""
        if threading.get_ident() != self._thread:
            return
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._begin


@contextmanager
def seconds_of_machine_code() -> Iterator[CodeSeconds]:
    """Measure the time in which numba compiles and reads functions in this thread, within the block."""
    with install_listener("numba:compiler_lock", CodeSeconds()) as listener:
        yield listener
