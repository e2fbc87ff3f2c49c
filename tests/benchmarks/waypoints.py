"""Waypoints beside CasADi and IPOPT, where each segment between two of them is a phase of its own.

    python tests/benchmarks/waypoints.py

Prints, for `problems/drone_gates.py` and for a unit mass that passes 3 and 20 gates in the least time, the optimum on
some numbers of intervals by both (the same midpoint rule, IPOPT to 1e-12 without relaxed bounds), iterations, and
milliseconds of a warm solve, of IPOPT without the making of the problem.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import itertools
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

import casadi
from rich.console import Console
from rich.table import Table

from codegen.solving import api

ROOT = Path(__file__).resolve().parents[2]
PRECISE = {"print_level": 0, "tol": 1e-12, "bound_relax_factor": 0.0, "max_iter": 3000}


@dataclass(frozen=True)
class Flight:
    """A point in the plane with drag and weight, a limited thrust, and its gates: x, lowest and highest y, when."""

    gates: tuple[tuple[float, float, float, float], ...]
    end: tuple[float, float]
    thrust: float = 1.0
    drag: float = 0.0
    weight: float = 0.0
    effort: float = 0.0
    guess: float = 8.0

    def optimum(self, steps: int) -> tuple[float, int, float]:
        """Cost, iterations and seconds of IPOPT on so many intervals, equally many between any two gates."""
        problem, time, cost, last = casadi.Opti(), 0, 0, casadi.DM([0, 0, 0, 0])
        count, places = steps // (len(self.gates) + 1), [(0.0, 0.0), *((x, y) for x, y, _, _ in self.gates), self.end]
        for number, (here, there) in enumerate(itertools.pairwise(places)):
            duration, x, u = problem.variable(), problem.variable(4, count + 1), problem.variable(2, count)
            problem.subject_to(duration >= 0)
            problem.set_initial(duration, self.guess / (len(self.gates) + 1))
            problem.set_initial(u[1, :], self.weight)
            for j in range(2):
                problem.set_initial(x[j, :], [here[j] + (there[j] - here[j]) * i / count for i in range(count + 1)])
            problem.subject_to(x[:, 0] == last)
            time, h, last = time + duration, duration / count, x[:, count]
            for i in range(count):
                middle, thrust = (x[:, i] + x[:, i + 1]) / 2, u[:, i]
                force = thrust - self.drag * middle[2:] - casadi.DM([0, self.weight])
                problem.subject_to(x[:, i + 1] == x[:, i] + h * casadi.vertcat(middle[2:], force))
                problem.subject_to(casadi.sumsqr(thrust) <= self.thrust**2)
                cost += self.effort * h * casadi.sumsqr(thrust)
            self._pass(problem, number, last, time)
        problem.minimize(time + cost)
        problem.solver("ipopt", {"print_time": False}, PRECISE)
        begin = perf_counter()
        solution = problem.solve()
        return float(solution.value(time + cost)), int(problem.stats()["iter_count"]), perf_counter() - begin

    def _pass(self, problem: Any, number: int, state: Any, time: Any) -> None:
        if number == len(self.gates):
            problem.subject_to(state == casadi.DM([*self.end, 0, 0]))
            return
        x, low, high, opening = self.gates[number]
        problem.subject_to(state[0] == x)
        problem.subject_to(state[1] == low if low == high else problem.bounded(low, state[1], high))
        if opening > 0:
            problem.subject_to(time >= opening)


DRONE = Flight(((4, 3, 3, 0), (9, 0, 0, 0), (6, 4, 5, 4.2)), (0, 0), thrust=16.0, drag=0.3, weight=9.81, effort=0.002)
GATES = '''"""A unit mass passes gates in the least time."""

from sympy import Eq

from codegen import Control, free_parameter, control, states


def problem(gates: int = 3) -> Control:
    x, y, v, w = states("x y v w")
    a, b, T = control("a"), control("b"), free_parameter("T", 2.5 * (gates + 1), lower=0.1)
    return Control(
        dynamics={x: v, y: w, v: a, w: b}, terminal_cost=T, duration=T, steps=60, path=[a**2 + b**2 <= 1],
        start={x: 0, y: 0, v: 0, w: 0}, end={x: gates + 1, y: 0, v: 0, w: 0},
        waypoints=[[Eq(x, i + 1), Eq(y, 1 - 2 * (i % 2))] for i in range(gates)],
    )
'''


def gates(count: int) -> Flight:
    """The same in CasADi."""
    heights = [1.0 - 2.0 * (i % 2) for i in range(count)]
    return Flight(
        tuple((i + 1.0, y, y, 0.0) for i, y in enumerate(heights)), (count + 1.0, 0.0), guess=2.5 * (count + 1)
    )


def main(cases: Sequence[tuple[str, Path, dict[str, str], Flight, Sequence[int]]]) -> None:
    """Print the table."""
    table = Table("problem", "N", "codegen", "iterations", "ms", "IPOPT", "iterations", "ms")
    for name, path, arguments, flight, numbers in cases:
        for steps in numbers:
            result = api.solve(path, arguments=arguments, steps=steps, repeat=5)
            cost, iterations, seconds = flight.optimum(steps)
            own = (f"{result.cost:.11g}", str(result.iterations), f"{1e3 * result.seconds_solve:.2f}")
            table.add_row(name, str(steps), *own, f"{cost:.11g}", str(iterations), f"{1e3 * seconds:.0f}")
    Console(width=120).print(table)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "gates.py"
        file.write_text(GATES)
        main(
            [
                ("drone_gates", ROOT / "problems/drone_gates.py", {}, DRONE, (20, 60, 120, 240)),
                ("3 gates", file, {"gates": "3"}, gates(3), (20, 60)),
                ("20 gates", file, {"gates": "20"}, gates(20), (210,)),
            ]
        )
