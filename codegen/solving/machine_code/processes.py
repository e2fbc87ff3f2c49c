"""Processes that compile: started before a module is derived, they get numba ready while it is.

This file imports neither numpy nor numba, so that they start at once.

Machine code of modules that have none yet, made by processes that are quick at it before anything is called.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.errors import one_line

if TYPE_CHECKING:
    from codegen.errors import FileError
    from codegen.solving.loading import GeneratedModule

CAN_FORK = hasattr(os, "fork")
START = """
import runpy, sys
folder = sys.argv.pop(1)
if folder not in sys.path:
    sys.path.insert(0, folder)
runpy.run_module("codegen.solving.machine_code.compilation", run_name="__main__", alter_sys=True)
"""
"""The program of a process: it takes this very package, and not one that lies in the current folder."""
NOTE = "codegen: note: "
"""How a line begins that is no error."""
COUNT, DONE = "codegen: parts: ", "codegen: part done"
"""The start of the line with the number of parts, and the line for each compiled part."""


class Compilers:
    """Processes that get numba ready, and compile a module when they have its path."""

    def __init__(self) -> None:
        self.failure = ""  # type and message of the error by which a process failed
        self.notes: list[str] = []  # what processes had to say beside
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start the processes, unless they have been started."""
        if self.processes:
            return
        self.processes = [
            subprocess.Popen(
                [sys.executable, "-P", "-c", START, str(Path(__file__).parents[3]), share],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                process_group=0 if CAN_FORK else None,
            )
            for share in shares()
        ]

    def compile(self, path: Path, tell: Callable[[int, int], None] = lambda done, count: None) -> bool:
        """Compile all that solutions of a module call; return True if it is on the disk now.

        `tell` is called with how many parts are done, and how many there are. If a process has failed, `failure` tells
        by which error.
        """
        self.start()
        for process in self.processes:
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # its exit status will tell
                process.stdin.write(os.fsencode(path.absolute()))
                process.stdin.close()
        errors, done, count = [], 0, 0
        for process in self.processes:
            assert process.stdout is not None
            for line in (line.decode(errors="replace").rstrip("\n") for line in process.stdout):
                if line.startswith(COUNT):
                    count = int(line.removeprefix(COUNT))
                elif line == DONE:
                    done += 1
                    tell(done, count)
                elif line.startswith(NOTE):
                    self.notes.append(line)
                else:
                    errors.append(line)
        statuses = [process.wait() for process in self.processes]
        if any(statuses):
            self.failure = errors[0] if errors else f"a process ended with status {max(statuses, key=abs)}"
        return not any(statuses)

    @property
    def said(self) -> list[str]:
        """Lines for whoever waits: notes, and by which error machine code could not be made ahead, if it could not."""
        if not self.failure:
            return self.notes
        reason = f"machine code could not be made ahead ({one_line(self.failure)}); a first solve has made it"
        return [*self.notes, f"codegen: {reason}"]

    def end(self) -> None:
        """End the processes, and those that they have become, if they have not ended by themselves."""
        for process in self.processes:
            if process.poll() is None and CAN_FORK:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
            process.kill()
            process.wait()
            if process.stdin is not None:
                with suppress(BrokenPipeError):
                    process.stdin.close()
            if process.stdout is not None:
                process.stdout.close()


@contextmanager
def compilers() -> Iterator[Compilers]:
    """Provide processes that can be started, and make sure that they end with the block."""
    processes = Compilers()
    try:
        yield processes
    finally:
        processes.end()


def shares() -> tuple[str, ...]:
    """Return the shares of the processes that are to be started."""
    if (os.cpu_count() or 1) == 1:
        return ("0/1",)
    return ("both",) if CAN_FORK else ("0/2", "1/2")


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
    from codegen.solving.machine_code.compilation import parts_of

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
