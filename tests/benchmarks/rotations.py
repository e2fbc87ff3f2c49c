"""Optimal control of a rotation against the same problem with a quaternion as states, from random guesses.

    python tests/benchmarks/rotations.py [--guesses G] [--steps N ...]

The problem is the least time of a rigid body that turns by 150 degrees, which is published as 28.6304
(`problems/published/reorientation.py`). `rotation` is that problem: four coordinates and a holonomic constraint, by the
variational midpoint rule. `attitude` has the first-order equations of the quaternion and the angular velocity, by the
midpoint rule. A guess is an arc from start to end, plus a random quaternion times sin(pi t/T); both forms have the same
guesses. `solved` is the share of the guesses that end in a solution, `best` the share that ends within 0.2 % of the
published time.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from pathlib import Path
from statistics import median
from time import perf_counter

import numpy as np
from rich.console import Console
from rich.table import Table
from sympy import ImmutableMatrix, cos, diag, eye, pi, rad, sin

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

import codegen
from codegen import Control, attitude, controls, free_parameter, parameters, rotation, states, time

PUBLISHED = 28.6304
NEAR = 1.002
SIZE = 0.4
"""Standard deviation of the components of the random quaternions."""


def problem(form: str) -> Control:
    """Return the problem in one of its forms, with the random quaternion a, b, c, d of the guess as parameters."""
    torques = controls("u_1 u_2 u_3")
    T, t = free_parameter("T", 30, lower=25, upper=35), time()
    bump = [sin(pi * t / T) * size for size in parameters(a=0, b=0, c=0, d=0)]
    half = rad(75) * t / T
    guess = tuple(x + y for x, y in zip((cos(half), sin(half), 0, 0), bump, strict=True))
    inertia = diag(5621, 4547, 2364)
    if form == "rotation":
        R, omega = rotation("R")
        motion = {"lagrangian": omega.dot(inertia * omega) / 2, "force": {R: torques}}
    else:
        R, omega = attitude("R"), ImmutableMatrix(states("w_1 w_2 w_3"))
        rates = inertia.inv() * (ImmutableMatrix(torques) - omega.cross(inertia * omega))
        motion = {"dynamics": {R: omega, omega: rates}}
    return Control(
        **motion,
        terminal_cost=T,
        duration=T,
        start={R: eye(3), omega: (0, 0, 0)},
        end={R: ([1, 0, 0], rad(150)), omega: (0, 0, 0)},
        bounds=dict.fromkeys(torques, (-50, 50)),
        guess={R: guess},
    )


def main() -> None:
    """Solve both forms from the same guesses and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--guesses", type=int, default=50, help="random guesses")
    parser.add_argument("--steps", type=int, nargs="+", default=[50, 100, 200], help="numbers of intervals")
    arguments = parser.parse_args()
    sizes = np.random.default_rng(0).normal(scale=SIZE, size=(arguments.guesses, 4))
    table = Table(title=f"{arguments.guesses} random guesses", title_justify="left")
    for column in ("form", "N", "solved", "best", "iterations", "ms"):
        table.add_column(column, justify="left" if column == "form" else "right")
    for form in ("rotation", "attitude"):
        solver = codegen.compile(problem(form), name=form)
        for steps in arguments.steps:
            solver.solve(steps=steps)
            results, seconds = [], []
            for numbers in sizes:
                begin = perf_counter()
                results.append(
                    solver.solve(steps=steps, parameters=dict(zip("abcd", map(float, numbers), strict=True)))
                )
                seconds.append(perf_counter() - begin)
            solved = [result for result in results if result.status == "solved"]
            best = [result for result in solved if result.cost < NEAR * PUBLISHED]
            shares = [f"{len(part) / len(results):.0%}" for part in (solved, best)]
            effort = f"{median(result.iterations for result in solved):.0f}" if solved else "-"
            table.add_row(form, str(steps), *shares, effort, f"{1e3 * median(seconds):.1f}")
    Console(width=80).print(table)


if __name__ == "__main__":
    main()
