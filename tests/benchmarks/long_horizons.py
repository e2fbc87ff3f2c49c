"""Time and memory of an interval from 300 to a million intervals, each solve in a process of its own.

    python tests/benchmarks/long_horizons.py [--steps N ...] [CASE ...]

The transfer between orbits by the variational midpoint rule, and the van der Pol oscillator with its bounds by the
midpoint rule and by rk4. A process solves on 300 intervals first, so that code is loaded, then on N intervals twice.
`ns` is the least processor time of a solve for each interval and iteration, `ratio` is this time over that of the
first N. `bytes` is the growth of the peak memory of the process for each interval. The other columns are bytes of an
interval in the arrays of a search that are known from its structure: second derivatives, factors of the linear system,
and the 13 vectors of the search, with 10 more numbers for each bound.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import json
import resource
import subprocess
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from time import process_time

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
from compiled_modules import compiled
from rich.console import Console
from rich.table import Table

from codegen.runtime.kkt.system import factor_sizes
from codegen.runtime.search import workspace
from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.shooting import shooting_grid
from codegen.solving.compiler import build

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
CASES = {
    "orbital_transfer": ("orbital_transfer", "midpoint"),
    "van_der_pol": ("van_der_pol", "midpoint"),
    "van_der_pol_rk4": ("van_der_pol", "rk4"),
}
STEPS, FIRST, NUMBER = (300, 10_000, 100_000, 1_000_000), 300, 8


@dataclass(frozen=True)
class Measurement:
    """What one process measured: seconds of a solve, bytes of all arrays that grew, and bytes of an interval."""

    case: str
    steps: int
    status: str
    iterations: int
    seconds: float
    bytes: int
    derivatives: float
    factors: float
    vectors: float


def peak() -> int:
    """The largest memory of this process so far, in bytes."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def measured(case: str, steps: int) -> Measurement:
    """Solve in this process."""
    problem, scheme = CASES[case]
    module = compiled(build(PROBLEMS / f"{problem}.py", scheme=scheme).path)
    module.solve(FIRST)
    before, seconds = peak(), []
    for _ in range(20 if steps <= FIRST else 2):
        begin = process_time()
        solution = module.solve(steps)
        seconds.append(process_time() - begin)
    grid = module.make_grid(steps)
    if grid.problem.shooting is not None:
        grid = shooting_grid(grid)
    s = grid.problem.structure
    inverses = [1, 1] if s.constant else [steps, steps + 1]
    few, many = (
        factor_sizes(s.shape, s.staged.size, s.bodies, n, count)
        for n, count in zip((steps, steps + 1), inverses, strict=True)
    )
    finite = sum(int(np.isfinite(limits).sum()) for limits in bounds_of(grid)) / steps
    return Measurement(
        case,
        steps,
        solution.status,
        solution.iterations,
        min(seconds),
        peak() - before,
        NUMBER * (s.entry_count(steps + 1) - s.entry_count(steps)),
        NUMBER * (sum(many) - sum(few)),
        NUMBER * (workspace.VECTORS * s.stride * s.bodies + workspace.BARRIERS * finite),
    )


def in_process(case: str, steps: int) -> Measurement:
    """Solve in a new process."""
    command = [sys.executable, __file__, "--steps", str(steps), "--here", case]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return Measurement(**json.loads(output.splitlines()[-1]))


def main() -> None:
    """Measure the cases and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=f"some of {', '.join(CASES)}; all by default")
    parser.add_argument("--steps", nargs="+", type=int, default=STEPS, help="numbers of intervals")
    parser.add_argument("--here", action="store_true", help="solve in this process and print the numbers as JSON")
    options = parser.parse_args()
    if options.here:
        print(json.dumps(asdict(measured(options.cases[0], options.steps[0]))))
        return
    chart = Table(title="Long horizons", title_justify="left")
    for column in (
        "case",
        "N",
        "status",
        "iterations",
        "s",
        "ns",
        "ratio",
        "bytes",
        "derivatives",
        "factors",
        "vectors",
    ):
        chart.add_column(column, justify="left" if column in ("case", "status") else "right")
    for case in options.cases or CASES:
        first = 0.0
        for steps in options.steps:
            row = in_process(case, steps)
            time = 1e9 * row.seconds / steps / row.iterations
            first = first or time
            growth = f"{row.bytes / steps:.0f}" if steps >= 10 * FIRST else ""  # pages of small arrays are reused
            chart.add_row(
                *(case, str(steps), row.status, str(row.iterations), f"{row.seconds:.3g}"),
                *(f"{time:.0f}", f"{time / first:.2f}", growth),
                *(f"{number:.0f}" for number in (row.derivatives, row.factors, row.vectors)),
            )
        chart.add_section()
    Console(width=130).print(chart)


if __name__ == "__main__":
    main()
