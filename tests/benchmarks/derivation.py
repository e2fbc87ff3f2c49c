"""How long the build and the check of large systems take, in seconds of processor time and by the clock.

    python tests/benchmarks/derivation.py [--limit S] [SYSTEM ...]

Each command runs in an empty build cache. Processor time counts all processes that a command starts, so that other work
on the machine hardly changes it. What does not end within the limit is ended. A build is to take 30 s, a check 120 s.
"""

import argparse
import os
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

FOLDER = Path(__file__).resolve().parents[1] / "large_systems"
SYSTEMS = {
    "figure eight": ("bodies.py",),
    "five bodies": ("bodies.py", "bodies=5"),
    "five bodies, control": ("bodies.py", "bodies=5", "task=control"),
    "chain of 12": ("chain.py",),
    "chain of 12, control": ("chain.py", "task=control"),
    "satellite": ("satellite.py",),
    "six-link arm": ("arm.py",),
    "six-link arm, falling": ("arm.py", "task=simulate"),
}


@dataclass(frozen=True)
class Run:
    """A command's exit status (None: it was ended), seconds of processors and of the clock, and its last line."""

    status: int | None
    processor: float
    clock: float
    said: str


def run(words: list[str], folder: Path, limit: float) -> Run:
    """Run a command of codegen with an empty cache in a folder."""
    environment = os.environ | {"CODEGEN_CACHE_DIR": str(folder / "cache")}
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "codegen", *words]
    status, said = None, "ended at the limit"
    try:
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=limit)
        status, said = done.returncode, (done.stderr.strip().splitlines() or [""])[-1]
        failed = [line for line in done.stdout.splitlines() if "FAILED" in line]
        said = failed[0] if failed else said
    except subprocess.TimeoutExpired:
        pass
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return Run(status, used, time.perf_counter() - begin, said)


def measured(name: str, limit: float) -> list[tuple[str, Run]]:
    """Derivation alone, the whole build, and the check of a system."""
    file, *settings = SYSTEMS[name]
    words = [str(FOLDER / file), *(word for setting in settings for word in ("--set", setting))]
    commands = {"derive": ["build", *words, "--no-compile"], "build": ["build", *words], "check": ["check", *words]}
    found = []
    for label, command in commands.items():
        with tempfile.TemporaryDirectory() as folder:
            found.append((label, run(command, Path(folder), limit)))
    return found


def main() -> None:
    """Run the systems and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("systems", nargs="*", help=f"some of {', '.join(SYSTEMS)}; all by default")
    parser.add_argument(
        "--limit", type=float, default=600.0, help="seconds by the clock after which a command is ended"
    )
    arguments = parser.parse_args()
    chart = Table(title="Derivation of large systems", title_justify="left")
    for column in ("system", "command", "processor s", "clock s", "exit"):
        chart.add_column(column, justify="left" if column in ("system", "command") else "right")
    chart.add_column("said")
    for name in arguments.systems or SYSTEMS:
        for label, found in measured(name, arguments.limit):
            exit_status = "-" if found.status is None else str(found.status)
            chart.add_row(name, label, f"{found.processor:.1f}", f"{found.clock:.1f}", exit_status, found.said[:80])
        chart.add_section()
    Console(width=150).print(chart)


if __name__ == "__main__":
    main()
