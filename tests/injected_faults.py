"""What can happen to files and processes, done on purpose: for `test_faults.py` and `benchmarks/faults.py`.

A sandbox holds small problems of known optimum, a build cache of its own and a folder of modules. A fault damages it,
or makes its disk full or read-only, or kills a command. After a fault the next command must give the right answer or a
typed error, and the one after, with the cause gone, the right answer.
"""

from __future__ import annotations

import json
import math
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parents[1]
OSCILLATOR = '''"""An oscillator of unit frequency; the midpoint rule turns (q, p) by 2 atan(h/2) a step."""

from codegen import Simulate, canonical_pair


def problem() -> Simulate:
    q, p = canonical_pair("q", "p")
    return Simulate(hamiltonian=p**2 / 2 + q**2 / 2, start={q: 1, p: 0}, duration=10, steps=100)
'''
ANSWERS = {
    "oscillator": math.cos(200 * math.atan(0.05)),
    "double_integrator_effort": 12 * 50**2 / (50**2 - 1),
    "double_integrator": 2.0,
}
"""The final position, or the cost, on the grid that the problem states; in closed form."""


@dataclass
class Sandbox:
    """Problems, a build cache and modules in one folder; commands run in it."""

    folder: Path
    environment: dict[str, str] = field(default_factory=dict)
    seconds: dict[tuple[str, str], float] = field(default_factory=dict)
    """How long a command and a problem have taken without a fault."""

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        (self.folder / "oscillator.py").write_text(OSCILLATOR)
        for name in ("double_integrator_effort", "double_integrator"):
            shutil.copy(ROOT / "problems" / f"{name}.py", self.folder)
        own = {"CODEGEN_CACHE_DIR": str(self.folder / "cache"), "PYTHONPATH": str(ROOT)}
        self.environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", **own, **self.environment}

    def command(self, kind: str, name: str) -> list[str]:
        """The words of `build`, `solve` or a plain `import` of a problem's module."""
        if kind == "import":
            answer = "s.q[-1, 0]" if name == "oscillator" else "s.cost"
            return [sys.executable, "-c", f"import generated.{name} as m; s = m.solve(); print({answer})"]
        options = ["--json"] if kind == "solve" else []
        return [sys.executable, "-m", "codegen", kind, f"{name}.py", *options]

    def run(self, kind: str, name: str, before: Callable[[], None] | None = None) -> str:
        """Run a command: `right`, `typed error`, or what is wrong with what it did."""
        done = subprocess.run(
            self.command(kind, name), cwd=self.folder, env=self.environment, capture_output=True, text=True,
            timeout=600, preexec_fn=before,
        )  # fmt: skip
        if "Traceback" in done.stderr or "this is a defect" in done.stderr:
            return f"untyped error: {done.stderr.strip().splitlines()[-1]}"
        if done.returncode == 2 and done.stderr.count("codegen: error:") == 1:
            return "typed error"
        if done.returncode:
            return f"status {done.returncode}: {done.stderr.strip()[-300:]}"
        return "right" if kind == "build" else _judged(done.stdout, name)

    def timed(self, kind: str, name: str) -> str:
        """Run a command, and remember how long it takes."""
        begin = time.perf_counter()
        found = self.run(kind, name)
        self.seconds[kind, name] = time.perf_counter() - begin
        return found

    def killed(self, kind: str, name: str, delay: float, with_compilers: bool) -> None:
        """Kill a command after so many seconds, and perhaps the processes that it has started, all at once."""
        process = subprocess.Popen(
            self.command(kind, name), cwd=self.folder, env=self.environment,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        with suppress(subprocess.TimeoutExpired):
            process.wait(delay)
        others = _descendants(process.pid) if with_compilers else []
        for number in (process.pid, *others):
            with suppress(ProcessLookupError):
                os.kill(number, signal.SIGKILL)
        process.wait()

    def cached_texts(self) -> list[Path]:
        """The modules in the build cache."""
        return sorted((self.folder / "cache").glob("*/[!.]*.py"))

    def machine_code(self) -> list[Path]:
        """The files that numba keeps."""
        return sorted(self.folder.rglob("[!.]*.nb[ic]"))


def _judged(output: str, name: str) -> str:
    """Whether the number that a command printed is the answer."""
    try:
        number = float(output)
    except ValueError:
        record = json.loads(output)
        if record["status"] != "solved":
            return f"not solved: {record['message']}"
        number = record["summary"]["final_q"] if name == "oscillator" else record["cost"]
    answer = ANSWERS[name]
    return "right" if abs(number - answer) <= 1e-8 * max(1.0, abs(answer)) else f"wrong: {number}, not {answer}"


def _descendants(parent: int) -> list[int]:
    """Numbers of the processes that one has started, and of those that they have."""
    with suppress(OSError):
        words = Path(f"/proc/{parent}/task/{parent}/children").read_text().split()
        return [number for word in words for number in (int(word), *_descendants(int(word)))]
    return []


# Damage


def cut_off(path: Path, rng: random.Random) -> None:
    """Leave a part of a file, perhaps nothing."""
    os.truncate(path, rng.randrange(path.stat().st_size))


def empty(path: Path, rng: random.Random) -> None:
    """Leave nothing."""
    os.truncate(path, 0)


def alter(path: Path, rng: random.Random) -> None:
    """Change one byte."""
    data = bytearray(path.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def garble(path: Path, rng: random.Random) -> None:
    """Put zeros for the second half, as a disk may that lost its power."""
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2] + bytes(len(data) - len(data) // 2))


DAMAGE: tuple[Callable[[Path, random.Random], None], ...] = (cut_off, empty, alter, garble)


# Disks


def can_mount() -> bool:
    """Whether this process may mount file systems."""
    return hasattr(os, "geteuid") and os.geteuid() == 0 and shutil.which("mount") is not None


@contextmanager
def small_disk(folder: Path, megabytes: int = 64) -> Iterator[bool]:
    """A small disk of its own at a folder; False where it could not be mounted, and the folder is an ordinary one."""
    folder.mkdir(parents=True, exist_ok=True)
    words = ["mount", "-t", "tmpfs", "-o", f"size={megabytes}m", "tmpfs", str(folder)]
    mounted = can_mount() and subprocess.run(words, capture_output=True).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(folder)], check=True)


@contextmanager
def filled(folder: Path, left: int) -> Iterator[None]:
    """A disk with so many bytes left."""
    ballast = folder / ".ballast"
    free = os.statvfs(folder)
    try:
        with ballast.open("wb") as file:
            os.posix_fallocate(file.fileno(), 0, max(1, free.f_bavail * free.f_frsize - left))
        yield
    finally:
        ballast.unlink()


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A disk that may only be read."""
    subprocess.run(["mount", "-o", "remount,ro", str(folder)], check=True)
    try:
        yield
    finally:
        for _ in range(50):
            if subprocess.run(["mount", "-o", "remount,rw", str(folder)]).returncode == 0:
                break
            time.sleep(0.1)


def limited_files(size: int) -> Callable[[], None]:
    """What lets a command write no file beyond so many bytes."""
    import resource

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit
