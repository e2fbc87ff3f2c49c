"""Error of cost, states and controls against run time: schemes of optimal control, CasADi and dymos, on six problems.

    python tests/benchmarks/control_accuracy.py --out DIR [--methods M ...] [--schemes S ...] [PROBLEM ...]

Six problems with smooth optima (`peers/smooth_problems.py`) on meshes that are doubled (fatrop: times 4), by

- the generated solvers, by every scheme of the registry but compositions: the first-order form by the method one-step,
  and a Lagrangian by the method variational, or hamiltonian too. Controls have a value at every stage. For schemes with
  negative weights (sdirk-4, dormand-prince-5) they are constant on intervals, because a cost of controls at their
  stages has no minimum. Compositions have negative weights too, so that their order is 2 as well.
- CasADi and fatrop, by one and by four steps of rk4 in an interval with a constant control; functions compiled to C
- CasADi and IPOPT by Gauss collocation with 2 and 4 points, with a control at every point
- dymos by Radau collocation of order 7, with SLSQP of scipy, if dymos is installed

All start from the same straight line, with the tolerance 1e-10. A time is the least processor time of several warm
solves. Errors are relative to the largest value of each quantity: of the cost; of the states (x; or q and q') at the
nodes; of the controls at their stages, collocation points, or at the midpoints of intervals on which they are constant.
The reference is an extremal by `peers/pontryagin.py`; the distance between two references with different segments is
printed. A mesh is the last one if all errors are below 1e-11, if a solve takes more than half a second (dymos: a
second), or if no optimum was found.

Results are one CSV and one figure for each problem in DIR, and tables: orders; the cheapest solves whose errors are all
below 1e-3, 1e-6 and 1e-9. Where no mesh is fine enough, the order of the last two meshes predicts intervals and time
(marked ~). What a CSV file in DIR already has is not measured again.
"""

import os

# Before numpy loads its BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import importlib.util
import math
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir
from dataclasses import astuple, dataclass, fields
from functools import cached_property, partial
from math import inf
from pathlib import Path
from time import process_time
from typing import Protocol

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import numpy as np
import sympy
from compiled_modules import compiled
from control_speed import machine
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from peers.casadi_collocation import PreparedCollocation
from peers.casadi_shooting import Array, PreparedShooting
from peers.gallery_problem import GalleryProblem
from peers.pontryagin import Extremal, extremal
from peers.smooth_problems import SMOOTH, SmoothProblem
from rich.console import Console
from rich.table import Table
from shooting_speed import problem_object

import codegen
from codegen import Control, controls, coordinates
from codegen.discretise import schemes
from codegen.show.figures.picture import AMBER, BLUE, GREEN, GREY, PINK, RED, SKY, using

TOLERANCE, ITERATIONS = 1e-10, 1000
COARSEST, FINEST = 8, 4096
ENOUGH = 1e-11  # an error below which finer meshes show rounding
ROUNDING = 1e-10  # errors below are not used for orders
LONG, LONG_DYMOS = 0.5, 1.0  # seconds of a solve after which no finer mesh follows
TARGETS = (1e-3, 1e-6, 1e-9)
SEGMENTS = (32, 24)
OTHER_CONTROLS = {"rk4": ("interval",), "trapezoidal": ("nodal",)}
"""Controls that are measured beside those at stages: of the peers' program, and the usual ones of the scheme."""
FATROP, IPOPT, DYMOS = "CasADi, fatrop", "CasADi, IPOPT", "dymos, SLSQP"


@dataclass(frozen=True)
class Row:
    """One solve: errors are relative, the time is in milliseconds."""

    problem: str
    program: str
    scheme: str
    intervals: int
    status: str
    iterations: int
    milliseconds: float = math.nan
    cost: float = math.nan
    states: float = math.nan
    controls: float = math.nan

    @property
    def worst(self) -> float:
        """The largest of the three errors, infinite if there was no solution."""
        errors = (self.cost, self.states, self.controls)
        return inf if any(map(math.isnan, errors)) else max(errors)

    @property
    def series(self) -> tuple[str, str]:
        """What is the same on all meshes."""
        return self.program, self.scheme


@dataclass(frozen=True)
class Outcome:
    """An optimum: states (N + 1, n) at equidistant nodes, and controls (T, m) at their times."""

    status: str
    iterations: int
    cost: float
    states: Array
    times: Array
    controls: Array


class Prepared(Protocol):
    """A solver on one mesh; `run` is timed."""

    def run(self) -> None:
        """Solve from the problem's guess."""

    def outcome(self) -> Outcome:
        """Return the last solution."""


@dataclass(frozen=True)
class Contestant:
    """A program with a scheme, its meshes, and the seconds of a solve after which no finer mesh follows."""

    program: str
    scheme: str
    prepare: Callable[[int], Prepared]
    coarsest: int = COARSEST
    factor: int = 2
    finest: int = FINEST
    long: float = LONG


@dataclass(frozen=True)
class Family:
    """The generated solvers of a problem by one scheme; a call gives the solver on a mesh."""

    written: Control
    mechanical: GalleryProblem | None
    method: str
    scheme: str
    controls: str

    @cached_property
    def solver(self) -> codegen.Solver:
        """The solver with machine code, which is made at the first mesh."""
        solver = codegen.compile(self.written, scheme=self.scheme, method=self.method, controls=self.controls)
        compiled(solver.build.path)
        return solver

    def __call__(self, steps: int) -> Prepared:
        """Return the solver on a mesh."""
        return Generated(self.solver, self.mechanical, steps)


class Generated:
    """A generated solver on one mesh."""

    def __init__(self, solver: codegen.Solver, mechanical: GalleryProblem | None, steps: int) -> None:
        """Keep the solver, whose machine code exists."""
        self.solver, self.mechanical, self.steps = solver, mechanical, steps

    def run(self) -> None:
        """Solve from the problem's guess."""
        self.solver.module.solve(self.steps, tolerance=TOLERANCE, max_iterations=ITERATIONS)

    def outcome(self) -> Outcome:
        """Solve once more with a result."""
        result = self.solver.solve(steps=self.steps, tolerance=TOLERANCE, max_iterations=ITERATIONS)
        assert result.cost is not None
        states = result.q
        if self.mechanical:
            rates = np.linalg.solve(masses(self.mechanical, result.q), result.p[:, :, None])[:, :, 0]
            states = np.hstack([result.q, rates])
        times = np.unique(result.control_times)
        return Outcome(result.status, result.iterations, result.cost, states, times, result.controls_at(times))


class Shooting:
    """CasADi and fatrop on one mesh."""

    def __init__(self, problem: GalleryProblem, substeps: int, steps: int) -> None:
        """Write and compile the program."""
        self.prepared = PreparedShooting(problem, steps, "fatrop", TOLERANCE, ITERATIONS, substeps)
        self.run = self.prepared.run

    def outcome(self) -> Outcome:
        """Return the last solution."""
        report, problem, steps = self.prepared.report(), self.prepared.problem, self.prepared.steps
        n, m = problem.dimension, problem.controls
        unknowns = np.asarray(self.prepared.solution["x"]).ravel()
        table = unknowns[: (n + m) * steps].reshape(steps, n + m)
        times = (np.arange(steps) + 0.5) / steps * problem.duration([])
        states = np.vstack([table[:, :n], unknowns[(n + m) * steps :]])
        return Outcome(report["status"], report["iterations"], report["cost"], states, times, table[:, n:])


class Collocation:
    """CasADi and IPOPT on one mesh."""

    def __init__(self, problem: GalleryProblem, points: int, steps: int) -> None:
        """Write the program."""
        options = {"ipopt.tol": TOLERANCE, "ipopt.max_iter": ITERATIONS}
        self.prepared = PreparedCollocation(problem, steps, points, **options)
        self.run = self.prepared.run

    def outcome(self) -> Outcome:
        """Return the last solution."""
        found = self.prepared
        states, abscissae, values = found.trajectories()
        times = (np.arange(found.steps)[:, None] + abscissae).ravel() / found.steps * found.problem.duration([])
        status = "solved" if found.status == "Solve_Succeeded" else found.status
        return Outcome(status, found.iterations, found.cost, states, times, values)


class Dymos:
    """dymos on one mesh."""

    def __init__(self, problem: GalleryProblem, order: int, segments: int) -> None:
        """Set the problem up."""
        from peers.dymos_control import PreparedDymos

        self.prepared = PreparedDymos(problem, segments, order, TOLERANCE)

    def run(self) -> None:
        """Solve from the problem's guess."""
        self.prepared.restart()
        self.prepared.run()

    def outcome(self) -> Outcome:
        """Return the last solution."""
        found = self.prepared
        times, values = found.controls()
        status = "solved" if found.is_solved else "failed"
        return Outcome(status, found.iterations, found.cost, found.states(), times, values)


def mechanical_object(problem: GalleryProblem) -> Control:
    """A mechanical problem as an author writes it."""
    assert problem.lagrangian
    assert not callable(problem.start)
    q, v = coordinates(" ".join(f"q{i}" for i in range(problem.dimension)))
    u = controls(" ".join(f"u{i}" for i in range(problem.controls)))
    (first, inputs), (last, _) = (problem.guess(sympy, s) for s in (0.0, 1.0))
    assert (tuple(first), tuple(last)) == (problem.start, problem.end)  # the default guess is this straight line
    return Control(
        lagrangian=problem.lagrangian(sympy, q, v, 0),
        force=dict(zip(q, problem.force(sympy, q, v, u, 0), strict=True)),
        cost=problem.cost(q, v, u, 0),
        duration=problem.duration([]),
        start=dict(zip((*q, *v), (*problem.start, *problem.start_rate), strict=True)),
        end=dict(zip((*q, *v), (*problem.end, *problem.end_rate), strict=True)),
        guess=dict(zip(u, inputs, strict=True)),
    )


def masses(problem: GalleryProblem, positions: Array) -> Array:
    """Mass matrices (T, n, n) at positions (T, n): momenta are their products with the rates."""
    assert problem.lagrangian
    q, v = (sympy.symbols(f"{name}:{problem.dimension}", seq=True) for name in "qv")
    matrix = sympy.hessian(problem.lagrangian(sympy, q, v, 0), v)
    function = sympy.lambdify(q, matrix, "numpy", cse=True)
    return np.array([function(*position) for position in positions], dtype=float)


def contestants(problem: SmoothProblem, methods: Sequence[str], wanted: Sequence[str]) -> Iterator[Contestant]:
    """All programs with all schemes; of the generated solvers only the wanted schemes, if some are named."""
    first_order = problem.first_order
    for substeps in (1, 4):
        name = "rk4" if substeps == 1 else f"{substeps} steps of rk4"
        yield Contestant(FATROP, name, partial(Shooting, first_order, substeps), factor=4)
    for points in (2, 4):
        yield Contestant(IPOPT, f"Gauss, {points} points", partial(Collocation, first_order, points))
    if importlib.util.find_spec("dymos"):
        prepare = partial(Dymos, first_order, 7)
        yield Contestant(DYMOS, "Radau, order 7", prepare, coarsest=2, finest=64, long=LONG_DYMOS)
    for method in methods:
        source = problem.first_order if method == schemes.FIRST_ORDER else problem.mechanical
        if source is None:
            continue
        mechanical = None if method == schemes.FIRST_ORDER else source
        written = problem_object(source) if mechanical is None else mechanical_object(source)
        names = [scheme.name for scheme in schemes.of_method(method) if not scheme.parts]
        for name in [*names, *(["4-steps-of-rk4"] if method != "variational" else [])]:
            if wanted and name not in wanted:
                continue
            scheme = schemes.find(name, method)
            at_stages = scheme.variational or min(map(float, scheme.step().tableau.weights)) >= 0
            others = OTHER_CONTROLS.get(name, ()) if method == schemes.FIRST_ORDER else ()
            for place in ("stages" if at_stages else "interval", *others):
                label = name + {"stages": "", "interval": ", constant controls", "nodal": ", nodal controls"}[place]
                yield Contestant(f"codegen, {method}", label, Family(written, mechanical, method, name, place))


def timed(run: Callable[[], None]) -> float:
    """The least processor time, in seconds, of up to 20 runs in a second, after one run."""
    run()
    seconds: list[float] = []
    while len(seconds) < 20 and sum(seconds) < 1.0:
        begin = process_time()
        run()
        seconds.append(process_time() - begin)
    return min(seconds)


def rows_of(name: str, contestant: Contestant, reference: Extremal) -> list[Row]:
    """A contestant on its meshes."""
    found: list[Row] = []
    steps = contestant.coarsest
    while steps <= contestant.finest:
        prepared = contestant.prepare(steps)
        seconds = timed(prepared.run)
        outcome = prepared.outcome()
        known = name, contestant.program, contestant.scheme, steps, outcome.status, outcome.iterations
        if outcome.status != "solved":
            found.append(Row(*known, 1e3 * seconds))
            # A coarse mesh may have no solution, or SLSQP may stop at rounding.
            if len(found) > 2 or seconds > contestant.long:
                break
            steps *= contestant.factor
            continue
        states, _ = reference.at(np.linspace(0.0, reference.duration, steps + 1))
        _, values = reference.at(outcome.times)
        errors = [
            abs(outcome.cost - reference.cost) / abs(reference.cost),
            *(
                float((np.abs(a - b).max(axis=0) / np.abs(b).max(axis=0)).max())
                for a, b in ((outcome.states, states), (outcome.controls, values))
            ),
        ]
        found.append(Row(*known, 1e3 * seconds, *errors))
        if max(errors) < ENOUGH or seconds > contestant.long:
            break
        steps *= contestant.factor
    return found


def reference_of(name: str, problem: GalleryProblem, console: Console) -> Extremal:
    """The extremal; prints its distance from one with other segments."""
    first, second = (extremal(problem, segments) for segments in SEGMENTS)
    times = np.linspace(0.0, first.duration, 1001)
    apart = [
        float((np.abs(a - b).max(axis=0) / np.abs(a).max(axis=0)).max())
        for a, b in zip(first.at(times), second.at(times), strict=True)
    ]
    cost = abs(second.cost / first.cost - 1.0)
    console.print(f"{name}: cost {first.cost:.16g}; two references differ by {cost:.0e} (cost), "
                  f"{apart[0]:.0e} (states), {apart[1]:.0e} (controls)")  # fmt: skip
    return first


# Tables


def by_series(rows: Sequence[Row]) -> dict[tuple[str, str], list[Row]]:
    """The solved rows of each program and scheme."""
    found: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.worst < inf:
            found.setdefault(row.series, []).append(row)
    return found


def order(rows: Sequence[Row], kind: str) -> float:
    """The slope between the two finest meshes whose errors are above rounding."""
    sound = [(row.intervals, getattr(row, kind)) for row in rows if getattr(row, kind) > ROUNDING]
    if len(sound) < 2:
        return math.nan
    (few, before), (many, after) = sound[-2:]
    return math.log(before / after) / math.log(many / few)


def orders_table(rows: Sequence[Row]) -> Table:
    """Orders and least errors of every series of one problem."""
    chart = Table(title=f"{rows[0].problem}: orders (least errors)", title_justify="left")
    for column in ("program", "scheme", "meshes", "cost", "states", "controls", "iterations"):
        chart.add_column(column, justify="left" if column in ("program", "scheme") else "right")
    for (program, scheme), own in by_series(rows).items():
        figures = [
            f"{order(own, kind):.2f} ({min(getattr(row, kind) for row in own):.0e})"
            for kind in ("cost", "states", "controls")
        ]
        iterations = f"{min(row.iterations for row in own)} to {max(row.iterations for row in own)}"
        chart.add_row(program, scheme, f"{own[0].intervals} to {own[-1].intervals}", *figures, iterations)
    failed = [f"{row.program} by {row.scheme}, N = {row.intervals}: {row.status}" for row in rows if row.worst == inf]
    chart.caption = "; ".join(failed) or None
    return chart


@dataclass(frozen=True)
class Reached:
    """The cheapest solve to a target, measured or extrapolated."""

    scheme: str
    intervals: float
    milliseconds: float
    is_extrapolated: bool

    def __str__(self) -> str:
        mark = "~" if self.is_extrapolated else ""
        return f"{mark}{self.milliseconds:.2g} ms: {self.scheme}, {mark}{self.intervals:.0f}"


def reached(rows: Sequence[Row], target: float) -> Reached | None:
    """The cheapest mesh of one series whose three errors are below a target."""
    good = [row for row in rows if row.worst <= target]
    if good:
        best = min(good, key=lambda row: row.milliseconds)
        return Reached(best.scheme, best.intervals, best.milliseconds, False)
    if len(rows) < 2 or rows[-1].worst >= rows[-2].worst / 1.5:
        return None
    slope = math.log(rows[-2].worst / rows[-1].worst) / math.log(rows[-1].intervals / rows[-2].intervals)
    factor = (rows[-1].worst / target) ** (1 / slope)
    return Reached(rows[-1].scheme, factor * rows[-1].intervals, factor * rows[-1].milliseconds, True)


def cheapest(rows: Sequence[Row], programs: Callable[[str], bool], target: float) -> Reached | None:
    """The cheapest solve of some programs; measured solves go before extrapolated ones."""
    series = by_series([row for row in rows if programs(row.program)]).values()
    found = [one for own in series if (one := reached(own, target))]
    return min(found, key=lambda one: (one.is_extrapolated, one.milliseconds), default=None)


def cheapest_table(rows: Sequence[Row]) -> Table:
    """The cheapest solves of all problems."""
    chart = Table(title="The cheapest solve whose errors of cost, states and controls are below a target: "
                  "time, scheme, intervals", title_justify="left")  # fmt: skip
    for column in ("problem", "target", "codegen", FATROP, IPOPT, DYMOS):
        chart.add_column(column)
    for name in dict.fromkeys(row.problem for row in rows):
        own = [row for row in rows if row.problem == name]
        for target in TARGETS:
            programs = [lambda program: program.startswith("codegen")]
            programs += [lambda program, peer=peer: program == peer for peer in (FATROP, IPOPT, DYMOS)]
            found = [cheapest(own, program, target) for program in programs]
            chart.add_row(name, f"{target:.0e}", *("" if one is None else str(one) for one in found))
        chart.add_section()
    return chart


# Figures


@dataclass(frozen=True)
class Curve:
    """A series of the figures, its label and its look."""

    program: str
    scheme: str
    label: str
    colour: str
    line: str = "-"


def curves(rows: Sequence[Row]) -> list[Curve]:
    """The eight series of a figure: schemes of order 2, 4 and 8 of this project, and the peers."""
    programs = {row.program for row in rows}
    own = "codegen, variational" if "codegen, variational" in programs else "codegen, one-step"
    fine = "codegen, one-step"
    return [
        Curve(own, "midpoint", "midpoint", BLUE),
        Curve(fine, "rk4, constant controls", "rk4, constant u", SKY),
        Curve(own, "gauss-4", "gauss-4", GREEN),
        Curve(fine, "gauss-8", "gauss-8", PINK),
        Curve(FATROP, "rk4", "fatrop, rk4", RED, "--"),
        Curve(FATROP, "4 steps of rk4", "fatrop, 4 rk4", AMBER, "--"),
        Curve(IPOPT, "Gauss, 4 points", "IPOPT, Gauss 4", GREY, "--"),
        Curve(DYMOS, "Radau, order 7", "dymos, Radau 7", "black", ":"),
    ]


def figure_of(rows: Sequence[Row]) -> Figure:
    """Errors of cost, states and controls against the time of a solve, for one problem."""
    series = by_series(rows)
    with using("page"):
        figure = Figure(figsize=(14.0, 5.2), layout="constrained")
        panels = figure.subplots(1, 3, sharey=True, sharex=True)
        for axes, kind in zip(panels, ("cost", "states", "controls"), strict=True):
            ends: list[tuple[float, float, Curve]] = []
            for curve in curves(rows):
                own = series.get((curve.program, curve.scheme), [])
                if own:
                    times = [row.milliseconds for row in own]
                    errors = [max(getattr(row, kind), 1e-14) for row in own]
                    axes.loglog(times, errors, color=curve.colour, linestyle=curve.line, marker=".", markersize=6)
                    ends.append((times[-1], errors[-1], curve))
            axes.set_title(f"error of the {kind}")
            axes.set_xlabel("milliseconds of a warm solve")
            axes.set_ylim(1e-14, 2.0)
            label_ends(axes, ends)
        panels[0].set_xlim(right=12.0 * max(row.milliseconds for own in series.values() for row in own))
        panels[0].set_ylabel("relative error")
        figure.suptitle(f"{rows[0].problem}: error against run time")
    return figure


def label_ends(axes: Axes, ends: Sequence[tuple[float, float, Curve]]) -> None:
    """Write labels at the right ends of curves, moved apart vertically."""
    gap, lowest = 0.62, -13.8  # decades
    heights = [math.log10(error) for _, error, _ in ends]
    by_height = sorted(range(len(ends)), key=lambda i: heights[i])
    before = -inf
    for i in by_height:
        before = heights[i] = max(heights[i], before + gap, lowest)
    for (time, error, curve), height in zip(ends, heights, strict=True):
        axes.annotate(
            curve.label, (time, error), (1.25 * time, 10.0**height), color=curve.colour, fontsize=8, va="center",
            bbox={"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 0.5},
            arrowprops={"arrowstyle": "-", "color": curve.colour, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 2},
        )  # fmt: skip


# Files


def write(rows: Sequence[Row], path: Path) -> None:
    """Write the rows of a problem as CSV."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([field.name for field in fields(Row)])
        writer.writerows(astuple(row) for row in rows)


def read(path: Path) -> list[Row]:
    """Read the rows of a problem."""
    with path.open(newline="", encoding="utf-8") as file:
        return [
            Row(**{f.name: f.type(text) for f, text in zip(fields(Row), line.values(), strict=True)})  # type: ignore[operator]
            for line in csv.DictReader(file)
        ]


def main() -> None:
    """Measure what is asked for, and write tables and figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help=f"some of {', '.join(SMOOTH)}; all by default")
    parser.add_argument("--out", type=Path, required=True, help="the folder of CSV files and figures")
    parser.add_argument("--methods", nargs="+", default=["one-step", "variational"])
    parser.add_argument("--schemes", nargs="+", default=[], help="of the generated solvers; all by default")
    options = parser.parse_args()
    folder = options.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    console = Console(width=None if sys.stdout.isatty() else 180)
    rows: list[Row] = []
    for name in options.problems or SMOOTH:
        path = folder / f"{name}.csv"
        own = read(path) if path.exists() else []
        measured = {row.series for row in own}
        problem = SMOOTH[name]()
        missing = [
            contestant
            for contestant in contestants(problem, options.methods, options.schemes)
            if (contestant.program, contestant.scheme) not in measured
        ]
        if missing:
            with tempfile.TemporaryDirectory() as scratch, chdir(scratch):  # CasADi's and OpenMDAO's files
                reference = reference_of(name, problem.first_order, console)
                for contestant in missing:
                    own += (found := rows_of(name, contestant, reference))
                    last = found[-1]
                    end = f"{last.milliseconds:.3g} ms, {last.worst:.0e}, {last.status}"
                    console.print(f"{name}: {contestant.program}, {contestant.scheme}, N = {last.intervals}, {end}")
                    write(own, path)
        figure_of(own).savefig(folder / f"{name}.png", dpi=110)
        console.print(orders_table(own))
        rows += own
    console.print(", ".join(f"{key} {value}" for key, value in machine().items()))
    console.print(cheapest_table(rows))


if __name__ == "__main__":
    main()
