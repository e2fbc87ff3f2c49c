"""Defects planted in the stages of a build, and the checks that find them.

    python tests/benchmarks/mutants.py [--stage reading ...] [--only NUMBER ...] [--csv FILE]

Each defect of `tests/mutated_package.py` is planted alone, in a new process. A table shows the first check that finds
it, and the time from the import of the package to this check. The exit status is 1 if a defect survives all checks.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from mutated_package import MUTANTS, Stage, outcomes
from rich.console import Console
from rich.table import Table


def main() -> int:
    """Plant all chosen defects, and return 1 if one survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stage", nargs="+", choices=list(Stage), default=list(Stage))
    parser.add_argument("--only", nargs="+", type=int, help="numbers of defects")
    parser.add_argument("--csv", type=Path, help="write the rows to this file as well")
    chosen = parser.parse_args()
    screen, table = Console(), Table("", "stage", "defect", "problem", "found by", "s")
    numbers = chosen.only if chosen.only is not None else range(len(MUTANTS))
    numbers = [number for number in numbers if MUTANTS[number].stage in chosen.stage]
    rows, survivors, finders = [], list[str](), Counter[str]()
    for number in numbers:
        mutant, (outcome,) = MUTANTS[number], outcomes([number])
        finders[outcome.caught_by] += 1
        if not outcome.caught_by:
            survivors.append(mutant.what)
        found = outcome.caught_by or "NOTHING"
        problem = " ".join(part for part in (mutant.problem, mutant.scheme, mutant.method) if part)
        rows.append([number, mutant.stage, mutant.what, problem, found, f"{outcome.seconds:.1f}", outcome.text])
        table.add_row(*map(str, rows[-1][:6]), style="" if outcome.caught_by else "bold red")
        print(*rows[-1][:6], sep=" | ", file=sys.stderr, flush=True)
    screen.print(table)
    screen.print(f"{len(numbers) - len(survivors)} of {len(numbers)} defects found")
    screen.print("; ".join(f"{name or 'nothing'} finds {count}" for name, count in finders.most_common()))
    if chosen.csv:
        with chosen.csv.open("w", newline="", encoding="utf-8") as file:
            csv.writer(file).writerows(rows)
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
