"""Solve the published problems with the generated solver and with IPOPT, on the same programs from the same guesses.

    python tests/benchmarks/published.py [--drivers D ...] [--steps N] [--scheme S] [--limit S] [--csv F] [PROBLEM ...]

Both have their default options; IPOPT gets the module's cost, equations and exact derivatives. `status` is what a
solver says itself, `error` the relative distance from the published value in `tests/published_references.py`, `right`
whether it is within that reference's tolerance and claimed to be solved. Each solve is a process of its own that ends
after `--limit` seconds; builds are kept in the build cache.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import json
import subprocess
import sys
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from rich.console import Console
from rich.table import Table

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from published_references import PUBLISHED, Published

ROOT = Path(__file__).resolve().parents[2]
NAN = float("nan")


@dataclass(frozen=True)
class Row:
    """One driver on one problem."""

    problem: str
    steps: int
    driver: str
    status: str
    value: float
    error: float
    tolerance: float
    right: bool
    iterations: int
    seconds: float
    residual: float
    parameters: str
    message: str


def solve_here(reference: Published, driver: str, steps: int | None, scheme: str | None) -> dict[str, Any]:
    """Build, compile, and solve once with warm machine code; the status is the driver's own."""
    from compiled_modules import compiled

    from codegen.solving import drivers
    from codegen.solving.compiler import build
    from codegen.solving.results.control import control_result
    from codegen.solving.results.result import Run

    path = ROOT / "problems" / "published" / f"{reference.problem}.py"
    module: Any = compiled(build(path, dict(reference.arguments), scheme=scheme).path)
    request, function = Run(steps or module.metadata.steps), drivers.find(driver).function("control")
    function(module, replace(request, max_iterations=1))
    begin = perf_counter()
    attempt = function(module, request)
    seconds = perf_counter() - begin
    result = control_result(module, driver, request, attempt)
    own = attempt if driver != "newton" else result
    names = {name for name in reference.parameters if name in result.summary}
    return {
        "steps": request.steps,
        "status": own.status,
        "message": own.message,
        "cost": result.cost,
        "iterations": result.iterations,
        "seconds": seconds,
        "residual": result.residual,
        "parameters": {name: result.summary[name] for name in names},
    }


def row_of(reference: Published, driver: str, arguments: argparse.Namespace) -> Row:
    """The row of a solve in a process of its own, whatever becomes of it."""
    request = [reference.title, driver, arguments.steps, arguments.scheme]
    command = [sys.executable, __file__, "--solve", json.dumps(request)]
    empty = Row(reference.title, 0, driver, "", NAN, NAN, reference.tolerance, False, 0, NAN, NAN, "", "")
    try:
        ended = subprocess.run(command, capture_output=True, text=True, timeout=arguments.limit, check=False)
    except subprocess.TimeoutExpired:
        return replace(empty, status="time limit", message=f"ended after {arguments.limit:g} s with its build")
    if ended.returncode:
        return replace(empty, status="error", message=(ended.stderr.strip().splitlines() or ["no output"])[-1])
    found = json.loads(ended.stdout.splitlines()[-1])
    error = reference.error(found["cost"])
    return replace(
        empty,
        steps=found["steps"],
        status=found["status"],
        value=reference.factor * found["cost"],
        error=error,
        right=found["status"] == "solved" and error <= reference.tolerance,
        iterations=found["iterations"],
        seconds=found["seconds"],
        residual=found["residual"],
        parameters=" ".join(f"{name}={value:.8g}" for name, value in found["parameters"].items()),
        message=found["message"],
    )


def table(rows: list[Row]) -> Table:
    """All rows."""
    chart = Table(title="Published problems", title_justify="left")
    for column in ("problem", "N", "driver", "status", "value", "error", "tolerance", "right", "iterations", "seconds"):
        words = column in ("problem", "driver", "status")
        chart.add_column(column, justify="left" if words else "right", no_wrap=True)
    for row in rows:
        numbers = (f"{row.value:.9g}", f"{row.error:.1e}", f"{row.tolerance:.0e}", "yes" if row.right else "NO")
        effort = (str(row.iterations), f"{row.seconds:.3f}")
        chart.add_row(row.problem, str(row.steps), row.driver, row.status, *numbers, *effort)
    return chart


def write(rows: list[Row], path: Path) -> None:
    """Everything so far, so that an interrupted run is not lost."""
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, fieldnames=[field.name for field in fields(Row)])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def main() -> None:
    """Run the problems and print the table and the shares."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all by default")
    parser.add_argument("--drivers", nargs="+", default=["newton", "ipopt"])
    parser.add_argument("--steps", type=int, help="intervals, the problem's own number by default")
    parser.add_argument("--scheme", help="the default scheme by default")
    parser.add_argument("--limit", type=float, default=300.0, help="seconds for one build and solve")
    parser.add_argument("--csv", type=Path, help="write the rows to this file")
    parser.add_argument("--solve", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.solve:
        title, *rest = json.loads(arguments.solve)
        print(json.dumps(solve_here(next(r for r in PUBLISHED if r.title == title), *rest)))
        return

    console, rows = Console(width=150), list[Row]()
    for reference in PUBLISHED:
        if arguments.problems and not {reference.problem, reference.title} & set(arguments.problems):
            continue
        for driver in arguments.drivers:
            row = row_of(reference, driver, arguments)
            rows.append(row)
            console.print(
                f"{row.problem}, N = {row.steps}, {driver}: {row.status}, {row.value:.10g}, error {row.error:.1e}, "
                f"{row.iterations} iterations, {row.seconds:.2f} s; {row.parameters} {row.message}",
                style="dim" if row.right else None,
                markup=False,
                highlight=False,
            )
        if arguments.csv:
            write(rows, arguments.csv)
    console.print(table(rows))
    for driver in arguments.drivers:
        mine = [row for row in rows if row.driver == driver]
        solved, right = (sum(flags) for flags in ([r.status == "solved" for r in mine], [r.right for r in mine]))
        console.print(f"{driver}: solved {solved} of {len(mine)}, {right} of them to the published value")


if __name__ == "__main__":
    main()
