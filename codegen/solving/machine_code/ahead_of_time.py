"""Machine code of modules that have none yet, made by processes that are quick at it before anything is called.

The time that numba takes for machine code, compiled or read from the disk, while something runs.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from numba.core.event import Event, Listener, install_listener

from codegen.solving.machine_code.processes import Compilers, compilers

if TYPE_CHECKING:
    from codegen.errors import FileError
    from codegen.solving.interfaces import GeneratedModule

_COMPILING: dict[Path, threading.Lock] = {}
"""Threads that want the same module wait for the first of them, and find what it has made."""
COMPILING, ONCE = "Compiling", "Compiling the solver, once on this machine"


def require(
    path: Path,
    module: GeneratedModule,
    is_new: bool,
    working: Callable[[str], AbstractContextManager[Any]],
    processes: Compilers | None = None,
) -> tuple[float, list[str]]:
    """Compile a module that lacks machine code; return the seconds, and what there is to say about it.

    `processes` may have been started before. `working` shows a sign of life.
    """
    from codegen.solving.machine_code.parts import parts_of

    with _COMPILING.setdefault(path.resolve(), threading.Lock()):
        missing = [part for part in parts_of(module) if not part.is_kept]
        if not missing and not (is_new and parts_of(module)):
            return 0.0, []
        begin = time.perf_counter()
        what = ONCE if any(part.serves == "runtime" for part in missing) else COMPILING
        with nullcontext(processes) if processes else compilers() as started, working(what) as line:
            prepare(path, started, lambda done, count: _tell(line, f"{what}: {done} of {count} parts ..."))
        return time.perf_counter() - begin, started.said


def _tell(line: Any, text: str) -> None:
    if hasattr(line, "update"):
        line.update(text)


def prepare(path: Path, processes: Compilers, tell: Callable[[int, int], None] = lambda done, count: None) -> None:
    """Compile all that a solution of a module calls, in this process if others fail."""
    if processes.compile(path, tell):
        return
    from codegen.solving.loading import load  # only now: importing arrays takes a fifteenth of a build
    from codegen.solving.machine_code.compilation import compile_all

    module = load(path)
    try:
        compile_all(module)
    except OSError as error:
        raise unwritable_cache_error(module, error) from error


def unwritable_cache_error(module: GeneratedModule, error: OSError) -> FileError:
    """The error that says where machine code of a module cannot be written, and what to do about it."""
    from codegen.files import refused
    from codegen.runtime.kept_code import code_folder

    folder = error.filename or code_folder(getattr(module, "__file__", "")) or "the folder of machine code"
    return refused(error, folder, "make room there, or let NUMBA_CACHE_DIR name a folder that may be written to")


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
