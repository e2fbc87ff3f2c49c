"""Time the generated control solvers against CasADi with IPOPT, on the same programs, in the same run.

    python tests/benchmarks/control_speed.py [--quick] [--csv FILE] [--json FILE]

Every case runs ours, CasADi's virtual machine and CasADi's compiled C in turn, so that a slow spell of the machine
hits all three. A time is that of one warm call: from the straight-line guess to the solution, with everything built
and compiled before. `residual` is the largest of all equations, constraints and stationarity, unscaled. opty, if it is
installed, solves one case with its own collocation; its cost therefore differs (see `peers/opty_control.py`).

It times the committed modules in `generated/`.
"""

import os

# Before numpy and CasADi load their BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import importlib
import importlib.metadata
import importlib.util
import json
import platform
import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.progress import track
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))  # where the package `generated` is

from peers.casadi_control import PreparedControl

BLOCK = 10  # solves in a row before the next contestant has its turn
TOLERANCE = 1e-10
OPTY_CASE = ("orbital_transfer_2", 300)
CASES = [
    ("linear_pendulum", 200),
    ("orbital_transfer_1", 50),
    ("orbital_transfer_2", 300),
    ("orbital_transfer_2", 3000),
]
MODULES: dict[str, tuple[str, dict[str, float]]] = {
    "linear_pendulum": ("linear_pendulum", {}),
    "orbital_transfer_1": ("orbital_transfer", {"revolutions": 1.0}),
    "orbital_transfer_2": ("orbital_transfer", {"revolutions": 2.0}),
}


@dataclass(frozen=True)
class Row:
    """One solver on one case; times in seconds. `callbacks` is the share of a run spent evaluating functions."""

    problem: str
    steps: int
    solver: str
    cost: float
    residual: float
    iterations: int
    status: str
    best: float
    median: float
    build: float
    callbacks: float | None = None


@dataclass
class Contestant:
    """A solver made ready: `run` is the timed call, `report` tells of its last result."""

    name: str
    build: float
    run: Callable[[], object]
    report: Callable[[], dict[str, Any]]


def ours(problem: str, steps: int) -> Contestant | None:
    """The generated solver, or None if its module has not been built."""
    module_name, arguments = MODULES[problem]
    if importlib.util.find_spec(f"generated.{module_name}") is None:
        return None
    started = perf_counter()
    module = importlib.import_module(f"generated.{module_name}")
    last: list[Any] = [module.solve(steps=steps, tolerance=TOLERANCE, **arguments)]

    def run() -> None:
        last[0] = module.solve(steps=steps, tolerance=TOLERANCE, **arguments)

    def report() -> dict[str, Any]:
        return {name: getattr(last[0], name) for name in ("cost", "residual", "iterations", "status")}

    return Contestant("generated", perf_counter() - started, run, report)


def casadi(problem: str, steps: int, compiled: bool) -> Contestant:
    """IPOPT and MUMPS on functions from CasADi, after one run that is not measured."""
    prepared = PreparedControl(problem, steps, compiled, TOLERANCE)
    prepared.run()
    name = "CasADi, compiled C" if compiled else "CasADi, virtual machine"
    return Contestant(name, prepared.build_seconds, prepared.run, prepared.report)


def compare(problem: str, steps: int, rounds: int) -> list[Row]:
    """Run all contestants in turn, `rounds` times, and give one row for each.

    In its turn each solves BLOCK times in a row: what is compared are warm solves, of a program that others interrupt
    only now and then, and a drift of the machine's speed still meets all of them.
    """
    own = ours(problem, steps)
    peers = [casadi(problem, steps, compiled=False), casadi(problem, steps, compiled=True)]
    contestants = [own, *peers] if own else peers
    seconds: dict[str, list[float]] = {contestant.name: [] for contestant in contestants}
    for _ in range(rounds):
        for contestant in contestants:
            for _ in range(BLOCK):
                started = perf_counter()
                contestant.run()
                seconds[contestant.name].append(perf_counter() - started)
    return [row(problem, steps, contestant, seconds[contestant.name]) for contestant in contestants]


def row(problem: str, steps: int, contestant: Contestant, seconds: list[float]) -> Row:
    """The contestant's times and the figures of its last solution."""
    figures = contestant.report()
    return Row(
        problem=problem,
        steps=steps,
        solver=contestant.name,
        cost=float(figures["cost"]),
        residual=float(figures["residual"]),
        iterations=int(figures["iterations"]),
        status=str(figures["status"]),
        best=min(seconds),
        median=statistics.median(seconds),
        build=contestant.build,
        callbacks=figures.get("callback_seconds"),
    )


def opty_row(rounds: int) -> Row | None:
    """opty on one case, or None if opty is not installed."""
    if importlib.util.find_spec("opty") is None:
        return None
    opty_control = importlib.import_module("peers.opty_control")
    problem, steps = OPTY_CASE
    figures = opty_control.solve(problem, steps, rounds)
    names = ("cost", "residual", "iterations", "status")
    times = {"best": figures["seconds"], "median": figures["median_seconds"], "build": figures["build_seconds"]}
    return Row(problem, steps, "opty, midpoint", **{name: figures[name] for name in names}, **times)


def growth(rounds: int, sizes: tuple[int, ...] = (300, 3000, 30000)) -> list[Row]:
    """The generated solver alone, orbital transfer with 2 revolutions, as the number of steps grows."""
    rows = []
    for steps in sizes:
        own = ours("orbital_transfer_2", steps)
        if own is None:
            return []
        seconds = []
        for _ in range(rounds):
            started = perf_counter()
            own.run()
            seconds.append(perf_counter() - started)
        rows.append(row("orbital_transfer_2", steps, own, seconds))
    return rows


def machine() -> dict[str, str]:
    """What the figures were measured on: processor, cores, load, and the versions that matter."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    versions = {name: importlib.metadata.version(name) for name in ("numpy", "numba", "casadi")}
    cores, load = os.cpu_count(), os.getloadavg()[0]
    return {
        "processor": models[0] if models else platform.processor(),
        "cores": f"{cores}, load {load:.1f} at the start",
        "system": platform.platform(),
        "python": platform.python_version(),
        **versions,
        "BLAS threads": "1",
    }


def milliseconds(seconds: float | None) -> str:
    """A time in milliseconds to three digits, or a blank."""
    return "" if seconds is None else f"{1e3 * seconds:.3g}" if seconds < 1 else f"{1e3 * seconds:.0f}"


def comparison_table(rows: list[Row]) -> Table:
    """All solvers on all cases; `ratio` is the best time over the generated solver's on the same case."""
    table = Table(title="One warm solve, times in ms", title_justify="left")
    for name in ("problem", "N", "solver"):
        table.add_column(name, justify="right" if name == "N" else "left", no_wrap=True)
    for name in ("best", "median", "callbacks", "ratio", "cost", "residual", "iterations", "build s", "status"):
        table.add_column(name, justify="right")
    own = {(r.problem, r.steps): r.best for r in rows if r.solver == "generated"}
    for index, r in enumerate(rows):
        base = own.get((r.problem, r.steps))
        ends = index + 1 == len(rows) or (rows[index + 1].problem, rows[index + 1].steps) != (r.problem, r.steps)
        times = (milliseconds(r.best), milliseconds(r.median), milliseconds(r.callbacks))
        ratio = f"{r.best / base:.1f}" if base else ""
        figures = (f"{r.cost:.10g}", f"{r.residual:.1e}", str(r.iterations), f"{r.build:.2f}")
        table.add_row(r.problem, str(r.steps), r.solver, *times, ratio, *figures, r.status, end_section=ends)
    return table


def growth_table(rows: list[Row]) -> Table:
    """The generated solver's time, in all and for each interval."""
    table = Table(title="The generated solver as N grows (orbital_transfer_2)", title_justify="left")
    for name in ("N", "best ms", "median ms", "us an interval", "us an interval and iteration", "residual", "status"):
        table.add_column(name, justify="right")
    for r in rows:
        interval = 1e6 * r.best / r.steps
        each = f"{interval / max(r.iterations, 1):.3f}"
        times = (milliseconds(r.best), milliseconds(r.median), f"{interval:.3f}", each)
        table.add_row(str(r.steps), *times, f"{r.residual:.1e}", r.status)
    return table


def write(rows: list[Row], grown: list[Row], description: dict[str, str], arguments: argparse.Namespace) -> None:
    """Write what was asked for: the rows as CSV, and rows with the machine's description as JSON."""
    records = [asdict(r) | {"table": table} for table, part in (("compare", rows), ("growth", grown)) for r in part]
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(records[0]))
            writer.writeheader()
            writer.writerows(records)
    if arguments.json:
        arguments.json.write_text(json.dumps({"machine": description, "rows": records}, indent=1) + "\n")


def main() -> None:
    """Run the cases and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="5 rounds instead of 40, and no opty")
    parser.add_argument("--csv", type=Path, help="write the rows to this file")
    parser.add_argument("--json", type=Path, help="write the rows and the machine's description to this file")
    arguments = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 180)
    rounds = 5 if arguments.quick else 40
    description = machine()
    for name, value in description.items():
        console.print(f"{name:>12}: {value}", highlight=False)
    rows: list[Row] = []
    for problem, steps in track(CASES, "Comparing", console=Console(stderr=True), transient=True):
        rows += compare(problem, steps, rounds)
        if (problem, steps) == OPTY_CASE and not arguments.quick and (opty := opty_row(rounds=3)):
            rows.append(opty)
    grown = growth(rounds)
    console.print(comparison_table(rows))
    if not grown:
        console.print("No module generated.orbital_transfer: run `codegen build problems/orbital_transfer.py` first.")
    else:
        console.print(growth_table(grown))
    write(rows, grown, description, arguments)


if __name__ == "__main__":
    main()
