"""Time direct multiple shooting by rk4: the generated solvers against CasADi with fatrop and with IPOPT.

    python tests/benchmarks/shooting_speed.py [--steps N ...] [--rounds R] [--csv FILE] [PROBLEM ...]

All of them solve the same program: one step of the classical Runge-Kutta method for each interval, with one constant
control, from the same guess, with the tolerance 1e-8. CasADi's functions are compiled C, with -O3 -march=native. The
first eight problems are the first-order problems of the gallery, written a second time for the peers
(`peers/gallery_first_order.py`). The others are stated once, in `peers/shooting_problems.py`, and put in either form.

Every case runs all solvers in turn, several solves in a row each, so that a slow spell of the machine hits all. A time
is that of one warm call, from the guess to the solution, with everything built and compiled before. `ratio` is the best
time over the generated solver's. The means have the cases that both solved, to the same cost. "Another cost" is another
local optimum, or the same one of lower accuracy. `residual` is the largest violation of any constraint or bound,
unscaled, for each solver by CasADi's functions of the program. `--midpoint` has the generated solver by the midpoint
rule as well, another program with as many intervals. Builds are kept in the build cache. CasADi keeps its sources and
libraries in the current folder while it runs.
"""

import os

# Before numpy and CasADi load their BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, fields
from math import isfinite
from pathlib import Path
from statistics import median
from time import perf_counter
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import sympy
from compiled_modules import compiled
from control_speed import machine, milliseconds
from gallery_speed import BLOCK, SAME_COST, TOLERANCE, title
from peers.casadi_shooting import PreparedShooting, Solver
from peers.gallery_problem import GalleryProblem
from peers.gallery_table import GALLERY
from peers.shooting_problems import SHOOTING
from rich.console import Console
from rich.table import Table

from codegen import Control, controls, free_parameter, states, time
from codegen.solving.compiler import build

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
ITERATIONS = 1000
LONG = 1.0  # seconds after which a solver's turn ends
LIMIT = 30.0  # seconds within which a peer's first solve must end
STEPS = (20, 50, 200)
OURS, MIDPOINT = "generated, rk4", "generated, midpoint"
PEERS: dict[str, Solver] = {"CasADi, fatrop": "fatrop", "CasADi, IPOPT": "ipopt"}
FROM_GALLERY: list[tuple[str, dict[str, str]]] = [
    ("brachistochrone", {}),
    ("van_der_pol", {}),
    ("goddard_rocket", {}),
    ("crane", {}),
    ("hypersensitive", {}),
    ("betts_10_7", {"duration": "20"}),
    ("robot_arm", {}),
    ("quadrotor_path", {}),
]


@dataclass(frozen=True)
class Row:
    """One solver on one case; times in seconds. `remark` tells why a peer's ratio is in no mean."""

    problem: str
    states: int
    steps: int
    solver: str
    status: str
    cost: float = math.nan
    residual: float = math.nan
    iterations: int = 0
    best: float = math.nan
    median: float = math.nan
    build: float = math.nan
    ratio: float = math.nan
    remark: str = ""


@dataclass(frozen=True)
class Case:
    """A problem for the peers, and for ours: a file with arguments, or an object."""

    name: str
    problem: GalleryProblem
    source: Path | Control
    arguments: dict[str, str]


def cases() -> list[Case]:
    """All problems."""
    found = [
        Case(title(name, given), GALLERY[name, tuple(given.items())](), PROBLEMS / f"{name}.py", given)
        for name, given in FROM_GALLERY
    ]
    return found + [Case(f"({name})", make(), problem_object(make()), {}) for name, make in SHOOTING.items()]


def problem_object(problem: GalleryProblem) -> Control:
    """A problem of `peers/shooting_problems.py` as ours is written."""

    def limits(low: float, high: float) -> tuple[float | None, float | None]:
        return low if isfinite(low) else None, high if isfinite(high) else None

    assert problem.dynamics
    assert not callable(problem.start)
    x = states(" ".join(f"x{i}" for i in range(problem.dimension)))
    u = controls(" ".join(f"u{i}" for i in range(problem.controls)))
    p = []
    for i, (guess, *ends) in enumerate(problem.free):
        lower, upper = limits(*ends)
        p.append(free_parameter(f"p{i}", guess=guess, lower=lower, upper=upper))
    t, duration = time(), problem.duration(p)
    on_states, on_controls = problem.guess(sympy, t / duration)
    return Control(
        dynamics=dict(zip(x, problem.dynamics(sympy, x, u, t, p), strict=True)),
        cost=problem.cost(x, None, u, t),
        terminal_cost=problem.terminal_cost(x, None, p),
        duration=duration,
        start={x[i]: value for i, value in enumerate(problem.start) if value is not None},
        end={x[i]: value for i, value in enumerate(problem.end) if value is not None},
        bounds={
            **{x[i]: limits(*ends) for i, ends in problem.bounds.items()},
            **{u[i]: limits(*ends) for i, ends in problem.control_bounds.items()},
        },
        guess=dict(zip((*x, *u), (*on_states, *on_controls), strict=True)),
        steps=50,
    )


class GeneratedShooting:
    """The generated solver of one case, run and reported like a `PreparedShooting`, whose program judges rk4's."""

    def __init__(self, module: Any, steps: int, judge: PreparedShooting | None, build_seconds: float) -> None:
        """Keep what a solve needs; the module is compiled."""
        self.module, self.steps, self.judge, self.build_seconds = module, steps, judge, build_seconds

    def run(self) -> None:
        """Solve from the problem's guess."""
        self.solution = self.module.solve(self.steps, tolerance=TOLERANCE, max_iterations=ITERATIONS)

    def report(self) -> dict[str, Any]:
        """Iterations and status as the module tells them, cost and violation as CasADi's program finds them.

        The module's own cost is corrected for residuals and distances to active bounds, and no corrected cost is
        comparable. A large difference means that the two programs are not the same.
        """
        solution = self.solution
        cost, residual = float(solution.cost), math.nan
        if self.judge:
            t, x, _, u, _ = self.module.unpack(self.module.make_grid(self.steps), solution.unknowns)
            shared = np.array([t[-1]] if self.judge.problem.free else [])
            cost, residual = self.judge.judged(self.judge.ordered(x, u, shared))
            if solution.status == "solved" and abs(cost - solution.cost) > SAME_COST * max(1e-3, abs(cost)):
                raise AssertionError(f"another program: the cost is {solution.cost} here and {cost} there")
        return {
            "cost": cost,
            "residual": residual,
            "iterations": int(solution.iterations),
            "status": str(solution.status),
        }


def compare(case: Case, modules: dict[str, tuple[Any, float] | Exception], steps: int, rounds: int) -> list[Row]:
    """Run all solvers in turn, `rounds` times, and give one row for each; the first is ours by rk4."""
    contestants: dict[str, Any] = {}
    failures: dict[str, str] = {}
    for label, solver in PEERS.items():
        try:
            prepared = PreparedShooting(case.problem, steps, solver, TOLERANCE, ITERATIONS)
            if not prepared.ends(LIMIT):
                failures[label] = f"no end within {LIMIT:.0f} s"
                continue
            prepared.run()
            contestants[label] = prepared
        except Exception as error:  # a failure is a result, and the others still count
            failures[label] = f"{type(error).__name__}: {error}"
    for label, made in modules.items():
        if isinstance(made, Exception):
            failures[label] = f"{type(made).__name__}: {made}"
            continue
        judge = contestants.get("CasADi, IPOPT") if label == OURS else None
        contestants[label] = GeneratedShooting(made[0], steps, judge, made[1])
        contestants[label].run()
    seconds: dict[str, list[float]] = {label: [] for label in contestants}
    for _ in range(rounds):
        for label, contestant in contestants.items():
            seconds[label] += timed(contestant.run)
    rows: list[Row] = []
    for label in (*modules, *PEERS):
        known = {
            "problem": case.name,
            "states": case.problem.dimension,
            "steps": steps,
            "solver": label,
        }
        if label in failures:
            rows.append(Row(**known, status=failures[label]))
            continue
        best, build_seconds = min(seconds[label]), contestants[label].build_seconds
        figures = contestants[label].report() | {"best": best, "median": median(seconds[label]), "build": build_seconds}
        if label in PEERS and isfinite(rows[0].best):
            figures |= {"ratio": best / rows[0].best}
            figures |= {"remark": remark(rows[0], figures["status"], figures["cost"])}
        rows.append(Row(**known, **figures))
    return rows


def remark(own: Row, status: str, cost: float) -> str:
    """Why a peer cannot be compared with ours, or nothing."""
    if own.status != "solved" or status != "solved":
        return "not solved"
    return "" if abs(own.cost - cost) <= SAME_COST * max(1e-3, abs(cost)) else "another cost"


def timed(run: Callable[[], object]) -> list[float]:
    """The times of one block of runs, which ends early if the runs are long."""
    seconds: list[float] = []
    while len(seconds) < BLOCK and sum(seconds) < LONG:
        started = perf_counter()
        run()
        seconds.append(perf_counter() - started)
    return seconds


def table(results: Sequence[Row]) -> Table:
    """All solvers on all cases."""
    chart = Table(title="One warm solve, times in ms", title_justify="left")
    left = ("problem", "solver")
    for column in ("problem", "n", "N", "solver", "best", "median", "ratio", "cost", "residual", "iter", "build s"):
        chart.add_column(column, justify="left" if column in left else "right", no_wrap=True)
    chart.add_column("status")
    for row, after in zip(results, [*results[1:], None], strict=True):
        ratio = f"{row.ratio:.2f}" if isfinite(row.ratio) else ""
        times = [milliseconds(s if isfinite(s) else None) for s in (row.best, row.median)]
        figures = (f"{row.cost:.10g}", f"{row.residual:.1e}", str(row.iterations), f"{row.build:.1f}")
        status = row.status if row.status != "solved" or not row.remark else row.remark
        ends = after is None or (after.problem, after.steps) != (row.problem, row.steps)
        chart.add_row(
            *(row.problem, str(row.states), str(row.steps), row.solver),
            *(*times, ratio, *figures, status),
            end_section=ends,
        )
    return chart


def summary(results: Sequence[Row], steps: Sequence[int]) -> list[str]:
    """For every peer the geometric mean of its ratio, for each N and over all, and the least one."""
    lines = []
    for label in PEERS:
        of_peer = [row for row in results if row.solver == label]
        good = [row for row in of_peer if isfinite(row.ratio) and not row.remark]
        for part in dict.fromkeys((*((n,) for n in steps), tuple(steps))):
            ratios = [row.ratio for row in good if row.steps in part]
            if ratios:
                mean = math.exp(sum(map(math.log, ratios)) / len(ratios))
                name = ", ".join(map(str, part))
                lines.append(f"{label}, N = {name}: geometric mean of the ratio {mean:.2f}, over {len(ratios)} cases")
        if good:
            least = min(good, key=lambda row: row.ratio)
            below = sum(row.ratio < 1 for row in good)
            lines.append(
                f"{label}: the least ratio is {least.ratio:.2f} ({least.problem}, N = {least.steps}); {below} below 1"
            )
        left_out = [f"{row.problem} N = {row.steps} ({row.remark or row.status})" for row in of_peer if row not in good]
        if left_out:
            lines.append(f"{label}, in no mean: {', '.join(left_out)}")
    return lines


def main() -> None:
    """Run the cases and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all by default")
    parser.add_argument("--steps", nargs="+", type=int, default=STEPS)
    parser.add_argument("--rounds", type=int, default=4, help=f"rounds of {BLOCK} solves each")
    parser.add_argument("--midpoint", action="store_true", help="the generated solver by the midpoint rule as well")
    parser.add_argument("--csv", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    console = Console(width=None if sys.stdout.isatty() else 190)
    for name, value in machine().items():
        console.print(f"{name}: {value}")
    results: list[Row] = []
    for case in cases():
        if arguments.problems and case.name.strip("()").split()[0] not in arguments.problems:
            continue
        modules: dict[str, tuple[Any, float] | Exception] = {}
        for label, scheme in ((OURS, "rk4"), (MIDPOINT, "midpoint"))[: 1 + arguments.midpoint]:
            started = perf_counter()
            try:
                path = build(case.source, case.arguments, scheme=scheme).path
                modules[label] = compiled(path), perf_counter() - started
            except Exception as error:  # a build that fails is a result, too
                modules[label] = error
        for steps in arguments.steps:
            results += (rows := compare(case, modules, steps, arguments.rounds))
            ratios = ", ".join(f"{row.solver} {row.ratio:.2f} {row.remark}" for row in rows if row.solver in PEERS)
            console.print(f"{case.name}, N = {steps}: {ratios}", style="dim")
            if arguments.csv:
                write(results, arguments.csv)
    console.print(table(results))
    for line in summary(results, arguments.steps):
        console.print(line)


def write(results: Sequence[Row], path: Path) -> None:
    """Write the rows as CSV."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=[field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in results)


if __name__ == "__main__":
    main()
