"""What warm starts along a sweep are worth: the share of cases solved, iterations, and which optima are found.

    python tests/benchmarks/continuation.py [PROBLEM ...]

Each problem is solved for a line of values of one quantity in three ways: `cold`, from its own guess and only where
that fails from neighbours; `secant`, from the last neighbour along the secant through two; `tangent`, along the
parabola through both with the tangent that sensitivities give. `iterations` are those of all attempts at all cases,
`worse` counts cases that another way has solved at a cost that is lower by 1e-6 of it, and `improved` those that were
won from beyond a jump of the cost. Seconds of the sensitivities themselves are not those of the solves.

The last problem has a planted jump: a point goes past a hill whose place varies, and its guess goes above it. Above is
best on one side of zero and below on the other, at the same cost by symmetry, so that the lowest cost is an even
function of the place. `asymmetry` is the largest difference of costs at opposite places, in parts of them: before
neighbours beyond a jump were tried, and after.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import sys
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from compiled_modules import compiled

import codegen
from codegen.solving.compiler import build

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
WAYS = {"cold": (False, False), "secant": (True, False), "tangent": (True, True)}
"""Whether starts are warm, and whether there are sensitivities."""
WORSE = 1e-6
HILL = '''"""Go past a hill, above or below."""

from sympy import exp, pi, sin

from codegen import Control, controls, coordinates, parameters, time


def problem() -> Control:
    (x, y), (dx, dy) = coordinates("x y")
    (u, v), (place,), t = controls("u v"), parameters(place=0), time()
    return Control(
        lagrangian=(dx**2 + dy**2) / 2, force={x: u, y: v}, duration=1, steps=40,
        cost=u**2 + v**2 + 300 * exp(-20 * (x**2 + (y - place) ** 2)),
        start={x: -1, y: 0, dx: 2, dy: 0}, end={x: 1, y: 0, dx: 2, dy: 0},
        guess={x: 2 * t - 1, y: sin(pi * t) / 2},
    )
'''


@dataclass(frozen=True)
class Line:
    """A problem and the line of values of a quantity for which it is solved."""

    path: Path
    quantity: str
    values: Any
    steps: int | None = None
    arguments: dict[str, Any] = field(default_factory=dict)


LINES = {
    "orbital_transfer": Line(PROBLEMS / "orbital_transfer.py", "revolutions", np.linspace(1.0, 6.0, 51), 300),
    "hovercraft": Line(PROBLEMS / "hovercraft.py", "R", np.linspace(0.5, 3.0, 51)),
    "cart_pole": Line(PROBLEMS / "cart_pole.py", "m2", np.linspace(0.1, 0.6, 51)),
    "space_shuttle": Line(
        PROBLEMS / "published" / "space_shuttle_reentry.py", "heat_max", np.linspace(120.0, 60.0, 31), 100,
        {"heat_limit": 70},
    ),
}  # fmt: skip


def swept(line: Line) -> dict[str, Any]:
    """The data sets of the three ways."""
    module = compiled(build(line.path, line.arguments, sensitivities=True).path)
    found = {}
    for way, (is_warm, has_rates) in WAYS.items():
        found[way] = codegen.sweep(
            module, {line.quantity: line.values}, steps=line.steps, warm_starts=is_warm, sensitivities=has_rates,
            workers=1, chunk=line.values.size, keep=(),
        )  # fmt: skip
    return found


def printed(name: str, line: Line, found: dict[str, Any]) -> None:
    """Print a row for each way."""
    best = np.nanmin([data.cost.values for data in found.values()], axis=0)
    values = f"{line.quantity} {line.values[0]:g} to {line.values[-1]:g}"
    for way, data in found.items():
        solved = data.status.values == "solved"
        worse = int((data.cost.values > best + WORSE * np.abs(best)).sum())
        improved = int((data.improvement.values > 0.0).sum())
        print(
            f"{name:17} {values:22} {way:8} {solved.sum():4}/{solved.size} {int(data.iterations.sum()):10} "
            f"{float(data.seconds.sum()):8.2f} {worse:6} {improved:8}"
        )
        name = values = ""


def main() -> int:
    """Print the table."""
    wanted = sys.argv[1:] or [*LINES, "hill"]
    print(f"{'':17} {'':22} {'starts':8} {'solved':>7} {'iterations':>10} {'seconds':>8} {'worse':>6} {'improved':>8}")
    for name, line in LINES.items():
        if name in wanted:
            printed(name, line, swept(line))
    if "hill" in wanted:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "hill.py"
            path.write_text(HILL)
            line = Line(path, "place", np.linspace(-0.6, 0.6, 49))
            found = swept(line)
        printed("hill", line, found)
        for way, data in found.items():
            after, before = data.cost.values, data.cost.values + data.improvement.values
            parts = [np.nanmax(np.abs(costs - costs[::-1]) / after) for costs in (before, after)]
            print(f"{'':17} asymmetry of {way}: {parts[0]:.1e} before, {parts[1]:.1e} after")
    return 0


if __name__ == "__main__":
    sys.exit(main())
