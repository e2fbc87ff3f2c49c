"""Stiff problems: error against run time of every L-stable scheme, of Gauss collocation, and of scipy's Radau.

    python tests/benchmarks/stiff.py [--out FOLDER] [--csv FILE] [PROBLEM ...]

Robertson, HIRES and van der Pol's oscillator with mu = 1e3 and 1e6, each as a `Simulate` with first-order dynamics.
An error is the largest relative error of a component at the end. The reference is scipy's Radau at relative tolerance
1e-12, compared with the published values of the test set for initial value problem solvers (Mazzia and Magherini 2008).

Grids: `equal` has equal intervals. `graded` has the steps that scipy's Radau takes at a relative tolerance of 1e-3,
each divided into 1, 2, 4, ... equal parts; for Robertson lengths grow by a constant factor from 1e-5 to 1e11. Seconds
are the best of several calls of the module, without compilation, and without the making of the grid. scipy's method is
written in Python and has the exact Jacobian. A folder takes the figure stiff.png, with a panel for each problem.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import sympy
from rich.console import Console
from rich.table import Table
from scipy.integrate import solve_ivp

import codegen
from codegen import Simulate, states
from codegen.discretise import schemes

TOLERANCES = (1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8, 1e-9)
COMPARED = ("gauss-4", "gauss-6")
MOST_SECONDS = 1.0
"""A grid is refined while one solve takes less."""


@dataclass(frozen=True)
class Problem:
    """A stiff problem: its dynamics, duration and start, published end values, and the sizes of small components.

    `equal` are numbers of equal intervals. `first` is the first node of a geometric grid, or 0 for scipy's steps.
    """

    rates: Callable[..., Sequence[Any]]
    duration: float
    start: tuple[float, ...]
    published: tuple[float, ...] | None
    sizes: tuple[float, ...]
    equal: tuple[int, ...]
    first: float = 0.0

    @property
    def symbols(self) -> tuple[Any, ...]:
        """The states."""
        return states(" ".join(f"y{i}" for i in range(1, len(self.start) + 1)))

    def simulation(self) -> Simulate:
        """Return the problem as an author writes it."""
        y = self.symbols
        dynamics = dict(zip(y, self.rates(*y), strict=True))
        return Simulate(dynamics=dynamics, duration=self.duration, start=dict(zip(y, self.start, strict=True)))

    def by_scipy(self, tolerance: float) -> Any:
        """Return the solution by scipy's Radau with the exact Jacobian."""
        y = self.symbols
        right = sympy.Matrix(self.rates(*y))
        f, jacobian = (sympy.lambdify(y, each, "numpy") for each in (list(right), right.jacobian(y)))
        return solve_ivp(
            lambda _, x: f(*x), (0.0, self.duration), self.start, "Radau", jac=lambda _, x: jacobian(*x),
            rtol=tolerance, atol=tolerance * np.array(self.sizes),
        )  # fmt: skip


def hires(*y: Any) -> Sequence[Any]:
    """Return the rates of eight reactions (Schaefer 1975)."""
    bound = 280 * y[5] * y[7]
    return (
        -1.71 * y[0] + 0.43 * y[1] + 8.32 * y[2] + 0.0007, 1.71 * y[0] - 8.75 * y[1],
        -10.03 * y[2] + 0.43 * y[3] + 0.035 * y[4], 8.32 * y[1] + 1.71 * y[2] - 1.12 * y[3],
        -1.745 * y[4] + 0.43 * y[5] + 0.43 * y[6], -bound + 0.69 * y[3] + 1.71 * y[4] - 0.43 * y[5] + 0.69 * y[6],
        bound - 1.81 * y[6], 1.81 * y[6] - bound,
    )  # fmt: skip


def robertson(x: Any, y: Any, z: Any) -> Sequence[Any]:
    """Return the rates of three reactions (Robertson 1966)."""
    slow, fast, back = 0.04 * x, 3e7 * y**2, 1e4 * y * z
    return back - slow, slow - back - fast, fast


def van_der_pol(mu: float) -> Callable[..., Sequence[Any]]:
    """Return the rates of y'' = mu ((1 - y^2) y' - y)."""
    return lambda y, v: (v, mu * ((1 - y**2) * v - y))


MANY = tuple(100 * 4**k for k in range(6))
PROBLEMS = {
    "Robertson": Problem(
        robertson, 1e11, (1, 0, 0), (0.2083340149701255e-7, 0.8333360770334713e-13, 0.9999999791665050),
        (1e-8, 1e-14, 1.0), (), 1e-5,
    ),
    "HIRES": Problem(
        hires, 321.8122, (1, 0, 0, 0, 0, 0, 0, 0.0057),
        (
            0.7371312573325668e-3, 0.1442485726316185e-3, 0.5888729740967575e-4, 0.1175651343283149e-2,
            0.2386356198831331e-2, 0.6238968252742796e-2, 0.2849998395185769e-2, 0.2850001604814231e-2,
        ),
        (1e-4,) * 8, MANY,
    ),
    "van der Pol, mu = 1e3": Problem(van_der_pol(1e3), 2.0, (2, 0), None, (1, 1), MANY),
    "van der Pol, mu = 1e6": Problem(
        van_der_pol(1e6), 2.0, (2, 0), (0.1706167732170483e1, -0.8928097010247975), (1, 1), MANY
    ),
}  # fmt: skip


@dataclass(frozen=True)
class Row:
    """What a program does on a problem; `message` is empty if it solved the problem."""

    problem: str
    program: str
    grid: str
    intervals: int
    seconds: float
    error: float
    message: str = ""


def l_stable() -> list[str]:
    """Return the names of the L-stable schemes for first-order dynamics, from their stability functions."""
    names = []
    for scheme in schemes.of_method(schemes.FIRST_ORDER):
        if scheme.parts or scheme.step().is_explicit:
            continue
        tableau = scheme.step().tableau
        b = np.array([complex(w) for w in tableau.weights])
        a = np.array([[complex(entry) for entry in row] for row in tableau.positions])

        def growth(z: complex, a: Any = a, b: Any = b) -> float:
            return float(abs(1 + z * b @ np.linalg.solve(np.eye(len(b)) - z * a, np.ones(len(b)))))

        if growth(-1e6) < 1e-4 and max(growth(1j * y) for y in np.geomspace(1e-3, 1e6, 400)) < 1 + 1e-9:
            names.append(scheme.name)
    return names


def timed(function: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a call, and the least seconds of several calls."""
    best, total = np.inf, 0.0
    for _ in range(7):
        begin = time.perf_counter()
        result = function()
        seconds = time.perf_counter() - begin
        best, total = min(best, seconds), total + seconds
        if total > MOST_SECONDS:
            break
    return result, best


def measured(name: str) -> Iterator[Row]:
    """Yield all rows of a problem."""
    problem = PROBLEMS[name]
    exact = problem.by_scipy(1e-12).y[:, -1]
    if problem.published:
        gap = np.abs(exact / problem.published - 1.0).max()
        print(f"{name}: the reference differs from the published values by {gap:.1e}", flush=True)

    def error_of(end: Any) -> float:
        with np.errstate(all="ignore"):
            return float(np.abs(end / exact - 1.0).max())

    coarse = problem.by_scipy(1e-3).t
    if problem.first:
        coarse = np.append(0.0, np.geomspace(problem.first, problem.duration, 50))
    print(f"{name}: {coarse.size - 1} graded steps before they are divided", flush=True)
    for scheme in (*l_stable(), *COMPARED):
        module: Any = codegen.compile(problem.simulation(), scheme=scheme).module
        module.solve(1)
        grids: list[tuple[str, Any]] = [("equal", n) for n in problem.equal]
        for parts in (2**k for k in range(8)):
            if problem.first:
                nodes = np.append(0.0, np.geomspace(problem.first, problem.duration, 50 * parts))
                grids.append(("graded", np.diff(nodes) / problem.duration))
            else:
                grids.append(("graded", np.repeat(np.diff(coarse), parts) / parts / problem.duration))
        slow = set[str]()
        for kind, grid in grids:
            if kind in slow:
                continue
            steps = {"steps": grid} if kind == "equal" else {"grid": grid}
            solution, seconds = timed(lambda m=module, s=steps: m.solve(**s))
            number = grid if kind == "equal" else len(grid)
            is_solved = solution.status == "solved"
            error = error_of(solution.q[-1]) if is_solved else np.nan
            yield Row(name, scheme, kind, number, seconds, error, "" if is_solved else solution.message.split(":")[0])
            if seconds > MOST_SECONDS:
                slow.add(kind)
    for tolerance in TOLERANCES:
        solution, seconds = timed(lambda t=tolerance: problem.by_scipy(t))
        yield Row(name, "scipy Radau", f"{tolerance:g}", solution.t.size - 1, seconds, error_of(solution.y[:, -1]))


def table(rows: Sequence[Row]) -> Table:
    """Return the table of a problem."""
    chart = Table("scheme", "grid", "intervals", "seconds", "error", "failure", title=rows[0].problem)
    last = rows[0].program
    for row in rows:
        if row.program != last:
            chart.add_section()
            last = row.program
        error = f"{row.error:.1e}" if np.isfinite(row.error) else ""
        chart.add_row(row.program, row.grid, str(row.intervals), f"{row.seconds:.2e}", error, row.message)
    return chart


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the error against the run time, a panel for each problem; only graded grids, if there are any."""
    import matplotlib.pyplot as plt

    names = list(dict.fromkeys(row.problem for row in rows))
    figure, axes = plt.subplots(2, 2, figsize=(11, 8.5), layout="constrained", squeeze=False)
    programs = list(dict.fromkeys(row.program for row in rows))
    for panel, name in zip(axes.ravel(), names, strict=False):
        for number, program in enumerate(programs):
            chosen = [r for r in rows if (r.problem, r.program) == (name, program) and r.grid != "equal"]
            points = [(r.seconds, r.error) for r in chosen if 0.0 < r.error < 10.0]
            if points:
                is_peer = program.startswith("scipy")
                look: dict[str, Any] = {"color": "black" if is_peer else f"C{number}"}
                look["linestyle"] = "--" if is_peer else "-"
                panel.loglog(*zip(*points, strict=True), marker="o", markersize=4, linewidth=1.2, label=program, **look)
        panel.set_title(name, loc="left")
        panel.set_xlabel("seconds")
        panel.set_ylabel("largest relative error at the end")
        panel.set_ylim(1e-13, 10.0)
        panel.grid(color="0.9")
    for panel in axes.ravel()[len(names) :]:
        panel.remove()
    curves = {str(line.get_label()): line for panel in axes.ravel() for line in panel.get_lines()}
    figure.legend([curves[p] for p in programs if p in curves], [p for p in programs if p in curves],
                  loc="outside lower center", ncols=len(programs))  # fmt: skip
    figure.savefig(path, dpi=120)


def main() -> None:
    """Measure, print the tables, and write the figure and the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help=f"some of {', '.join(PROBLEMS)}; all by default")
    parser.add_argument("--out", type=Path, help="folder for the figure")
    parser.add_argument("--csv", type=Path, help="where to write the table")
    options = parser.parse_args()
    rows: list[Row] = []
    for name in options.problems or PROBLEMS:
        own = list(measured(name))
        Console(width=120).print(table(own))
        rows += own
    if options.csv:
        with options.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow(Row.__dataclass_fields__)
            writer.writerows([getattr(row, field) for field in Row.__dataclass_fields__] for row in rows)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        draw(rows, options.out / "stiff.png")


if __name__ == "__main__":
    main()
