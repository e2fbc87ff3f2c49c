"""Iterations by schemes with stages beside those by midpoint, on every first-order problem of the gallery.

    python tests/benchmarks/scheme_iterations.py [--schemes S ...] [--steps N ...] [--limit S] [--most R] [PROBLEM ...]

The problems are those of `problems/` and `problems/published/` that give `dynamics`, a planar quadrotor whose guess is
straight lines, and an aircraft that takes off. Prints a line for each problem, scheme and number of intervals: status,
iterations, and their ratio to those by midpoint with as many intervals. Ends with exit status 1 if a ratio is above
`--most`, or if a problem that midpoint solves is not solved. Two schemes may end at different local optima, which the
costs show. `--limit` is in seconds, for one solve. Builds are kept in the build cache.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from compiled_modules import compiled
from sympy import cos, sin

from codegen import Control, controls, parameters, states
from codegen.solving.compiler import build

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
SCHEMES = ("rk4", "gauss-4", "hermite-simpson")


def quadrotor() -> Control:
    """Fly a planar quadrotor by one metre in one second; coordinates, angle and rates of the guess are zero."""
    x, y, t, vx, vy, w = states("x y t vx vy w")
    u1, u2 = controls("u1 u2")
    m, d, g = parameters(m=0.2, d=0.3, g=9.81)
    acceleration = (u1 + u2) / (2 * m)
    rates = {x: vx, y: vy, t: w, vx: -acceleration * sin(t), vy: acceleration * cos(t) - g, w: (u2 - u1) / (2 * m * d)}
    return Control(
        dynamics=rates,
        cost=u1**2 + u2**2,
        duration=1,
        start=dict.fromkeys(rates, 0) | {x: 1},
        end=dict.fromkeys(rates, 0),
        bounds={u1: (-9.81, 9.81), u2: (-9.81, 9.81)},
        guess={u1: 1.962, u2: 1.962},
        steps=50,
    )


def take_off() -> Control:
    """Take an aircraft off and land it, at rest at both ends, by thrust and an elevator."""
    x, y, q, vx, vy, w = states("x y q vx vy w")
    u, s = controls("u s")
    rates = {
        **{x: vx, y: vy, q: w},
        **{vx: -u * sin(q) + s * cos(q) / 10, vy: u * cos(q) + s * sin(q) / 10 - 1, w: s},
    }
    return Control(
        dynamics=rates,
        cost=u**2 + s**2,
        duration=3,
        start=dict.fromkeys(rates, 0),
        end=dict.fromkeys(rates, 0) | {x: 1},
        bounds={u: (0, 3), s: (-20, 20)},
        guess={u: 1},
        steps=50,
    )


def first_order() -> Iterator[tuple[str, Any]]:
    """Names and sources of all problems."""
    yield from (("(quadrotor)", quadrotor()), ("(take-off)", take_off()))
    for path in (*sorted(PROBLEMS.glob("*.py")), *sorted(PROBLEMS.glob("published/*.py"))):
        if "dynamics=" in path.read_text(encoding="utf-8"):
            yield path.stem, path


def main() -> int:
    """Print the table and the worst ratio; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all by default")
    parser.add_argument("--schemes", nargs="+", default=SCHEMES)
    parser.add_argument("--steps", nargs="+", type=int, default=(50, 200, 800))
    parser.add_argument("--limit", type=float, default=120.0, help="seconds for one solve")
    parser.add_argument("--most", type=float, default=1.5, help="the greatest ratio of iterations that is no failure")
    arguments = parser.parse_args()
    failures, worst = 0, (0.0, "nothing")
    for name, source in first_order():
        if arguments.problems and name not in arguments.problems:
            continue
        own: dict[int, Any] = {}
        for scheme in ("midpoint", *arguments.schemes):
            try:
                module: Any = compiled(build(source, scheme=scheme).path)
            except Exception as error:  # a scheme that a problem refuses must not end the run
                print(f"{name:26s} {scheme:16s} {type(error).__name__}: {error}", flush=True)
                continue
            for steps in arguments.steps:
                solution = module.solve(steps, time_limit=arguments.limit)
                reference = own.setdefault(steps, solution)
                ratio = solution.iterations / max(1, reference.iterations)
                fails = reference.status == "solved" and (ratio > arguments.most or solution.status != "solved")
                failures += fails
                label = f"{name}, {scheme}, N = {steps}"
                if reference.status == solution.status == "solved":
                    worst = max(worst, (ratio, label))
                print(
                    f"{name:26s} {scheme:16s} {steps:5d}  {solution.status:15s} {solution.iterations:5d} {ratio:6.2f}  "
                    f"{solution.cost:.9g}{'  FAILS' if fails else ''}",
                    flush=True,
                )
    print(f"worst ratio {worst[0]:.2f} ({worst[1]}), {failures} failures")
    return int(failures > 0)


if __name__ == "__main__":
    sys.exit(main())
