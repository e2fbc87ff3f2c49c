"""What a sweep costs beside its solves: the orbital transfer for many radii and masses, by several processes.

    python tests/benchmarks/sweep.py [--cases N] [--workers N] [--peer N] [-- OPTION ...]

Prints the seconds of the command and the most memory that a process took; then processor time, which other programs on
the machine change little: that of the command with all its processes, less that of a command for two cases, and that of
the solves alone (of the driver, without the residuals that are evaluated again); what is more than these is the
overhead. With `--peer` so many of the cases are solved by joblib over CasADi and IPOPT as well, and the largest
difference of the costs is printed. Options behind -- are those of codegen sweep.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import xarray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

ROOT = Path(__file__).resolve().parents[2]
PROBLEM = ROOT / "problems" / "orbital_transfer.py"
STEPS = 100
TIMED = """
import time
from types import SimpleNamespace
from codegen.batch import case
case.time = SimpleNamespace(perf_counter=time.process_time)  # what a solve is said to take is processor time
from codegen.__main__ import run
run()
"""


def processor_time() -> float:
    """That of all processes that have ended, and of those they waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def swept(rows: int, columns: int, store: Path, workers: int, options: list[str]) -> tuple[float, float]:
    """Seconds and processor time of a command; SystemExit with its status where it failed."""
    words = ["--vary", f"r1=5.5:6.5:{rows}", "--vary", f"m=90:110:{columns}", "--steps", str(STEPS), "--json"]
    command = [sys.executable, "-c", TIMED, "sweep", str(PROBLEM), *words, "--out", str(store)]
    before, begin = processor_time(), time.perf_counter()
    done = subprocess.run([*command, "--workers", str(workers), *options], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    if done.returncode:
        raise SystemExit(done.returncode)
    json.loads(done.stdout)
    return time.perf_counter() - begin, processor_time() - before


def compared(data: Any, number: int, workers: int) -> None:
    """Solve some of the cases by joblib over CasADi and IPOPT, and print what that takes."""
    from peers.casadi_sweep import swept as swept_by_peer

    table = np.stack(np.meshgrid(data.r1, data.m, indexing="ij"), axis=-1).reshape(-1, 2)
    chosen = np.linspace(0, len(table) - 1, number).astype(int)
    costs, seconds, processor = swept_by_peer(table[chosen], STEPS, workers)
    difference = np.abs(costs / data.cost.values.ravel()[chosen] - 1.0).max()
    print(f"joblib, CasADi and IPOPT, {number} cases: {1e3 * processor:.2f} ms of processor time a case,")
    print(f"  {1e3 * seconds:.2f} ms pass with {workers} workers; costs differ by {difference:.1e}")


def main() -> int:
    """Print what was measured."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--peer", type=int, default=0)
    parser.add_argument("options", nargs="*")
    asked = parser.parse_args()
    rows = max(1, asked.cases // 100)
    cases = 100 * rows
    with tempfile.TemporaryDirectory() as folder:
        swept(2, 1, Path(folder) / "compiled.zarr", 1, [])
        _, start = swept(2, 1, Path(folder) / "start.zarr", 1, [])
        seconds, processor = swept(rows, 100, Path(folder) / "sweep.zarr", asked.workers, asked.options)
        data = xarray.open_zarr(Path(folder) / "sweep.zarr", chunks=None).load()
        memory = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        solves, own = float(data.seconds.sum()), processor - start
        print(f"{cases} cases, {asked.workers} workers, {int((data.status == 'solved').sum())} solved: {seconds:.1f} s")
        print(f"processor time: start {start:.1f} s, rest {own:.1f} s, of these solves {solves:.1f} s")
        print(f"a case: {1e3 * own / cases:.3f} ms, of these its solve {1e3 * solves / cases:.3f} ms")
        print(f"overhead in parts of the solves: {own / solves - 1.0:.2f}")
        print(f"most memory of a process: {memory:.0f} MB")
        if asked.peer:
            compared(data, min(asked.peer, cases), asked.workers)
    return 0


if __name__ == "__main__":
    sys.exit(main())
