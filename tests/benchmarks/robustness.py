"""How often the generated solvers and CasADi with IPOPT solve the gallery from perturbed guesses.

    python tests/benchmarks/robustness.py [--seeds S] [--size E ...] [--csv FILE] [PROBLEM ...]

Each guess is the problem's own with noise on every unknown, the same for both solvers (`GeneratedGallery` says how;
IPOPT guesses end velocities and constraint forces itself). `solved` is the share of guesses that a solver claims to
have solved; `best` that from which it found a cost within 1e-5 of the least that either found on the case. `false`
counts claims whose motion violates CasADi's constraints by more than 1e-6: there should be none.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import sys
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from statistics import median
from typing import Any

from gallery_speed import EQUALITIES, INEQUALITIES, Case, title
from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from peers.casadi_gallery import PreparedGallery
from peers.gallery_bridge import GeneratedGallery
from peers.gallery_table import GALLERY

TOLERANCE = 1e-8
VIOLATION = 1e-6
SAME_COST = 1e-5
CASES = [case for case in [*EQUALITIES, *INEQUALITIES] if case[2] <= 100]


@dataclass(frozen=True)
class Row:
    """One solver on one case with noise of one size; `solved` and `best` are shares of all guesses."""

    problem: str
    steps: int
    size: float
    solver: str
    guesses: int
    solved: float
    best: float
    false: int
    iterations: float
    failures: str


def attempts(case: Case, size: float, seeds: range) -> dict[str, list[dict[str, Any]]]:
    """The reports of both solvers from `seeds` perturbed guesses."""
    name, arguments, steps = case
    options = {"ipopt.tol": TOLERANCE, "ipopt.max_iter": 1000}
    peer = PreparedGallery(GALLERY[name, tuple(arguments.items())](), steps, options=options)
    own = GeneratedGallery(name, arguments, steps, TOLERANCE, peer)
    reports: dict[str, list[dict[str, Any]]] = {"generated": [], "CasADi": []}
    for seed in seeds:
        guess = own.perturbed_guess(size, seed)
        own.run(guess)
        reports["generated"].append(own.report())
        peer.run(own.as_casadi(guess))
        reports["CasADi"].append(peer.report())
    return reports


def rows_of(case: Case, size: float, seeds: range) -> list[Row]:
    """Both solvers' shares."""
    reports = attempts(case, size, seeds)
    honest = [
        r["cost"] for rs in reports.values() for r in rs if r["status"] == "solved" and r["residual"] <= VIOLATION
    ]
    least = min(honest, default=float("inf"))
    rows = []
    for solver, results in reports.items():
        solved = [r for r in results if r["status"] == "solved"]
        false = [r for r in solved if not r["residual"] <= VIOLATION]
        best = [r for r in solved if r not in false and r["cost"] <= least + SAME_COST * max(1e-3, abs(least))]
        words = [r["status"] for r in results if r["status"] != "solved"]
        counted = ", ".join(f"{words.count(word)} {word}" for word in sorted(set(words)))
        effort = median(r["iterations"] for r in solved) if solved else float("nan")
        shares = (len(solved) / len(seeds), len(best) / len(seeds))
        rows.append(Row(title(*case[:2]), case[2], size, solver, len(seeds), *shares, len(false), effort, counted))
    return rows


def table(rows: list[Row]) -> Table:
    """All cases."""
    chart = Table(title="Perturbed guesses", title_justify="left")
    for column in ("problem", "N", "noise", "solver", "solved", "best", "false", "iterations"):
        chart.add_column(column, justify="left" if column in ("problem", "solver") else "right", no_wrap=True)
    chart.add_column("failures")
    for row in rows:
        shares = (f"{row.solved:.0%}", f"{row.best:.0%}", str(row.false), f"{row.iterations:.0f}")
        chart.add_row(row.problem, str(row.steps), f"{row.size:g}", row.solver, *shares, row.failures)
        if row.solver == "CasADi":
            chart.add_section()
    return chart


def write(rows: list[Row], path: Path) -> None:
    """Everything so far, so that an interrupted run is not lost."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=[field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all by default")
    parser.add_argument("--seeds", type=int, default=50, help="guesses for each case")
    parser.add_argument("--first", type=int, default=0, help="seed of the first guess")
    parser.add_argument("--size", type=float, nargs="+", default=[0.1], help="sizes of the noise")
    parser.add_argument("--csv", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    console, rows = Console(width=150), list[Row]()
    for case in CASES:
        if arguments.problems and case[0] not in arguments.problems:
            continue
        for size in arguments.size:
            try:
                rows += rows_of(case, size, range(arguments.first, arguments.first + arguments.seeds))
            except Exception as error:  # a problem that cannot be built must not end the others' run
                console.print(f"{title(*case[:2])}: {type(error).__name__}: {error}")
        console.print(f"{title(*case[:2])}, N = {case[2]}: done", style="dim")
        if arguments.csv:
            write(rows, arguments.csv)
    console.print(table(rows))
    for solver in ("generated", "CasADi"):
        mine = [row for row in rows if row.solver == solver]
        if mine:
            shares = [sum(getattr(row, share) for row in mine) / len(mine) for share in ("solved", "best")]
            false = sum(row.false for row in mine)
            console.print(f"{solver}: solved {shares[0]:.1%}, best {shares[1]:.1%}, false claims {false}")


if __name__ == "__main__":
    main()
