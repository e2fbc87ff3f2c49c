"""How often the generated solvers and IPOPT solve gallery and published problems from perturbed guesses.

    python tests/benchmarks/robustness.py [--set gallery|published|all] [--seeds S] [--size E ...] [PROBLEM ...]

Each guess is the problem's own with noise on every unknown, the same for both solvers (`gallery_bridge.perturbed` says
how). On the gallery IPOPT solves CasADi's program, where it guesses end velocities and constraint forces itself, and
CasADi's constraints judge both. On the published problems it solves the module's own program through cyipopt, with its
own default options, and the module's equations and bounds judge both; there are at most `--steps` intervals, and
`--limit` seconds for each solve. `solved` is the share of guesses that a solver claims to have solved; `best` that from
which it found a cost within 1e-5 of the least that either found on the case. `false` counts claims whose result
violates a condition by more than 1e-6: there should be none.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, fields
from functools import partial
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
from peers.published_bridge import PublishedProblem

TOLERANCE = 1e-8
VIOLATION = 1e-6
SAME_COST = 1e-5
GENERATED, PEER = "generated", "IPOPT"
SHARES = ("solved", "best")
PUBLISHED = sorted(path.stem for path in (Path(__file__).resolve().parents[2] / "problems" / "published").glob("*.py"))
CASES = [case for case in [*EQUALITIES, *INEQUALITIES] if case[2] <= 100]


@dataclass(frozen=True)
class Row:
    """One solver on one case with noise of one size; `solved` and `best` are shares of all guesses."""

    collection: str
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


Reports = dict[str, list[dict[str, Any]]]


def gallery_attempts(case: Case, size: float, seeds: range) -> Reports:
    """The reports of both solvers from `seeds` perturbed guesses."""
    name, arguments, steps = case
    options = {"ipopt.tol": TOLERANCE, "ipopt.max_iter": 1000}
    peer = PreparedGallery(GALLERY[name, tuple(arguments.items())](), steps, options=options)
    own = GeneratedGallery(name, arguments, steps, TOLERANCE, peer)
    reports: Reports = {GENERATED: [], PEER: []}
    for seed in seeds:
        guess = own.perturbed_guess(size, seed)
        own.run(guess)
        reports[GENERATED].append(own.report())
        peer.run(own.as_casadi(guess))
        reports[PEER].append(peer.report())
    return reports


def published_attempts(problem: PublishedProblem, size: float, seeds: range) -> Reports:
    """The same on a published problem."""
    guesses = [problem.perturbed_guess(size, seed) for seed in seeds]
    return {GENERATED: [*map(problem.by_codegen, guesses)], PEER: [*map(problem.by_ipopt, guesses)]}


def rows_of(collection: str, name: str, steps: int, size: float, reports: Reports) -> list[Row]:
    """Both solvers' shares."""
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
        shares = (len(solved) / len(results), len(best) / len(results))
        rows.append(Row(collection, name, steps, size, solver, len(results), *shares, len(false), effort, counted))
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
        if row.solver == PEER:
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
    parser.add_argument("--set", dest="collection", choices=("gallery", "published", "all"), default="all")
    parser.add_argument("--seeds", type=int, default=50, help="guesses for each case")
    parser.add_argument("--first", type=int, default=0, help="seed of the first guess")
    parser.add_argument("--size", type=float, nargs="+", default=[0.1], help="sizes of the noise")
    parser.add_argument("--steps", type=int, default=100, help="most intervals of a published problem")
    parser.add_argument("--limit", type=float, default=60.0, help="seconds for one solve of a published problem")
    parser.add_argument("--csv", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    seeds = range(arguments.first, arguments.first + arguments.seeds)
    console, rows = Console(width=150), list[Row]()
    for collection, name, run in cases(arguments):
        try:
            rows += run(seeds)
        except Exception as error:  # a problem that cannot be built must not end the others' run
            console.print(f"{name}: {type(error).__name__}: {error}")
        console.print(f"{collection}: {name}: done", style="dim")
        if arguments.csv:
            write(rows, arguments.csv)
    console.print(table(rows))
    for collection in dict.fromkeys(row.collection for row in rows):
        for solver in (GENERATED, PEER):
            mine = [row for row in rows if (row.collection, row.solver) == (collection, solver)]
            solved, best = (sum(getattr(row, share) for row in mine) / len(mine) for share in SHARES)
            false = sum(row.false for row in mine)
            console.print(f"{collection}, {solver}: solved {solved:.1%}, best {best:.1%}, false claims {false}")
    for own, peer in zip(rows[::2], rows[1::2], strict=True):
        if own.solved < peer.solved:
            console.print(f"{own.problem}: solved {own.solved:.0%}, below IPOPT's {peer.solved:.0%}")


def cases(arguments: argparse.Namespace) -> Iterator[tuple[str, str, Callable[[range], list[Row]]]]:
    """What is to be run: collection, title, and a function of the seeds that makes its rows."""
    wanted = set(arguments.problems)

    def of_gallery(case: Case, seeds: range) -> list[Row]:
        own = title(*case[:2])
        found = ((size, gallery_attempts(case, size, seeds)) for size in arguments.size)
        return [row for size, reports in found for row in rows_of("gallery", own, case[2], size, reports)]

    def of_published(name: str, seeds: range) -> list[Row]:
        problem = PublishedProblem(name, arguments.steps, arguments.limit)
        found = ((size, published_attempts(problem, size, seeds)) for size in arguments.size)
        return [row for size, reports in found for row in rows_of("published", name, problem.steps, size, reports)]

    if arguments.collection != "published":
        for case in CASES:
            if not wanted or case[0] in wanted:
                yield "gallery", f"{title(*case[:2])}, N = {case[2]}", partial(of_gallery, case)
    if arguments.collection != "gallery":
        for name in PUBLISHED:
            if not wanted or name in wanted:
                yield "published", name, partial(of_published, name)


if __name__ == "__main__":
    main()
