"""Accuracy on request: twelve problems beside references that closed forms, scipy or other people's programs give.

    python tests/benchmarks/accuracy.py [--accuracy E ...] [--uniform] [--ipopt] [--time-limit S] [PROBLEM ...]

For each problem and request: status, relative error of the cost, the estimate that `codegen solve --accuracy` gives of
states and cost, intervals, pairs of grids and seconds. `--uniform` adds, for problems with layers or switches, on how
many equal intervals the same scheme has the same error of the cost, or that it has not on fifty times as many.
`--ipopt` adds the same refinement of the same scheme with IPOPT to solve each grid, by the module's compiled
derivatives and from the same guesses: status, grids, seconds, and how many times as long that took. A reference with
few digits cannot show smaller errors than its own, which stands beside. Ends with exit status 1 if a solution that
claims an accuracy has an error above three times the request.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import math
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parent))

from peers import indirect

import codegen

PROBLEMS = Path(__file__).resolve().parents[2] / "problems"
MOST = 50
"""Times as many equal intervals, after which no more are tried."""


@dataclass(frozen=True)
class Case:
    """A problem's file, its least cost, the relative error of that, arguments, and whether grids are to be compared."""

    file: str
    reference: Callable[[], float]
    uncertain: float = 1e-11
    arguments: dict[str, Any] = field(default_factory=dict)
    has_layers: bool = False


CASES = {
    "hypersensitive": Case("hypersensitive", indirect.hypersensitive, arguments={"duration": 1e4}, has_layers=True),
    "goddard_rocket": Case("goddard_rocket", indirect.goddard_rocket, has_layers=True),
    "van_der_pol": Case("van_der_pol", indirect.van_der_pol, 1e-10),
    "catalyst_mixing": Case("published/catalyst_mixing", indirect.catalyst_mixing),
    "robbins": Case("published/robbins", lambda: 19.43182, 5e-6),  # extrapolated from CTBenchmarks.jl
    "space_shuttle_heating": Case(
        "published/space_shuttle_reentry", lambda: -math.radians(30.62548), 1e-6, {"heat_limit": 70.0}
    ),  # peers/casadi_shuttle.py, 120 elements of degree five; dymos has 30.6255
    "double_integrator_effort": Case("double_integrator_effort", lambda: 12.0),
    "bryson_denham": Case("bryson_denham", lambda: 4.0),
    "linear_tangent_steering": Case("published/linear_tangent_steering", indirect.linear_tangent_steering),
    "moon_lander": Case("published/moon_lander", indirect.moon_lander, 1e-10, has_layers=True),
    "singular_arc": Case("published/singular_arc", lambda: 10.0 / 3.0),
    "hanging_chain": Case("published/hanging_chain", indirect.hanging_chain),
}


def main() -> int:
    """Print a line for each problem and request; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all by default")
    parser.add_argument("--accuracy", type=float, nargs="+", default=[1e-4, 1e-6, 1e-8])
    parser.add_argument("--uniform", action="store_true", help="compare with equal intervals where there are layers")
    parser.add_argument("--ipopt", action="store_true", help="compare with IPOPT on the grids of the same refinement")
    parser.add_argument("--folder", type=Path, help="where modules are kept for another run")
    parser.add_argument("--time-limit", type=float, default=60.0, help="seconds of each solve")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        return compare(arguments, arguments.folder or Path(temporary))


def compare(arguments: argparse.Namespace, folder: Path) -> int:
    """Solve all that is asked for; return the exit status."""
    lies, below, claims = 0, 0, 0
    ratios: list[float] = []
    for name in arguments.problems or CASES:
        case = CASES[name]
        exact = case.reference()
        for request in arguments.accuracy:
            result = solved(case, request, arguments.time_limit, folder)
            error = abs(result.cost - exact) / abs(exact)
            claims += result.solved
            below += result.solved and error <= max(request, case.uncertain)
            lies += result.solved and error > 3.0 * max(request, case.uncertain)
            print(line(name, request, result, error, case.uncertain), flush=True)
            if arguments.uniform and case.has_layers and result.solved:
                print(f"{'':26s}{uniform(case, exact, error, result, folder)}", flush=True)
            if arguments.ipopt:
                peer = solved(case, request, arguments.time_limit, folder, "ipopt")
                ratio = seconds_of(peer) / seconds_of(result)
                if peer.solved and result.solved:
                    ratios.append(ratio)
                print(f"{'':26s}IPOPT: {outcome(peer)}, {ratio:.1f} times as long", flush=True)
    if ratios:
        print(f"IPOPT took {math.exp(sum(map(math.log, ratios)) / len(ratios)):.1f} times as long as ours, on average")
    print(f"{claims} claims, {below} of them below the request, {lies} above three times the request")
    return int(lies > 0)


def solved(case: Case, request: float, limit: float, folder: Path, driver: str = "newton") -> Any:
    """The result of a request."""
    file = PROBLEMS / f"{case.file}.py"
    options = {"accuracy": request, "time_limit": limit, "driver": driver, "out": folder}
    return codegen.solve(file, arguments=case.arguments, **options)


def seconds_of(result: Any) -> float:
    """The sum of all grids' solves, without compilation."""
    return float(sum(level.seconds for level in result.accuracy.levels))


def outcome(result: Any) -> str:
    """Status, last grid, number of grids and seconds."""
    grids = f"{result.t.size - 1:6d} intervals  {len(result.accuracy.levels):2d} grids"
    return f"{result.status:22s} {grids} {seconds_of(result):7.2f} s"


def line(name: str, request: float, result: Any, error: float, uncertain: float) -> str:
    """What came of it, in one line."""
    found = result.accuracy
    shown = f"{error:8.1e}" if error > uncertain else f"< {uncertain:.0e}"
    return (
        f"{name:26s}{request:7.0e}  {result.status:22s} error {shown:>8s}  estimate {found.estimate:7.1e} of "
        f"{found.quantity}  {result.t.size - 1:6d} intervals  {len(found.levels):2d} grids {seconds_of(result):7.2f} s"
    )


def uniform(case: Case, exact: float, error: float, result: Any, folder: Path) -> str:
    """On how many equal intervals the cost is as accurate."""
    steps = result.steps
    begin = time.perf_counter()
    while steps < MOST * result.steps and time.perf_counter() - begin < 60.0:
        steps *= 2
        again = codegen.solve(
            PROBLEMS / f"{case.file}.py",
            arguments=case.arguments,
            scheme=result.scheme,
            steps=steps,
            tolerance=1e-12,
            out=folder,
        )
        if again.cost is not None and abs(again.cost - exact) / abs(exact) <= error:
            return f"equal intervals: {steps}, which are {steps / result.steps:.0f} times as many"
    return f"equal intervals: more than {steps}, which are {steps / result.steps:.0f} times as many"


if __name__ == "__main__":
    sys.exit(main())
