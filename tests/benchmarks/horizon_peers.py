"""Time controllers by rk4 against acados and against CasADi with fatrop, on the same discrete programs.

    python tests/benchmarks/horizon_peers.py [--samples N] [--csv FILE] [PROBLEM ...]

A cart-pole (N = 40) and a planar quadrotor (N = 30) of `peers/regulators.py`, whose states are kicked at regular times.
Our controller closes the loop first, with a plant of ten steps of rk4 in a sampling time. The measured states are then
given to every contestant in turn, in blocks. An interval is one step of rk4 with a constant control, and its cost is
integrated along. All start from the first state at all nodes, later from their own last plan, shifted.

- codegen: to the tolerance 1e-8; with `prepare` before the measurement; with one Newton step
- acados: SQP to the same tolerance, and real-time iterations (SQP_RTI), with exact Hessians and with those of Gauss and
  Newton; HPIPM with partial condensing to N/4 blocks; gcc -O3 -march=native. See `peers/acados_horizon.py`.
- CasADi: fatrop, whose functions are compiled C with the same flags

Times are processor times in milliseconds, of the call from the state to the inputs. For the peers the shift of the plan
is not included. `ratio` is the median over that of our converged solves. `above` is the median and the largest
relative distance of a plan's cost from the cost of our converged plan; `residual` is the largest violation of the
discrete dynamics by a plan. `inputs` is the median and the largest difference of inputs, in parts of their range.
"""

import os

# Before numpy and CasADi load their BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import importlib.util
import sys
import tempfile
from collections.abc import Sequence
from contextlib import chdir
from dataclasses import astuple, dataclass, field, fields
from pathlib import Path
from time import thread_time
from typing import Any, Protocol

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import casadi as ca
import numpy as np
from control_speed import machine
from peers.casadi_shooting import Array, step_function
from peers.fatrop_horizon import FatropHorizon
from peers.regulators import REGULATORS, Regulator
from rich.console import Console
from rich.table import Table
from shooting_speed import problem_object

import codegen

TOLERANCE, BLOCK, BARRIER = 1e-8, 20, 1e-2
OURS = "codegen"


class Horizon(Protocol):
    """A solver of a moving horizon."""

    seconds: float
    status: str
    iterations: int

    def step(self, state: Array, t: float) -> Array:
        """Return the inputs of a state."""

    def plan(self) -> tuple[Any, Any]:
        """Return states (N + 1, n) and controls (N, m)."""


class Generated:
    """A controller of this project."""

    def __init__(self, controller: codegen.Controller, is_prepared: bool) -> None:
        """Keep the controller; with `is_prepared` it prepares each step before the time that counts."""
        self.controller, self.is_prepared = controller, is_prepared

    def step(self, state: Array, t: float) -> Array:
        """Return the inputs of a state."""
        if self.is_prepared:
            self.controller.prepare(t)
        begin = thread_time()
        inputs = self.controller.step(state, t)
        self.seconds = thread_time() - begin
        last = self.controller.last
        assert last is not None
        self.status, self.iterations, self.cost, self.residual = last.status, last.iterations, last.cost, last.residual
        return inputs


@dataclass
class Contestant:
    """A solver with what it took at every sampling time."""

    name: str
    solver: Any
    seconds: list[float] = field(default_factory=list)
    inputs: list[Array] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)
    statuses: list[str] = field(default_factory=list)
    costs: list[float] = field(default_factory=list)
    residuals: list[float] = field(default_factory=list)

    def step(self, state: Array, t: float, judge: ca.Function) -> None:
        """One sampling time."""
        solver = self.solver
        self.inputs.append(solver.step(state, t))
        self.seconds.append(solver.seconds)
        self.iterations.append(solver.iterations)
        self.statuses.append(solver.status)
        if isinstance(solver, Generated):
            cost, residual = solver.cost, solver.residual
        else:
            cost, residual = (float(value) for value in judge(*(part.T for part in solver.plan())))
        self.costs.append(cost)
        self.residuals.append(residual)


@dataclass(frozen=True)
class Row:
    """A contestant on a problem; times in milliseconds."""

    problem: str
    solver: str
    samples: int
    median: float
    late: float
    ratio: float
    iterations: float
    solved: float
    above: float
    farthest_above: float
    residual: float
    inputs: float
    farthest_inputs: float


def judge_of(regulator: Regulator) -> ca.Function:
    """Cost of a plan, and its largest violation of the dynamics: of states (n, N + 1) and controls (m, N)."""
    problem, steps = regulator.problem, regulator.steps
    x, u = ca.MX.sym("x", problem.dimension, steps + 1), ca.MX.sym("u", problem.controls, steps)
    mapped = step_function(problem, steps).map("steps", "serial", steps, [3], [])
    end, cost = mapped(x[:, :-1], u, ca.DM(np.arange(steps)).T, ca.MX(0, 1))
    total = ca.sum2(cost) + problem.terminal_cost(ca.vertsplit(x[:, -1]), None, [])
    return ca.Function("judge", [x, u], [total, ca.mmax(ca.fabs(ca.vec(x[:, 1:] - end)))])


def moved(regulator: Regulator, state: Array, inputs: Array) -> Array:
    """The state after a sampling time."""
    problem = regulator.problem
    assert problem.dynamics
    h = problem.duration([]) / regulator.steps / 10

    def rate(x: Array) -> Array:
        return np.array(problem.dynamics(np, x, inputs, 0.0, []), dtype=float)

    for _ in range(10):
        first = rate(state)
        second = rate(state + h / 2 * first)
        third = rate(state + h / 2 * second)
        state = state + h / 6 * (first + 2 * second + 2 * third + rate(state + h * third))
    return state


def measured_states(regulator: Regulator, controller: codegen.Controller, samples: int) -> list[Array]:
    """The states of the loop that our controller closes, with random kicks."""
    generator = np.random.default_rng(7)
    assert not callable(regulator.problem.start)
    state, found = np.array(regulator.problem.start, dtype=float), []
    for k in range(samples):
        if k and k % regulator.every == 0:
            state = state + np.array(regulator.kick) * generator.uniform(-1.0, 1.0, state.size)
        found.append(state)
        state = moved(regulator, state, controller.step(state, 0.0))
    return found


def compared(name: str, regulator: Regulator, samples: int) -> list[Row]:
    """All contestants on one problem."""
    written = problem_object(regulator.problem)
    options: dict[str, Any] = {"steps": regulator.steps, "tolerance": TOLERANCE}
    controller = codegen.Controller(written, scheme="rk4", **options)
    states = measured_states(regulator, controller, samples)
    controller.reset()
    ahead, single = (codegen.Controller(controller.module, **options, **more) for more in ({}, {"newton_steps": 1}))
    contestants = [
        Contestant(OURS, Generated(controller, False)),
        Contestant("codegen, prepared", Generated(ahead, True)),
        Contestant("codegen, one Newton step", Generated(single, False)),
    ]
    if importlib.util.find_spec("acados_template"):
        from peers.acados_horizon import AcadosHorizon

        for is_single in (False, True):
            for is_exact in (True, False):
                label = f"acados, {'SQP_RTI' if is_single else 'SQP'}, {'exact' if is_exact else 'Gauss-Newton'}"
                unique = f"{name}_{'rti' if is_single else 'sqp'}_{'exact' if is_exact else 'gauss'}"
                solver = AcadosHorizon(unique, regulator, is_single, is_exact, TOLERANCE)
                contestants.append(Contestant(label, solver))
    contestants.append(Contestant("CasADi, fatrop", FatropHorizon(regulator, BARRIER, TOLERANCE)))
    judge = judge_of(regulator)
    for first in range(0, samples, BLOCK):
        for contestant in contestants:
            for k in range(first, min(first + BLOCK, samples)):
                contestant.step(states[k], 0.0, judge)
    return [row_of(name, regulator, contestant, contestants[0]) for contestant in contestants]


def row_of(name: str, regulator: Regulator, one: Contestant, own: Contestant) -> Row:
    """What a contestant took; the first solve, which starts from nothing, is left out."""
    times, ours = 1e3 * np.array(one.seconds[1:]), 1e3 * np.array(own.seconds[1:])
    least = np.array(own.costs[1:])
    above = np.array(one.costs[1:]) / least - 1.0
    ranges = np.array([high - low for low, high in regulator.problem.control_bounds.values()])
    apart = (np.abs(np.array(one.inputs[1:]) - np.array(own.inputs[1:])) / ranges).max(axis=1)
    return Row(
        name, one.name, len(times), float(np.median(times)), float(np.percentile(times, 99.0)),
        float(np.median(times) / np.median(ours)), float(np.mean(one.iterations[1:])),
        float(np.mean([status == "solved" for status in one.statuses[1:]])),
        float(np.median(np.abs(above))), float(np.abs(above).max()), float(np.max(one.residuals[1:])),
        float(np.median(apart)), float(apart.max()),
    )  # fmt: skip


def table_of(rows: Sequence[Row]) -> Table:
    """The rows of one problem."""
    chart = Table(title=f"{rows[0].problem}, {rows[0].samples} sampling times", title_justify="left")
    for column in ("solver", "median", "99 %", "ratio", "iterations", "solved", "above", "residual", "inputs"):
        chart.add_column(column, justify="left" if column == "solver" else "right")
    for row in rows:
        chart.add_row(
            row.solver, f"{row.median:.3f}", f"{row.late:.2f}", f"{row.ratio:.2f}", f"{row.iterations:.1f}",
            f"{100 * row.solved:.1f} %", f"{row.above:.0e}, {row.farthest_above:.0e}", f"{row.residual:.0e}",
            f"{row.inputs:.0e}, {row.farthest_inputs:.0e}",
        )  # fmt: skip
    return chart


def main() -> None:
    """Run the problems and print a table for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help=f"some of {', '.join(REGULATORS)}; all by default")
    parser.add_argument("--samples", type=int, default=1000)
    parser.add_argument("--csv", type=Path)
    options = parser.parse_args()
    path = options.csv.resolve() if options.csv else None
    console = Console(width=None if sys.stdout.isatty() else 150)
    console.print(", ".join(f"{key} {value}" for key, value in machine().items()))
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch, chdir(scratch):  # sources and libraries of the peers
        for name in options.problems or REGULATORS:
            rows += (found := compared(name, REGULATORS[name](), options.samples))
            console.print(table_of(found))
    if path:
        with path.open("w", newline="", encoding="utf-8") as file:
            writer = csv.writer(file)
            writer.writerow([f.name for f in fields(Row)])
            writer.writerows(astuple(row) for row in rows)


if __name__ == "__main__":
    main()
