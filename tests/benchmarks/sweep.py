"""What a sweep costs beside its solves: the orbital transfer for 10 000 values of its parameters, by several processes.

    python tests/benchmarks/sweep.py [--cases N] [--workers N] [-- OPTION ...]

Prints the seconds of the command, those of the sweep in it, the sum of the seconds of all solves (of the driver alone,
without the residuals that are evaluated again), the time of all workers in parts of that sum, and the most memory that
a process took. Options behind -- are those of codegen sweep.
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

import xarray

PROBLEM = Path(__file__).parents[2] / "problems" / "orbital_transfer.py"


def main() -> int:
    """Print what was measured; return the exit status of the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=10_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("options", nargs="*")
    asked = parser.parse_args()
    rows = max(1, asked.cases // 100)
    with tempfile.TemporaryDirectory() as folder:
        store = Path(folder) / "sweep.zarr"
        words = ["--vary", f"r1=5.5:6.5:{rows}", "--vary", "m=90:110:100", "--steps", "100", "--json"]
        command = [sys.executable, "-m", "codegen", "sweep", str(PROBLEM), *words, "--out", str(store)]
        subprocess.run([sys.executable, "-m", "codegen", "solve", str(PROBLEM)], capture_output=True)  # compiled once
        begin = time.perf_counter()
        done = subprocess.run(
            [*command, "--workers", str(asked.workers), *asked.options], stdout=subprocess.PIPE, text=True
        )
        whole = time.perf_counter() - begin
        if done.returncode:
            return done.returncode
        sweep = json.loads(done.stdout)["seconds"]
        solves = float(xarray.open_zarr(store, chunks=None).seconds.sum())
    print(f"{100 * rows} cases, {asked.workers} workers")
    print(f"command {whole:.2f} s, sweep {sweep:.2f} s, solves {solves:.2f} s")
    print(f"workers' time in parts of the solves: {asked.workers * sweep / solves:.2f}")
    print(f"most memory of a process: {resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024:.0f} MB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
