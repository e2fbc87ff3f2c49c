"""Processes that compile: started before a module is derived, they get numba ready while it is.

This file imports neither numpy nor numba, so that they start at once.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from codegen.errors import one_line

CAN_FORK = hasattr(os, "fork")
NOTE = "codegen: note: "
"""How a line begins that is no error."""
UNFINISHED = 3
"""Exit status of a process that has compiled its share, where the shares together are not all that `solve` calls."""


class Compilers:
    """Processes that have numba ready and compile a module between them when they are told to."""

    def __init__(self) -> None:
        self.failure = ""  # type and message of the error by which a process failed
        self.notes: list[str] = []  # what processes had to say beside
        self.processes = [
            subprocess.Popen(
                [sys.executable, "-m", "codegen.machine_code.compilation", share],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
                process_group=0 if CAN_FORK else None,
            )
            for share in shares()
        ]

    def compile(self, path: Path) -> bool:
        """Whether all that `solve` calls is now on disk, compiled; never so where particles are connected.

        If a process has failed, `failure` tells by which error.
        """
        for process in self.processes:
            assert process.stdin is not None
            with suppress(BrokenPipeError):  # its exit status will tell
                process.stdin.write(os.fsencode(path.absolute()))
                process.stdin.close()
        output = b"".join(process.stdout.read() for process in self.processes if process.stdout is not None)
        said = output.decode(errors="replace").splitlines()
        self.notes = [line for line in said if line.startswith(NOTE)]
        statuses = [process.wait() for process in self.processes]
        if any(status not in (0, UNFINISHED) for status in statuses):
            errors = [line for line in said if not line.startswith(NOTE)]
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
    """Start the processes, and make sure that they end with the block."""
    started = Compilers()
    try:
        yield started
    finally:
        started.end()


def shares() -> tuple[str, ...]:
    """What the processes that are to be started compile, each."""
    if (os.cpu_count() or 1) == 1:
        return ("all",)
    return ("both",) if CAN_FORK else ("the_longest", "all_but_the_longest")
