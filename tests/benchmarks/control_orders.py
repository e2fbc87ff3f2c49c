"""Orders of optimal controls with a value at every stage, and their work beside the midpoint rule's constant controls.

    python tests/benchmarks/control_orders.py [--csv FILE] [PROBLEM ...]

Five smooth problems of the gallery, first-order or by the Hamiltonian method, by every scheme of that method with an
order above 2 that is no composition, and by four steps of rk4 in an interval. Schemes with negative weights (sdirk-4,
dormand-prince-5) are left out: a cost of controls at their stages has no minimum. Meshes are doubled. An error is the
relative distance of the cost from the closed form, or from gauss-6 on a mesh twice as fine as the finest here;
`order` is the slope between the two finest meshes whose errors are above rounding (1e-12). The last columns are
intervals, and milliseconds of one warm solve, with which a scheme reaches an error of 1e-8: of these meshes the first
that does, for the midpoint rule extrapolated from the finest mesh with its order 2 where none does (marked ~).
"""

import os

# Before numpy loads its BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import codegen
from codegen.discretise import schemes

PROBLEMS_FOLDER = Path(__file__).resolve().parents[2] / "problems"
COARSEST, DOUBLINGS, FINEST_MIDPOINT = 5, 6, 5120
ROUNDING, TARGET = 1e-12, 1e-8


@dataclass(frozen=True)
class Case:
    """A problem, its arguments, the intervals of its coarsest mesh, and the optimum where it is known."""

    arguments: dict[str, object]
    coarsest: int = COARSEST
    exact: float | None = None


CASES = {
    "linear_pendulum": Case({}, exact=4.530760981081599),
    "orbital_transfer": Case({}, 10),
    "spherical_pendulum": Case({"form": "angles"}),
    "n_link_pendulum": Case({}),
    "betts_10_7": Case({"duration": 20}, 20),
}


@dataclass(frozen=True)
class Row:
    """What a scheme does on a problem."""

    problem: str
    scheme: str
    controls: str
    order: float
    finest_error: float
    intervals: float
    milliseconds: float
    extrapolated: bool


def method_of(name: str) -> str:
    """Return the method for a problem: Lagrangians are solved by the Hamiltonian method."""
    text = (PROBLEMS_FOLDER / f"{name}.py").read_text(encoding="utf-8")
    return "hamiltonian" if "lagrangian" in text else schemes.FIRST_ORDER


def solved(name: str, case: Case, scheme: str, controls: str, steps: int) -> Any:
    """An optimum with tight tolerance, timed over ten warm solves."""
    result = codegen.solve(
        PROBLEMS_FOLDER / f"{name}.py",
        arguments=case.arguments,
        method=method_of(name),
        scheme=scheme,
        controls=controls,
        steps=steps,
        tolerance=1e-10,
        repeat=10,
    )
    if result.status != "solved":
        raise SystemExit(f"{name} by {scheme} on {steps} intervals: {result.message}")
    return result


def measured(name: str, case: Case, scheme: str, controls: str, exact: float) -> Row:
    """Errors on meshes that are doubled until rounding shows, and what the target takes."""
    steps, found = case.coarsest, []
    last = FINEST_MIDPOINT if scheme == "midpoint" else case.coarsest * 2**DOUBLINGS
    while steps <= last:
        result = solved(name, case, scheme, controls, steps)
        error = abs(result.cost - exact) / abs(exact)
        found.append((steps, error, 1e3 * result.seconds_solve))
        if error < ROUNDING:
            break
        steps *= 2
    sound = [row for row in found if row[1] > ROUNDING]
    order = math.log2(sound[-2][1] / sound[-1][1]) if len(sound) > 1 else math.nan
    reached = next((row for row in found if row[1] <= TARGET), None)
    if reached:
        return Row(name, scheme, controls, order, found[-1][1], reached[0], reached[2], False)
    factor = (found[-1][1] / TARGET) ** (1 / order)
    return Row(name, scheme, controls, order, found[-1][1], factor * found[-1][0], factor * found[-1][2], True)


def rows_of(name: str) -> list[Row]:
    """All schemes on one problem."""
    case = CASES[name]
    exact = case.exact
    if exact is None:
        exact = solved(name, case, "gauss-6", "stages", case.coarsest * 2 ** (DOUBLINGS + 1)).cost
    assert exact is not None
    offered = [
        s.name
        for s in schemes.of_method(method_of(name))
        if s.order > 2 and not s.parts and min(s.step().tableau.weights) >= 0
    ]
    rows = [measured(name, case, scheme, "stages", exact) for scheme in (*offered, "4-steps-of-rk4")]
    return [*rows, measured(name, case, "midpoint", "interval", exact)]


def table(rows: Sequence[Row]) -> Table:
    """All problems."""
    chart = Table(title="Optimal controls at stages", title_justify="left")
    for column in (
        "problem",
        "scheme",
        "controls",
        "order",
        "least error",
        "N for 1e-8",
        "ms for 1e-8",
        "midpoint/this",
    ):
        chart.add_column(column, justify="left" if column in ("problem", "scheme", "controls") else "right")
    for row in rows:
        midpoint = next(r.milliseconds for r in rows if r.problem == row.problem and r.scheme == "midpoint")
        mark = "~" if row.extrapolated else ""
        figures = (f"{row.order:.2f}", f"{row.finest_error:.1e}", f"{mark}{row.intervals:.0f}")
        times = (f"{mark}{row.milliseconds:.3g}", f"{midpoint / row.milliseconds:.1f}")
        chart.add_row(row.problem, row.scheme, row.controls, *figures, *times)
        if row.scheme == "midpoint":
            chart.add_section()
    return chart


def main() -> None:
    """Run the problems and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help=f"some of {', '.join(CASES)}; all by default")
    parser.add_argument("--csv", type=Path, help="where to write the table")
    options = parser.parse_args()
    rows: list[Row] = []
    for name in options.problems or CASES:
        rows += rows_of(name)
        print(f"{name}: done", flush=True)
    Console(width=130).print(table(rows))
    if options.csv:
        with options.csv.open("w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(Row.__dataclass_fields__)
            writer.writerows([getattr(row, field) for field in Row.__dataclass_fields__] for row in rows)


if __name__ == "__main__":
    main()
