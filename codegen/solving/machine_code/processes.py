"""Processes that compile machine code, and the compilation of modules whose machine code is not on the disk.

The processes start before a module is derived, and load numba during the derivation. This file imports neither numpy
nor numba, so that the processes start without delay.
"""

from __future__ import annotations

import hashlib
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.errors import one_line

if TYPE_CHECKING:
    from codegen.errors import FileError
    from codegen.solving.loading import GeneratedModule

CAN_FORK = hasattr(os, "fork")
"""True if the operating system can fork a process."""
START = """
import runpy, sys
folder = sys.argv.pop(1)
if folder not in sys.path:
    sys.path.insert(0, folder)
runpy.run_module("codegen.solving.machine_code.compilation", run_name="__main__", alter_sys=True)
"""
"""The program of a process. It imports this package, not a package of the same name in the current folder."""
NOTE = "codegen: note: "
"""Prefix of an output line of a process that is a note and no error."""
COMPILING, ONCE = "Compiling", "Compiling the solver, once on this machine"
"""Texts of the progress display; the second one is shown if functions of the runtime are compiled as well."""
_LOCKS: dict[Path, threading.Lock] = {}
"""A lock for the file of each module: only one thread compiles a module, and other threads wait for the result."""


class Compilers:
    """Processes that load numba, and compile a module when they receive its path."""

    def __init__(self) -> None:
        self.failure = ""  # type and message of the error of a process; empty if all succeed
        self.notes: list[str] = []  # notes that processes printed
        self.processes: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        """Start the processes, unless they have been started before."""
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
        """Compile all functions that the solver of the module in the file `path` calls; return True on success.

        `tell` is called after each part with the number of finished parts and the number of all parts. If a process
        fails, `failure` has its error.
        """
        from codegen.solving.machine_code.compilation import COUNT, DONE

        self.start()
        for process in self.processes:
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # the exit status of the process reports the failure
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
    def notices(self) -> list[str]:
        """Lines for the user: the notes of the processes, and the error of a failed compilation."""
        if not self.failure:
            return self.notes
        reason = f"machine code could not be made ahead ({one_line(self.failure)}); a first solve has made it"
        return [*self.notes, f"codegen: {reason}"]

    def end(self) -> None:
        """End the processes and their forks, if they are still running."""
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
    """Provide processes, which are not started yet, and end them at the end of the with block."""
    processes = Compilers()
    try:
        yield processes
    finally:
        processes.end()


def shares() -> tuple[str, ...]:
    """Return an argument for each process to start, which selects its parts; see `compilation.main`."""
    if (os.cpu_count() or 1) == 1:
        return ("0/1",)
    return ("both",) if CAN_FORK else ("0/2", "1/2")


def require(
    path: Path,
    module: GeneratedModule,
    is_new: bool,
    working: Callable[[str], AbstractContextManager[object]],
    processes: Compilers | None = None,
) -> tuple[float, list[str]]:
    """Compile a module unless all its machine code is on the disk; return the seconds, and lines for the user.

    A module that `is_new` was derived just now, and is always compiled. `working` displays a text in a with block, and
    its value may have a method `update` for progress. `processes` may have been started before; None means new ones.
    """
    from codegen.solving.machine_code.compilation import parts_of

    with _LOCKS.setdefault(path.resolve(), threading.Lock()):
        missing = [part for part in parts_of(module) if not part.is_kept]
        if not missing and not (is_new and parts_of(module)):
            return 0.0, []
        begin = time.perf_counter()
        text = ONCE if any(part.serves == "runtime" for part in missing) else COMPILING
        with nullcontext(processes) if processes else compilers() as started, working(text) as line:

            def tell(done: int, count: int) -> None:
                if hasattr(line, "update"):
                    line.update(f"{text}: {done} of {count} parts ...")

            prepare(path, started, tell)
        return time.perf_counter() - begin, started.notices


def prepare(path: Path, processes: Compilers, tell: Callable[[int, int], None] = lambda done, count: None) -> None:
    """Compile all functions that the solver of a module calls; compile them in this process if `processes` fail.

    `tell` is called after each part with the number of finished parts and the number of all parts.
    """
    if processes.compile(path, tell):
        return
    from codegen.solving.loading import load  # importing numpy at the top would delay the start of the processes
    from codegen.solving.machine_code.compilation import compile_all

    module = load(path)
    try:
        compile_all(module)
    except OSError as error:
        raise unwritable_cache_error(module, error) from error


@dataclass(frozen=True)
class Target:
    """The target of machine code: the processor, a digest of its features, and the versions of numba and Python."""

    processor: str
    features: str
    numba: str
    python: str

    def __str__(self) -> str:
        return f"{self.processor} with numba {self.numba}"


def target() -> Target:
    """Return the target of machine code for this machine."""
    import numba
    from llvmlite import binding

    settings: Any = numba.config
    processor = settings.CPU_NAME or binding.get_host_cpu_name()
    features = settings.CPU_FEATURES or binding.get_host_cpu_features().flatten()
    if processor == "generic":  # numba then uses no features
        features = ""
    digest = hashlib.sha256(str(features).encode()).hexdigest()[:8]
    return Target(str(processor), digest, numba.__version__, platform.python_version())


def compiled_note(module: str, origin: Target, work: str) -> str:
    """Return a note that a worker compiled a module; `work` names the task that began on the machine `origin`."""
    local = target()
    reason = "" if local == origin else f"; {work} was begun on {origin}"
    return f"{platform.node()}: compiled {module} for {local}{reason}"


def unwritable_cache_error(module: GeneratedModule, error: OSError) -> FileError:
    """Return the error for machine code that cannot be written to the disk, with the folder and the remedy."""
    from codegen.files import refused
    from codegen.runtime.kept_code import code_folder

    folder = error.filename or code_folder(getattr(module, "__file__", "")) or "the folder of machine code"
    return refused(error, folder, "make room there, or let NUMBA_CACHE_DIR name a folder that may be written to")
