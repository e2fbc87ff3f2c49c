"""Many solves at once: `codegen.solve_many` on threads, beside single solves and CasADi with IPOPT in processes.

    python tests/benchmarks/many.py [--cases N] [--threads N ...] [--peer N] [--processor-time]

For the orbital transfer (N = 100) with random radii and masses, and the cart-pole (N = 50, bounds) with random rods and
carts. Single solves run one after the other in one thread, in turns with the batches; a sample of cases stands for all.
`ratio` is the time of a case in the batch over the time of a single solve divided by the number of threads. With
`--peer` joblib solves so many of the transfers by CasADi with IPOPT, in as many processes as there are threads. On a
machine with other work, `--processor-time` measures the time of processors in place of the clock: all threads together,
so that `ratio` is that over the time of a single solve.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import codegen  # noqa: E402

SAMPLE, ROUNDS = 400, 3
"""Single solves in a row; rounds, of which the fastest counts."""


def problems(cases: int) -> list[tuple[str, int, dict[str, Any]]]:
    """Names, numbers of intervals and parameters of the problems; a fifth as many cart-poles as transfers."""
    rng, fewer = np.random.default_rng(1), max(1, cases // 5)
    transfers = {"r1": rng.uniform(5.5, 6.5, cases), "m": rng.uniform(90.0, 110.0, cases)}
    carts = {"rod": rng.uniform(0.45, 0.55, fewer), "m1": rng.uniform(0.9, 1.1, fewer)}
    return [("orbital_transfer", 100, transfers), ("cart_pole", 50, carts)]


def seconds_alone(solver: Any, steps: int, parameters: dict[str, Any], clock: Callable[[], float]) -> float:
    """The seconds of one solve of the module, in a row of SAMPLE."""
    rows = [dict(zip(parameters, row, strict=True)) for row in zip(*parameters.values(), strict=True)][:SAMPLE]
    begin = clock()
    for row in rows:
        solver.module.solve(steps, **row)
    return (clock() - begin) / len(rows)


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=100_000)
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--peer", type=int, default=0)
    parser.add_argument("--processor-time", action="store_true")
    options = parser.parse_args()
    clock = process_time if options.processor_time else perf_counter
    share = {threads: 1 if options.processor_time else threads for threads in options.threads}
    table = Table("problem", "cases", "solver", "threads", "us a case", "cases/s", "ratio", "solved", "same optimum")
    for name, steps, parameters in problems(options.cases):
        solver = codegen.compile(ROOT / "problems" / f"{name}.py")
        codegen.solve_many(solver, {key: values[:50] for key, values in parameters.items()}, steps=steps)
        number = len(next(iter(parameters.values())))
        best: dict[int, tuple[float, Any]] = {}
        alone = np.inf
        for _ in range(ROUNDS):
            alone = min(alone, seconds_alone(solver, steps, parameters, clock))
            for threads in options.threads:
                begin = clock()
                found = codegen.solve_many(solver, parameters, steps=steps, threads=threads)
                seconds = (clock() - begin) / number
                if threads not in best or seconds < best[threads][0]:
                    best[threads] = seconds, found
        table.add_row(name, str(number), "single solves", "1", f"{1e6 * alone:.0f}", f"{1 / alone:.0f}", "1", "", "")
        for threads, (seconds, found) in best.items():
            table.add_row(
                name, str(number), "solve_many", str(threads), f"{1e6 * seconds:.0f}", f"{1 / seconds:.0f}",
                f"{seconds / (alone / share[threads]):.2f}", f"{found.solved.mean():.3%}", "",
            )  # fmt: skip
        if options.peer and name == "orbital_transfer":
            from peers.casadi_sweep import swept

            cases, threads = np.column_stack([*parameters.values()])[: options.peer], max(options.threads)
            costs, passed, of_processors = swept(cases, steps, threads)
            seconds = of_processors if options.processor_time else passed
            same = np.abs(costs - found.cost[: options.peer]) <= 1e-6 * np.abs(costs)
            table.add_row(
                name, str(len(cases)), "joblib, CasADi + IPOPT", str(threads), f"{1e6 * seconds:.0f}",
                f"{1 / seconds:.0f}", f"{seconds / (alone / share[threads]):.2f}", "", f"{same.mean():.3%}",
            )  # fmt: skip
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
