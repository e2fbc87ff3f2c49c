"""The parts of a cluster of dask as processes that are begun by hand, and killed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def process(*words: str, **environment: str) -> Iterator[subprocess.Popen[str]]:
    """A part of a cluster that is begun by hand, and killed at the end if it still runs."""
    command = [sys.executable, "-m", "distributed.cli.dask_" + words[0], *words[1:]]
    made = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, text=True,
        env={**os.environ, "OMP_NUM_THREADS": "1", **environment}, start_new_session=True,
    )  # fmt: skip
    try:
        yield made
    finally:
        kill(made)


def kill(process: subprocess.Popen[str]) -> None:
    """End a process and all that it has begun."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@contextmanager
def cluster(**environment: str) -> Iterator[tuple[str, subprocess.Popen[str], list[subprocess.Popen[str]]]]:
    """The address, the scheduler and two workers."""
    file = Path("scheduler.json").absolute()
    file.unlink(missing_ok=True)
    one = ("--nthreads", "1", "--no-dashboard", "--memory-limit", "0", "--scheduler-file", str(file))
    with (
        process("scheduler", "--port", "0", "--no-dashboard", "--scheduler-file", str(file)) as scheduler,
        process("worker", *one, **environment) as first,
        process("worker", *one, **environment) as second,
    ):
        yield address_in(file), scheduler, [first, second]


def address_in(file: Path) -> str:
    """What a scheduler writes when it is there."""
    until(lambda: file.exists() and file.read_text().rstrip().endswith("}"))
    return json.loads(file.read_text())["address"]


def until(condition: Callable[[], bool], seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it takes too long"
        time.sleep(0.01)
