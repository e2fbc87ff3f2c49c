"""The share of Python in a solve: what the interpreter takes beside the compiled functions that it calls.

    python tests/benchmarks/python_share.py [--steps N] [--solves S] [PROBLEM ...]

Solves the control problems of the gallery on N intervals (20), from their own guesses, S times (100) as they are, and S
times with a clock around every call of a compiled function. A call counts as compiled from the handing over of its
arguments to its result, so that numba's taking them apart belongs to it. Medians, in microseconds; what the clock
itself takes is measured with a function that does nothing, and taken away.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

from control_speed import machine
from numba.core.registry import CPUDispatcher
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from compiled_modules import compiled

from codegen.solving.compiler import build

ROOT = Path(__file__).resolve().parents[2]


class Clock:
    """The seconds within compiled functions, and how often they were called."""

    def __init__(self) -> None:
        self.seconds, self.calls = 0.0, 0

    def around(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """The same function, whose calls are counted and timed."""

        def timed(*arguments: Any) -> Any:
            begin = perf_counter()
            result = function(*arguments)
            self.seconds += perf_counter() - begin
            self.calls += 1
            return result

        return timed


def row(path: Path, steps: int, solves: int) -> tuple[str, ...] | None:
    """What one problem takes on so many intervals; None where that is no optimisation, or is not solved."""
    module: Any = compiled(build(path).path)
    if module.metadata.task != "control":
        return None
    solution = module.solve(steps)
    if solution.status != "solved":
        return None
    whole = median(seconds(lambda: module.solve(steps)) for _ in range(solves))
    clock, inside, calls = Clock(), [], 0
    with timed_by(clock):
        module.solve(steps)
        for _ in range(solves):
            clock.seconds, clock.calls = 0.0, 0
            module.solve(steps)
            inside.append(clock.seconds)
            calls = clock.calls
    idle = Clock()
    nothing = idle.around(lambda: None)
    for _ in range(10_000):
        nothing()
    within = median(inside) - calls * idle.seconds / idle.calls
    figures = 1e6 * whole, 1e6 * within, 1e6 * (whole - within) / max(1, solution.iterations)
    return (
        path.stem, f"{solution.iterations}", f"{calls}", *(f"{figure:.1f}" for figure in figures),
        f"{100.0 * (1.0 - within / whole):.0f} %",
    )  # fmt: skip


@contextmanager
def timed_by(clock: Clock) -> Iterator[None]:
    """Time all calls of compiled functions of the runtime from Python."""
    runtime = [module for name, module in list(sys.modules.items()) if name.startswith("codegen.runtime.")]
    found = [
        (module, name, function)
        for module in runtime
        for name, function in list(vars(module).items())
        if isinstance(function, CPUDispatcher)
    ]
    for module, name, function in found:
        setattr(module, name, clock.around(function))
    try:
        yield
    finally:
        for module, name, function in found:
            setattr(module, name, function)


def seconds(call: Callable[[], Any]) -> float:
    """What a call takes."""
    begin = perf_counter()
    call()
    return perf_counter() - begin


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", metavar="PROBLEM")
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--solves", type=int, default=100)
    options = parser.parse_args()
    print(", ".join(f"{key} {value}" for key, value in machine().items()))
    table = Table(title=f"a solve on {options.steps} intervals, microseconds")
    for heading in ("problem", "iterations", "compiled calls", "solve", "compiled", "Python an iteration", "Python"):
        table.add_column(heading, justify="left" if heading == "problem" else "right")
    shares = []
    for path in sorted((ROOT / "problems").glob("*.py")):
        if not options.problems or path.stem in options.problems:
            found = row(path, options.steps, options.solves)
            if found is not None:
                table.add_row(*found)
                shares.append(int(found[-1].split()[0]))
    Console(width=120).print(table)
    print(f"the share of Python is {min(shares)} to {max(shares)} %, in the median {median(shares):.0f} %")


if __name__ == "__main__":
    main()
