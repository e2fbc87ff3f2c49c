"""Random kills of a cluster of dask during a sweep: whether every case is there, exactly once.

    python tests/benchmarks/sweep_kills.py [--cases N] [--workers N] [--schedulers N] [--clients N] [--seed N]

Begins a scheduler and two workers by hand, and the orbital transfer over N cases (60 000, of N = 100). Each time that
some more chunks are finished a part is killed (SIGKILL), chosen at random from 50 workers, 5 schedulers and 5 clients
unless said, and begun again; a client that has ended, with --resume. Then compares the store with that of one process
and prints what happened. The status is 1 if a chunk is missing or twice, or a number is another one.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
import xarray

PROBLEM = Path(__file__).parents[2] / "problems" / "orbital_transfer.py"
SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
WORKERS = 2


class Parts:
    """The scheduler, the workers and the client, each a process that is begun again when it has ended."""

    def __init__(self, folder: Path, words: list[str]) -> None:
        self.file, self.words, self.client_ends = folder / "scheduler.json", words, Counter()
        self.scheduler = self.client = None
        self.workers = [None] * WORKERS

    def look_after(self) -> bool:
        """Begin what has ended; whether the client has done all of its work."""
        if self.scheduler is None or self.scheduler.poll() is not None:
            self.file.unlink(missing_ok=True)
            self.scheduler = dask("scheduler", self.file)
            while not (self.file.exists() and self.file.read_text().rstrip().endswith("}")):
                time.sleep(0.05)
        for k, worker in enumerate(self.workers):
            if worker is None or worker.poll() is not None:
                self.workers[k] = dask("worker", self.file, "--nthreads", "1", "--no-nanny", "--memory-limit", "0")
        if self.client is not None and self.client.poll() is not None:
            self.client_ends[self.client.returncode] += 1
            if self.client.returncode == 0:
                return True
        if self.client is None or self.client.poll() is not None:
            address = json.loads(self.file.read_text())["address"]
            self.client = subprocess.Popen([*self.words, "--resume", "--cluster", address], **SILENT)
        return False

    def kill(self, kind: str) -> None:
        """Kill a part without notice."""
        part = random.choice(self.workers) if kind == "worker" else getattr(self, kind)
        part.send_signal(signal.SIGKILL)
        part.wait()

    def end(self) -> None:
        """Kill all parts."""
        for part in (self.client, *self.workers, self.scheduler):
            if part is not None:
                part.kill()
                part.wait()


def dask(kind: str, file: Path, *words: str) -> subprocess.Popen:
    """A scheduler or a worker."""
    port = ("--port", "0") if kind == "scheduler" else ()
    command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *port, "--no-dashboard", *words]
    return subprocess.Popen([*command, "--scheduler-file", str(file)], **SILENT)


def finished(journal: Path) -> int:
    """How many chunks are noted."""
    return journal.read_text().count("\n") - 1 if journal.exists() else 0


def swept(folder: Path, words: list[str], kills: list[str]) -> tuple[list[str], Counter, float]:
    """Sweep among kills; which were done before the end, how the clients ended, and the seconds."""
    parts, done, begin = Parts(folder, words), [], time.perf_counter()
    journal, wanted = folder / "kills.zarr.journal", 0
    try:
        while not parts.look_after():
            if len(done) < len(kills) and finished(journal) >= wanted:
                time.sleep(random.uniform(0.0, 0.3))
                parts.kill(kills[len(done)])
                done.append(kills[len(done)])
                wanted = finished(journal) + random.randint(1, 5)
            time.sleep(0.02)
    finally:
        parts.end()
    return done, parts.client_ends, time.perf_counter() - begin


def differing(folder: Path) -> list[str]:
    """The variables in which the store differs from that of one process, all but the seconds."""
    one, other = (xarray.open_zarr(folder / f"{name}.zarr", chunks=None) for name in ("kills", "whole"))
    names = [str(name) for name in other.variables if name != "seconds"]
    return [name for name in names if not same(one[name].values, other[name].values)]


def same(one: np.ndarray, other: np.ndarray) -> bool:
    """To the last bit."""
    return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def main() -> int:
    """Print what was killed and what is left; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, number in (("cases", 60_000), ("workers", 50), ("schedulers", 5), ("clients", 5), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=number)
    asked = parser.parse_args()
    random.seed(asked.seed)
    kills = ["worker"] * asked.workers + ["scheduler"] * asked.schedulers + ["client"] * asked.clients
    random.shuffle(kills)
    rows = max(1, asked.cases // 100)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        words = [sys.executable, "-m", "codegen", "sweep", str(PROBLEM), "--vary", f"r1=5.5:6.5:{rows}"]
        words += ["--vary", "m=90:110:100", "--steps", "100", "--chunk", "100", "--out"]
        done, ends, seconds = swept(folder, [*words, str(folder / "kills.zarr")], kills)
        subprocess.run([*words, str(folder / "whole.zarr"), "--workers", "1"], check=True, **SILENT)
        _, *lines = map(json.loads, (folder / "kills.zarr.journal").read_text().splitlines())
        chunks = Counter(line["chunk"] for line in lines)
        others = differing(folder)
    is_whole = sorted(chunks) == list(range(rows)) and set(chunks.values()) == {1}
    print(f"{100 * rows} cases in {rows} chunks, {seconds:.0f} s; killed: {dict(Counter(done))} of {len(kills)} wanted")
    print(f"clients ended with (-9 killed, 2 scheduler lost, 0 done): {dict(ends)}")
    print(f"every chunk in the journal exactly once: {is_whole}")
    print(f"variables that differ from one process, seconds aside: {', '.join(others) or 'none'}")
    return 0 if is_whole and not others else 1


if __name__ == "__main__":
    sys.exit(main())
