"""Sensitivities of the gallery against differences of problems that are solved again, and what they cost.

    python tests/benchmarks/sensitivities.py [--steps N] [--csv FILE] [PROBLEM ...]

Every problem is solved with parameters, boundary values and durations moved a little to both sides, from its solution,
to the least tolerance that converges. Central differences with two step lengths are extrapolated (Richardson), for
several lengths, and of these the one that differs least from its neighbour is the reference; by how much it differs is
printed as `noise`. `worst` is the largest difference between a derivative and its reference, over all quantities and
over cost, durations, states, controls and multipliers, in parts of the largest entry of that derivative, or of 1e-3
|value| / max(1, |p|) where that is larger. Quantities whose noise is above 1e-7 are counted (so are those with other
derivatives to one side than to the other), and those whose problems could not be solved beside the solution. `part` is
the time of all sensitivities in parts of that of one warm solve from the problem's guess, for each ten quantities.
"""

import os

# Before numpy loads its BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import csv
import math
import sys
from itertools import pairwise
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from compiled_modules import compiled
from golden import CONTROL

from codegen.batch.request import given_to, quantities
from codegen.solving.compiler import build

ROOT = Path(__file__).resolve().parents[2]
ROOT = Path(__file__).resolve().parents[2]
LENGTHS = (1e-2, 1e-3, 1e-4, 1e-5)
"""Of steps to both sides, in parts of a quantity or of one."""
GOOD_NOISE, ASKED = 1e-7, 1e-6
FLOOR, KINK = 1e-3, 1e-3
HEADINGS = ("steps   p    worst  noise noisy unsolved doubtful   left", "solve ms  sens ms  part  of")
KINDS = ("cost", "durations", "t", "q", "p", "u", "multipliers")


def solution_arrays(module: Any, grid: Any, solution: Any) -> dict[str, Any]:
    """What has derivatives."""
    durations = module.phase_durations(grid, solution.unknowns) if hasattr(module, "phase_durations") else None
    if durations is None:
        durations = np.array([module.duration_of(grid, solution.unknowns)])
    arrays = {name: getattr(solution, name) for name in KINDS if name not in ("cost", "durations")}
    return {"cost": np.array([solution.cost]), "durations": durations, **arrays}


def solved(module: Any, steps: int, values: dict[str, Any], start: Any, tolerance: float) -> dict[str, Any] | None:
    """The arrays of the problem with other values, from a solution nearby; None where it is not solved."""
    for least in (tolerance, 1e-11, 1e-10):
        found = module.solve(steps, **values, guess=start, warm=True, tolerance=least)
        if found.status == "solved":
            return solution_arrays(module, module.make_grid(steps, **values), found)
    return None


def extrapolated(
    module: Any, steps: int, quantity: Any, value: Any, start: Any, middle: dict[str, Any]
) -> tuple[Any, dict[str, float]]:
    """The derivatives of all arrays, and by how much they differ between two step lengths; None without solutions.

    They differ without limit where the derivatives to both sides do, by more than curvature makes them.
    """
    size, found, bends = max(np.abs(value).max(), 1e-1), [], []
    for part in LENGTHS:
        differences = []
        for length in (part * size, 0.5 * part * size):
            ends = [
                solved(module, steps, given_to({quantity: value + side * length}), start, 1e-13) for side in (1, -1)
            ]
            if None in ends:
                break
            if length == part * size:
                bends.append(
                    {k: np.abs(ends[0][k] + ends[1][k] - 2.0 * middle[k]).max(initial=0.0) / length for k in KINDS}
                )
            differences.append({kind: (ends[0][kind] - ends[1][kind]) / (2 * length) for kind in KINDS})
        if len(differences) == 2:
            coarse, fine = differences
            found.append({kind: (4.0 * fine[kind] - coarse[kind]) / 3.0 for kind in KINDS})
    if len(found) < 2:
        return None, {}
    best, noise = {}, {}
    for kind in KINDS:
        floor = FLOOR * np.abs(middle[kind]).max(initial=0.0) / max(1.0, size)
        largest = max(np.abs(found[-1][kind]).max(initial=0.0), floor)
        changes = [np.abs(b[kind] - a[kind]).max(initial=0.0) for a, b in pairwise(found)]
        least = int(np.argmin(changes))
        before, behind = changes[least - 1] if least else math.inf, [*changes, math.inf][least + 1]
        if len(bends) > 2 and bends[2][kind] > max(0.3 * bends[1][kind], KINK * largest):
            changes[least] = math.inf
        best[kind], noise[kind] = found[least + 1 if behind < before else least][kind], changes[least]
    return best, noise


def compare(name: str, steps: int | None, verbose: bool) -> dict[str, Any]:
    """One line of the table."""
    path = ROOT / "problems" / f"{name}.py"
    module: Any = compiled(build(path, {}, sensitivities=True).path)
    steps = steps or module.metadata.steps
    times = []
    for _ in range(5):
        begin = perf_counter()
        solution = module.solve(steps)
        times.append(perf_counter() - begin)
    row = {"problem": name, "steps": steps, "status": solution.status, "solve": min(times)}
    for tolerance in (1e-13, 1e-12, 1e-11):
        sharp = module.solve(steps, guess=solution.unknowns, warm=True, tolerance=tolerance)
        if sharp.status == "solved":
            break
    sharp = sharp if sharp.status == "solved" else solution
    grid, start = module.make_grid(steps), sharp.unknowns
    times = []
    for _ in range(5):
        begin = perf_counter()
        found = module.sensitivities(grid, start)
        times.append(perf_counter() - begin)
    row |= {"quantities": len(module.QUANTITIES), "seconds": min(times), "failure": found.failure}
    row |= {"part": min(times) / row["solve"] * 10 / len(module.QUANTITIES), "doubtful": found.doubtful.size}
    row["inaccuracy"] = found.inaccuracy
    if found.failure:
        return row | {"worst": math.nan, "of": "", "noise": math.nan, "noisy": 0, "unsolved": 0}
    arrays = solution_arrays(module, grid, sharp)
    worst, of, largest, noisy, unsolved = 0.0, "", 0.0, 0, 0
    values = dict(zip(module.QUANTITIES, [*grid.parameters[:, : module.OWN_QUANTITIES].T, grid.steps * grid.h]))
    for i, quantity in enumerate(quantities(module.QUANTITIES, module, ())):
        value = values[quantity.name] if quantity.kind == "boundary" else float(np.max(values[quantity.name]))
        reference, noise = extrapolated(module, steps, quantity, value, start, arrays)
        if reference is None:
            unsolved += 1
            continue
        named = dict(zip(("t", "q", "p", "u", "multipliers"), module.unpacked_rates(grid, start, found, i)))
        named |= {"cost": found.cost[i : i + 1], "durations": found.durations[i]}
        is_noisy = False
        for kind in KINDS:
            if not arrays[kind].size:
                continue
            size = np.abs(arrays[kind]).max() / max(1.0, np.abs(value).max())
            scale = max(np.abs(reference[kind]).max(), FLOOR * size)
            if scale == 0.0:
                scale = 1.0
            difference = np.abs(named[kind] - reference[kind]).max() / scale
            own = noise[kind] / scale
            if verbose:
                print(f"  {quantity.name:20} {kind:12} {difference:9.1e} {own:9.1e} {scale:9.2e}")
            if own > GOOD_NOISE:
                is_noisy = True
            largest = max(largest, own if own <= GOOD_NOISE else 0.0)
            if (difference > worst and own <= GOOD_NOISE) or not math.isfinite(difference):
                worst, of = difference, f"{kind} by {quantity.name}"
        noisy += is_noisy
    return row | {"worst": worst, "of": of, "noise": largest, "noisy": noisy, "unsolved": unsolved}


def main() -> int:
    """Print a line for every problem."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", default=["linear_pendulum", "orbital_transfer", *CONTROL])
    parser.add_argument("--steps", type=int)
    parser.add_argument("--csv", type=Path)
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    rows = []
    print(f"{'problem':22} {' '.join(HEADINGS)}")
    for name in arguments.problems:
        row = compare(name, arguments.steps, arguments.verbose)
        rows.append(row)
        numbers = (
            f"{row['steps']:5d} {row['quantities']:3d} {row['worst']:8.1e} {row['noise']:6.0e} {row['noisy']:5d}",
            f"{row['unsolved']:8d} {row['doubtful']:8d} {row['inaccuracy']:6.0e}",
            f"{1e3 * row['solve']:8.3f} {1e3 * row['seconds']:8.3f} {row['part']:5.2f}",
        )
        print(f"{name:22} {' '.join(numbers)}  {row['failure'] or row['of']}", flush=True)
    if arguments.csv:
        with arguments.csv.open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
