"""Many solves at once on a GPU: correctness against the processor, cases per second, memory and compilation.

    python tests/benchmarks/cuda.py [--scale S] [--sample N] [--seconds S]

It needs a GPU by NVIDIA, its driver, and `pip install -e ".[cuda]"`. The problems are the orbital transfer (N = 100),
the cart-pole (N = 50, with bounds) and the planar quadrotor (N = 50), with random parameters, for numbers of cases that
grow by factors of ten up to a million, a hundred thousand and a hundred thousand times `--scale`. The first call
compiles the kernel; it is timed by itself. `kernel` is the time of the search on the device, without Python and
transfers. `on device` is the part of the cases that the device solved, and `largest difference` that of the costs,
relative, in a sample that the processor solves as well.

Ensembles of motions follow: Kepler's problem, Henon and Heiles's, and a chain of ten masses, a million times `--scale`
each, with 1000 steps by midpoint and by Stormer and Verlet. The last states are stored and compared; `kept` is the time
if they stay on the device.

With the environment variable NUMBA_ENABLE_CUDASIM=1 the script runs in numba's simulator, with `--scale 1e-5`. No
problem begins after `--seconds`.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from functools import partial
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import sympy
from numba import cuda
from rich.console import Console
from rich.table import Table

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))

import codegen  # noqa: E402
from codegen.runtime.cuda import batches as optima  # noqa: E402
from codegen.runtime.cuda import memory  # noqa: E402

PROBLEMS = {
    "orbital_transfer": (100, 1_000_000, {"r1": (5.5, 6.5), "m": (90.0, 110.0)}),
    "cart_pole": (50, 100_000, {"rod": (0.45, 0.55), "m1": (0.9, 1.1)}),
    "quadrotor": (50, 100_000, {"m": (0.9, 1.1)}),
}
"""Intervals, largest number of cases, and ranges of parameters."""
MOTIONS = 1_000_000
"""Largest number of motions, times `--scale`."""
LEAST = 1000
"""Smallest number of cases, if the largest is larger."""
COLUMNS = (
    "problem", "N", "cases", "seconds", "us a case", "kernel us", "GB", "on device", "solved", "us by 1 core",
    "us by all cores", "largest difference",
)  # fmt: skip


def kepler() -> codegen.Simulate:
    """A planet at its perihelion; the masses differ."""
    (x, y), (vx, vy) = codegen.coordinates("x y")
    m = codegen.parameters(m=1)[0]
    potential = -1 / sympy.sqrt(x**2 + y**2)
    return codegen.Simulate(
        lagrangian=m * (vx**2 + vy**2) / 2 - m * potential,
        duration=20, start={x: 0.5, y: 0, vx: 0, vy: sympy.sqrt(3)}, steps=1000,
    )  # fmt: skip


def henon_heiles() -> codegen.Simulate:
    """A star in a galaxy, Henon and Heiles (1964)."""
    (x, y), (vx, vy) = codegen.coordinates("x y")
    m = codegen.parameters(m=1)[0]
    potential = (x**2 + y**2) / 2 + x**2 * y - y**3 / 3
    return codegen.Simulate(
        lagrangian=m * (vx**2 + vy**2) / 2 - potential, duration=100, start={x: 0, y: 0.1, vx: 0.4, vy: 0}, steps=1000
    )


def chain() -> codegen.Simulate:
    """Ten masses between springs with a cubic force, Fermi, Pasta, Ulam and Tsingou (1955)."""
    q, v = codegen.coordinates("q1:11")
    m = codegen.parameters(m=1)[0]
    stretches = [b - a for a, b in pairwise((0, *q, 0))]
    potential = sum(s**2 / 2 + s**4 / 4 for s in stretches)
    start = {x: sympy.sin(sympy.pi * i / 11).evalf() for i, x in enumerate(q, 1)}
    return codegen.Simulate(
        lagrangian=m * sum(rate**2 for rate in v) / 2 - potential, duration=100,
        start=start | dict.fromkeys(v, 0), steps=1000,
    )  # fmt: skip


class Measured:
    """Seconds, memory and numbers of cases of all calls of `optima.solve_cases` since the last reset."""

    def __init__(self) -> None:
        self.reset()
        self._solve_cases = optima.solve_cases
        optima.solve_cases = self

    def reset(self) -> None:
        """Begin again."""
        self.seconds, self.cases, self.on_device, self.bytes = 0.0, 0, 0, 0

    def __call__(self, *arguments: Any) -> None:
        """Solve cases, and note time and memory."""
        grid, _, numbers, *_, space, found, _, _ = arguments
        of_thread, of_case = optima.bytes_of(space, numbers, found, grid.problem.shooting is None)
        threads, cases = optima.shares(of_thread, of_case, numbers.h.size, memory.free_memory())
        begin = perf_counter()
        self._solve_cases(*arguments)
        self.seconds += perf_counter() - begin
        is_found = found.is_found
        self.cases, self.on_device = self.cases + is_found.size, self.on_device + int(is_found.sum())
        self.bytes = max(self.bytes, threads * of_thread + min(cases, numbers.h.size) * of_case)


def per_case(solver: Any, steps: int, parameters: dict[str, Any], threads: int) -> tuple[float, Any]:
    """The seconds of a case by threads of the processor, and the Solutions."""
    begin = perf_counter()
    found = codegen.solve_many(solver, parameters, steps=steps, threads=threads)
    return (perf_counter() - begin) / len(found), found


def main() -> None:
    """Measure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scale", type=float, default=1.0)
    parser.add_argument("--sample", type=int, default=2000)
    parser.add_argument("--seconds", type=float, default=480.0)
    options = parser.parse_args()
    begin, rng, measured, console = perf_counter(), np.random.default_rng(1), Measured(), Console(width=150)
    memory.require_device()
    name = cuda.get_current_device().name
    console.print(name.decode() if isinstance(name, bytes) else str(name))
    cores, table = len(os.sched_getaffinity(0)), Table(*COLUMNS)
    for name, (steps, most, ranges) in PROBLEMS.items():
        if perf_counter() - begin > options.seconds:
            console.print(f"{name}: not measured, {options.seconds:.0f} s are over")
            continue
        largest = max(4, int(options.scale * most))
        parameters = {key: rng.uniform(*limits, largest) for key, limits in ranges.items()}
        solver = codegen.compile(ROOT / "problems" / f"{name}.py")
        few = {key: values[:64] for key, values in parameters.items()}
        codegen.solve_many(solver, few, steps=steps)
        first = perf_counter()
        codegen.solve_many(solver, few, steps=steps, executor="cuda")
        console.print(f"{name}: compilation and 64 cases {perf_counter() - first:.1f} s")
        sample = {key: values[: options.sample] for key, values in parameters.items()}
        alone, expected = per_case(solver, steps, sample, 1)
        by_all, _ = per_case(solver, steps, sample, cores)
        number = min(LEAST, largest)
        while number <= largest:
            cases = {key: values[:number] for key, values in parameters.items()}
            measured.reset()
            start = perf_counter()
            found = codegen.solve_many(solver, cases, steps=steps, executor="cuda")
            seconds, both = perf_counter() - start, min(number, len(expected))
            difference = np.abs(found.cost[:both] / expected.cost[:both] - 1.0).max()
            table.add_row(
                name, str(steps), str(number), f"{seconds:.2f}", f"{1e6 * seconds / number:.2f}",
                f"{1e6 * measured.seconds / number:.2f}", f"{measured.bytes / 1e9:.2f}",
                f"{measured.on_device / max(1, measured.cases):.2%}", f"{found.solved.mean():.2%}",
                f"{1e6 * alone:.0f}", f"{1e6 * by_all:.0f}", f"{difference:.1e}",
            )  # fmt: skip
            number = largest if number < largest < 10 * number else 10 * number
    console.print(table)
    followed(options.scale, options.sample, rng, console)


def followed(scale: float, sample: int, rng: np.random.Generator, console: Console) -> None:
    """Measure and print the table of motions."""
    table = Table(
        "motions", "scheme", "cases", "compilation s", "seconds", "ns a step", "kept: ns", "by 1 core", "difference"
    )
    number = max(4, int(scale * MOTIONS))
    for make in (kepler, henon_heiles, chain):
        for scheme in ("midpoint", "stormer-verlet"):
            solver = codegen.compile(make(), scheme=scheme)
            masses = rng.uniform(0.9, 1.1, number)
            call = partial(codegen.solve_many, solver, every=1000)
            first = perf_counter()
            call({"m": masses[:64]}, executor="cuda")
            start = perf_counter()
            found = call({"m": masses}, executor="cuda")
            seconds = perf_counter() - start
            start = perf_counter()
            kept = call({"m": masses}, executor="cuda", on_device=True)
            kept_seconds = perf_counter() - start
            if not np.array_equal(kept.fetched().path, found.path):
                console.print(f"{make.__name__}: states that stay on the device differ")
            del kept
            few = {"m": masses[:sample]}
            call({"m": masses[:4]}, threads=1)
            begin = perf_counter()
            expected = call(few, threads=1)
            alone = (perf_counter() - begin) / len(expected)
            difference = np.abs(found.path[: len(expected)] - expected.path).max()
            table.add_row(
                make.__name__, scheme, str(number), f"{start - first:.1f}", f"{seconds:.2f}",
                f"{1e6 * seconds / number:.3g}", f"{1e6 * kept_seconds / number:.3g}", f"{1e6 * alone:.3g}",
                f"{difference:.1e}",
            )  # fmt: skip
    console.print(table)


if __name__ == "__main__":
    main()
