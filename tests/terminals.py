"""Commands in a process of their own whose stderr, and input, is a terminal: where progress is shown."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

LONGEST = 300.0
"""Seconds that a command may take."""


@dataclass(frozen=True)
class Done:
    """How a command ended: its exit status, its stdout, and all that the terminal was sent."""

    status: int
    stdout: str
    screen: str


class Terminal:
    """A command that runs in a folder, with a cache of its own there unless it is given one; the block's end waits.

    Its stdout is a pipe, or the terminal as well where `everything` goes there. Unless it is `compiled`, numba leaves
    functions as they are, which takes seconds in place of half a minute, and what is shown does not depend on it.
    """

    def __init__(
        self, *words: object, folder: Path, cache: Path | None = None, compiled: bool = False, everything: bool = False,
        program: tuple[str, ...] = ("-m", "codegen"),
    ) -> None:  # fmt: skip
        where = str(cache or folder / "cache")
        environment = {**os.environ, "CODEGEN_CACHE_DIR": where, "TERM": "xterm", "COLUMNS": "120"}
        environment |= {"CODEGEN_STATE_DIR": str(folder / "state"), "NUMBA_DISABLE_JIT": "0" if compiled else "1"}
        self.terminal, inside = pty.openpty()
        self.process = subprocess.Popen(
            [sys.executable, *program, *map(str, words)],
            cwd=folder, env=environment, stdin=inside, stderr=inside, stdout=inside if everything else subprocess.PIPE,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # which processes in the background ignore
        )  # fmt: skip
        os.close(inside)
        self.sent, self.came = b"", threading.Condition()
        self.reader = threading.Thread(target=self._read, daemon=True)
        self.reader.start()

    def _read(self) -> None:
        """Take what is sent until no process holds the other side."""
        part = b"-"
        while part:
            try:
                part = os.read(self.terminal, 65536)
            except OSError:  # the end, on Linux
                part = b""
            with self.came:
                self.sent += part
                self.came.notify_all()

    def wait_for(self, text: str) -> None:
        """Wait until the terminal was sent a text."""
        with self.came:
            assert self.came.wait_for(lambda: text.encode() in self.sent, LONGEST), self.sent

    def __enter__(self) -> Terminal:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:
            self.process.kill()
        try:
            stdout, _ = self.process.communicate(timeout=LONGEST)
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        self.reader.join(LONGEST)
        os.close(self.terminal)
        screen = self.sent.decode(errors="replace")
        self.done = Done(self.process.returncode, (stdout or b"").decode(), screen)


def on_terminal(*words: object, **options: object) -> Done:
    """How a command ended, once it has."""
    with Terminal(*words, **options) as running:
        pass
    return running.done
