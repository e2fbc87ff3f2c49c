"""The figures of the gallery that are on record for each version, comparison and --update.

    python tests/figures.py [--update] [PROBLEM ...]

Every problem of the gallery is solved by its module with default options. `tests/figures/VERSION.json`, in the form of
a report's `report.json`, holds status, cost, iterations, lines of the module and the least seconds of three warm
solves. What is worse than on record is printed as a table; times depend on the machine, which the file names, and
inform, all else ends in exit status 1. `error` is the relative distance of the cost from that on record, so that it is
zero there. Builds are kept in the folder that CODEGEN_TEST_CACHE or CODEGEN_CACHE_DIR names.
"""

import os

# Before numpy loads its BLAS: more threads only slow small matrices down.
os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
if "CODEGEN_TEST_CACHE" in os.environ:
    os.environ["CODEGEN_CACHE_DIR"] = os.environ["CODEGEN_TEST_CACHE"]

import argparse
import json
import sys
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from golden import GALLERY, ROOT

import codegen
from codegen.emit.naming import module_name
from codegen.evidence.report import gallery
from codegen.evidence.report.store import few_landmarks, smooth_pair
from codegen.machine import machine
from codegen.solving import api
from codegen.solving.compiler import build
from codegen.solving.loading import load
from codegen.terminal import console

FOLDER = ROOT / "tests" / "figures"
RECORD = FOLDER / f"{codegen.__version__.partition('.dev')[0]}.json"
WARM_SOLVES = 3
Row = dict[str, Any]


def measured(problems: Collection[str] = ()) -> list[Row]:
    """One row for every module of the gallery."""
    rows = []
    for problem, arguments, choices in GALLERY:
        if problems and problem not in problems:
            continue
        path = ROOT / "problems" / f"{problem}.py"
        built = build(path, arguments, method=choices.method, scheme=choices.scheme)
        rows.append({"problem": problem, "case": module_name(path, arguments, choices), **solved(built.path)})
    return rows


def solved(path: Path) -> Row:
    """Figures of one module, solved with default options; a registration connects five landmarks."""
    module, points = load(path), None
    if module.metadata.task == "connect":
        points = few_landmarks(5) if len(module.metadata.coordinates) == 2 else smooth_pair(5, 3)
    result = api.solve(module, repeat=WARM_SOLVES, points=points)
    return {
        "status": result.status,
        "cost": getattr(result, "cost", None),
        "iterations": getattr(result, "iterations", None),
        "lines": len(path.read_text(encoding="utf-8").splitlines()),
        "seconds": result.seconds_solve,
    }


def with_errors(rows: list[Row], before: Collection[Mapping[str, Any]]) -> list[Row]:
    """The rows with the relative distance of each cost from the one on record, where there is one."""
    known = {(row["problem"], row["case"]): row.get("cost") for row in before}
    for row in rows:
        cost, old = row["cost"], known.get((row["problem"], row["case"]))
        row["error"] = 0.0 if cost is None or old is None else abs(cost - old) / max(1.0, abs(old))
    return rows


def main() -> int:
    """Compare with what is on record, or put it on record."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problems", nargs="*", metavar="PROBLEM", help="names of problems, all by default")
    parser.add_argument("--update", action="store_true", help="put the figures on record")
    arguments = parser.parse_args()
    known = {problem for problem, _, _ in GALLERY}
    if unknown := [name for name in arguments.problems if name not in known]:
        parser.error(f"{', '.join(unknown)} is not in the gallery: {', '.join(sorted(known))}")
    rows = measured(arguments.problems)
    if arguments.update:
        FOLDER.mkdir(exist_ok=True)
        RECORD.write_text(as_json(gallery.Record(machine(), tuple(with_errors(rows, ())))))
        return 0
    on_record = sorted(FOLDER.glob("*.json"), key=lambda path: [int(part) for part in path.stem.split(".")])
    if not on_record:
        sys.exit("no figures are on record; --update puts them there")
    before = gallery.read_record(RECORD if RECORD in on_record else on_record[-1])
    worse = gallery.regressions(before.cases, with_errors(rows, before.cases))
    told = console()
    told.print(f"{len(rows)} modules of the gallery, compared with those on record: {len(worse)} figures are worse")
    if worse:
        told.print(gallery.table_of(worse))
    return int(any(row.decides for row in worse))


def as_json(record: gallery.Record) -> str:
    """One line for each case, so that a change shows."""
    plain = record.plain()
    lines = ",\n".join("  " + json.dumps(case) for case in plain["cases"])
    return f'{{"environment": {json.dumps(plain["environment"], indent=1)},\n "cases": [\n{lines}\n]}}\n'


if __name__ == "__main__":
    sys.exit(main())
