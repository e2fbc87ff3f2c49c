"""The gallery in other units: mass, length and time, each a millionth and a million times as large.

    python tests/benchmarks/units.py [--factor F] [--scaling auto|none] [PROBLEM ...]

One module solves a problem in all units, whose factors are its parameters (`gallery_units`). For each unit: status,
relative error of the cost, which is known from the units in which the problem was written, and iterations. Ends with
exit status 1 unless all are solved, to 1e-8, in at most 1.5 times the iterations.
"""

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from compiled_modules import compiled
from gallery_units import GALLERY, UNITS, cost_factor, text_in_units

MOST = 1.5


def main() -> int:
    """Print a line for each problem and unit; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", help="names of problems, all by default")
    parser.add_argument("--factor", type=float, default=1e6, help="how much larger and smaller units are")
    parser.add_argument("--scaling", default="auto", help="auto or none")
    parser.add_argument("--folder", type=Path, help="where modules are kept for another run")
    arguments = parser.parse_args()
    failures = 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.folder or Path(temporary)
        for name in arguments.problems or GALLERY:
            try:
                failures += compare(name, arguments.factor, arguments.scaling, folder)
            except Exception as error:  # a problem that cannot be built must not end the others' run
                print(f"{name}: {type(error).__name__}: {error}")
                failures += 1
    print(f"{failures} failures")
    return int(failures > 0)


def compare(name: str, factor: float, scaling: str, folder: Path) -> int:
    """Solve one problem in all units; return the number of failures."""
    path, text = folder / f"{name}.py", text_in_units(name)
    path.write_text(text, encoding="utf-8")
    module, steps, failures = compiled(path), GALLERY[name].steps, 0
    own = module.solve(steps, scaling=scaling)
    print(
        f"{name:24s} N = {steps:3d}  {own.status:15s} cost {own.cost:<18.12g} {own.iterations:4d} iterations",
        flush=True,
    )
    for unit in UNITS:
        if unit not in module.metadata.parameters:  # nothing of the problem depends on it
            continue
        for value in (1.0 / factor, factor):
            solution = module.solve(steps, **{unit: value}, scaling=scaling)
            cost = solution.cost / cost_factor(name, **{unit: value})
            error = abs(cost - own.cost) / max(1e-3, abs(own.cost))
            ratio = solution.iterations / max(1, own.iterations)
            fails = solution.status != "solved" or error > 1e-8 or ratio > MOST
            failures += fails
            print(
                f"    {unit:11s} {value:7.0e}  {solution.status:15s} {error:8.1e} {solution.iterations:4d} "
                f"{ratio:5.2f}{'  FAILS' if fails else ''}",
                flush=True,
            )
    return failures + (own.status != "solved")


if __name__ == "__main__":
    sys.exit(main())
