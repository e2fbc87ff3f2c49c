"""Time the generated solvers on the gallery against CasADi with IPOPT, on the same programs, in the same run.

    python tests/benchmarks/gallery_speed.py [--set SET] [--rounds R] [--csv FILE] [--site] [PROBLEM ...]

Every case runs ours, CasADi's virtual machine and CasADi's compiled C in turn, several solves in a row each, so that a
slow spell of the machine hits all. A time is that of one warm call, from the problem's guess to the solution, with
everything built and compiled before. `ratio` is the best time over ours; the last lines give its geometric mean over
the cases that both solved, to the same cost. `residual` is CasADi's measure for all three: the largest violation of
any constraint or bound, unscaled. With `--site` the pages of the gallery show the figures, with machine and date.
"""

import os

# Before numpy and CasADi load their BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from datetime import date
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

from control_speed import machine, milliseconds
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from peers.casadi_gallery import PreparedGallery
from peers.gallery_bridge import GeneratedGallery
from peers.gallery_table import GALLERY

STORED = Path(__file__).resolve().parents[2] / "docs" / "gallery" / "speed.json"
"""What the site shows."""
BLOCK = 5  # solves in a row before the next contestant has its turn
TOLERANCE = 1e-8  # IPOPT's default, and what is asked of ours
SAME_COST = 1e-5  # relative; beyond it two solvers have found different local optima

SOLVERS = ("generated", "CasADi, virtual machine", "CasADi, compiled C")

Case = tuple[str, dict[str, str], int]
EQUALITIES: list[Case] = [
    ("linear_pendulum", {}, 200),
    ("orbital_transfer", {"revolutions": "1"}, 50),
    ("orbital_transfer", {"revolutions": "2"}, 300),
    ("hovercraft", {}, 20),
    ("hovercraft", {"craft": "5"}, 20),
    ("hovercraft", {"craft": "5"}, 200),
    ("hovercraft", {"craft": "20"}, 20),
    ("double_integrator_effort", {}, 50),
    ("hypersensitive", {}, 100),
    ("spherical_pendulum", {}, 50),
    ("spherical_pendulum", {"form": "angles"}, 50),
    ("four_bar", {}, 50),
    ("betts_10_7", {"duration": "20"}, 100),
    ("n_link_pendulum", {}, 20),
]
INEQUALITIES: list[Case] = [
    ("double_integrator", {}, 50),
    ("bryson_denham", {}, 60),
    ("brachistochrone", {}, 50),
    ("cart_pole", {}, 50),
    ("pendulum_swing_up", {}, 100),
    ("acrobot", {}, 60),
    ("quadrotor", {}, 50),
    ("two_link_arm", {}, 100),
    ("crane", {}, 90),
    ("van_der_pol", {}, 100),
    ("goddard_rocket", {}, 100),
    ("robot_arm", {}, 100),
    ("low_thrust", {}, 50),
    ("cart_pendulum", {}, 20),
    ("cart_pendulum", {"form": "holonomic"}, 20),
]
SETS = {"equalities": EQUALITIES, "inequalities": INEQUALITIES, "all": EQUALITIES + INEQUALITIES}


@dataclass(frozen=True)
class Row:
    """One solver on one case; times in seconds."""

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
    ratio: float | None = None


def title(name: str, arguments: dict[str, str]) -> str:
    """The problem as it is named in tables."""
    return " ".join([name, *(f"{key}={value}" for key, value in arguments.items())])


def compare(case: Case, rounds: int) -> list[Row]:
    """Run all contestants in turn, `rounds` times, and give one row for each; ours is the first."""
    name, arguments, steps = case
    problem = GALLERY[name, tuple(arguments.items())]()
    options = {"ipopt.tol": TOLERANCE, "ipopt.max_iter": 1000}
    _, machine_of_casadi, c_of_casadi = SOLVERS
    peers = {
        machine_of_casadi: PreparedGallery(problem, steps, options=options),
        c_of_casadi: PreparedGallery(problem, steps, compiled=True, options=options),
    }
    contestants: dict[str, Any] = peers
    failure = ""
    try:
        own = GeneratedGallery(name, arguments, steps, TOLERANCE, next(iter(peers.values())))
        contestants = {"generated": own} | peers
    except Exception as error:  # a build that fails is a result, too, and the others still count
        failure = f"{type(error).__name__}: {error}"
    seconds: dict[str, list[float]] = {solver: [] for solver in contestants}
    for contestant in contestants.values():
        contestant.run()
    for _ in range(rounds):
        for solver, contestant in contestants.items():
            seconds[solver] += timed(contestant.run)
    rows = (
        []
        if not failure
        else [Row(title(name, arguments), steps, "generated", *[math.nan] * 2, 0, failure, *[math.nan] * 3)]
    )
    base = min(seconds["generated"]) if "generated" in seconds else None
    for solver, contestant in contestants.items():
        report, times = contestant.report(), seconds[solver]
        figures = [report[key] for key in ("cost", "residual", "iterations", "status")]
        ratio = min(times) / base if base else None
        rows.append(
            Row(
                title(name, arguments),
                steps,
                solver,
                *figures,
                min(times),
                median(times),
                contestant.build_seconds,
                ratio,
            )
        )
    return rows


def timed(run: Callable[[], object]) -> list[float]:
    """The times of one block of runs."""
    seconds = []
    for _ in range(BLOCK):
        started = perf_counter()
        run()
        seconds.append(perf_counter() - started)
    return seconds


def comparable(own: Row, other: Row) -> bool:
    """Whether both solved the case, and to the same optimum."""
    both = own.status == other.status == "solved"
    return both and abs(own.cost - other.cost) <= SAME_COST * max(1e-3, abs(other.cost))


def geometric_means(results: Sequence[Sequence[Row]]) -> dict[str, tuple[float, int]]:
    """For every solver but ours the geometric mean of its ratio, and the number of cases in it."""
    logarithms: dict[str, list[float]] = {}
    for own, *others in results:
        for other in others:
            if own.solver == "generated" and other.ratio and comparable(own, other):
                logarithms.setdefault(other.solver, []).append(math.log(other.ratio))
    return {solver: (math.exp(sum(values) / len(values)), len(values)) for solver, values in logarithms.items()}


def store(case: Case, rows: Sequence[Row], load: str, rounds: int) -> None:
    """Put the figures of a case beside those that the site has of others."""
    stored = json.loads(STORED.read_text(encoding="utf-8")) if STORED.exists() else {}
    own = {key: value for key, value in machine().items() if key != "cores"}
    solvers = {
        row.solver: {key: getattr(row, key) for key in ("status", "cost", "iterations", "best", "median")}
        for row in rows
    }
    stored[f"{title(*case[:2])} N={case[2]}"] = {
        "problem": case[0],
        "arguments": case[1],
        "steps": case[2],
        "date": date.today().isoformat(),
        "machine": {**own, "cores": load},
        "solves": rounds * BLOCK,
        "comparable": all(comparable(rows[0], other) for other in rows[1:]),
        "solvers": solvers,
    }
    STORED.write_text(json.dumps(dict(sorted(stored.items())), indent=1) + "\n", encoding="utf-8")


def table(results: Sequence[Sequence[Row]]) -> Table:
    """All solvers on all cases."""
    chart = Table(title="One warm solve, times in ms", title_justify="left")
    for column in ("problem", "N", "solver", "best", "median", "ratio", "cost", "residual", "iterations", "build s"):
        chart.add_column(column, justify="left" if column in ("problem", "solver") else "right", no_wrap=True)
    chart.add_column("status")
    for rows in results:
        for row in rows:
            ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
            times = (milliseconds(row.best), milliseconds(row.median), ratio)
            figures = (f"{row.cost:.10g}", f"{row.residual:.1e}", str(row.iterations), f"{row.build:.1f}")
            chart.add_row(row.problem, str(row.steps), row.solver, *times, *figures, row.status)
        chart.add_section()
    return chart


def main() -> None:
    """Run the cases and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all of the set by default")
    parser.add_argument("--set", choices=list(SETS), default="all")
    parser.add_argument("--rounds", type=int, default=8, help=f"rounds of {BLOCK} solves each")
    parser.add_argument("--csv", type=Path, help="write the rows to this file")
    parser.add_argument("--site", action="store_true", help="keep the figures for the site's gallery")
    arguments = parser.parse_args()
    console = Console(width=190)
    for name, value in machine().items():
        console.print(f"{name}: {value}")
    results = []
    for case in SETS[arguments.set]:
        if not arguments.problems or case[0] in arguments.problems:
            load = machine()["cores"]
            results.append(compare(case, arguments.rounds))
            if arguments.site and len(results[-1]) == len(SOLVERS):
                store(case, results[-1], load, arguments.rounds)
            console.print(f"{title(*case[:2])}, N = {case[2]}: done", style="dim")
    console.print(table(results))
    for solver, (mean, count) in geometric_means(results).items():
        console.print(f"{solver}: geometric mean of the ratio {mean:.2f}, over {count} cases")
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=[field.name for field in fields(Row)])
            writer.writeheader()
            writer.writerows(asdict(row) for rows in results for row in rows)


if __name__ == "__main__":
    main()
