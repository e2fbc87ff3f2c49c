"""How long a cold build and a warm process take, and how many steps of a simulation are made in a second.

`python tests/benchmarks/start_and_stepping.py`; wall-clock seconds, best and median of several runs, one BLAS thread.
"""

import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from time import perf_counter

from rich.console import Console
from rich.table import Table

from codegen.solving.compiler import build
from codegen.solving.loading import load

ROOT = Path(__file__).parents[2]
WARM = "from generated import orbital_transfer; orbital_transfer.solve(steps=300)"
FLOOR = "from numba import njit\n@njit\ndef f(x): return x\nimport numpy"


def seconds(command: list[str], runs: int, cold: bool = False) -> list[float]:
    """Wall-clock seconds of whole processes, each with an empty build cache when `cold`."""
    found = []
    for _ in range(runs):
        with tempfile.TemporaryDirectory() as folder:
            environment = dict(os.environ, OMP_NUM_THREADS="1")
            if cold:
                environment["CODEGEN_CACHE_DIR"] = folder
            arguments = [word.replace("OUT", f"{folder}/out") for word in command]
            begin = perf_counter()
            subprocess.run(arguments, check=True, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL)
            found.append(perf_counter() - begin)
    return found


def stepping() -> list[tuple[str, float]]:
    """Steps per second of the pendulum, a million steps, of which every thousandth is stored."""
    rows = []
    for scheme in ("explicit-euler", "symplectic-euler", "stormer-verlet", "midpoint"):
        module = load(build(ROOT / "problems" / "pendulum.py", scheme=scheme).path)
        module.solve(1000)
        times = []
        for _ in range(9):
            begin = perf_counter()
            solution = module.solve(1_000_000, duration=1e5, every=1000)
            times.append(perf_counter() - begin)
        assert solution.status == "solved"
        rows.append((scheme, 1e6 / min(times)))
    return rows


def main() -> None:
    """Measure and print two tables."""
    subprocess.run([sys.executable, "-c", WARM], check=True, cwd=ROOT)
    table = Table("process", "best s", "median s")
    cases = [(f"cold build of {name}", ["codegen", "build", f"problems/{name}.py", "--out", "OUT"], 3, True)
             for name in ("orbital_transfer", "linear_pendulum", "pendulum")]  # fmt: skip
    cases += [("warm import and solve, N = 300", [sys.executable, "-c", WARM], 7, False)]
    cases += [("import numba alone", [sys.executable, "-c", FLOOR], 7, False)]
    for name, command, runs, cold in cases:
        times = seconds(command, runs, cold)
        table.add_row(name, f"{min(times):.2f}", f"{statistics.median(times):.2f}")
    Console().print(table)
    speeds = Table("pendulum", "steps/s")
    for scheme, speed in stepping():
        speeds.add_row(scheme, f"{speed:.2e}")
    Console().print(speeds)


if __name__ == "__main__":
    main()
