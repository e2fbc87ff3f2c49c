"""Every figure, table, claim and erratum of the thesis, measured, for the page `docs/thesis.md`.

    python tests/benchmarks/thesis.py                  measure everything, and keep the values in docs/measured/
    python tests/benchmarks/thesis.py --only NAME ...  measure some entries, and keep their values
    python tests/benchmarks/thesis.py --list           print the names of the entries, with their commands

The entries are in `tests/thesis/`. Every command of an entry is run, in this process, and a value outside its limits
makes the exit status 1. All entries take 7 minutes of one processor the first time, when modules are built, and 2
minutes later.
"""

from __future__ import annotations

import os

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1"))
os.environ["MPLBACKEND"] = "Agg"

import argparse
import json
import math
import sys
import tempfile
import time
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from thesis import ENTRIES
from thesis.entries import ROOT, Entry, Row, Runs, every

SCRIPT = "python tests/benchmarks/thesis.py --only"
KEPT = ROOT / "docs" / "measured" / "thesis.json"


def measured(entry: Entry, folder: Path) -> tuple[list[Row], list[list[str]]]:
    """Return the rows of an entry, and for each of its commands the texts that were run."""
    runs = Runs(entry, folder)
    rows = list(every(entry.measure(runs)))
    assert all(runs.commands), f"{entry.name} does not run all of its commands"
    assert rows, f"{entry.name} has no value"
    return rows, runs.commands or [[f"{SCRIPT} {entry.name}"]]


def plain(row: Row) -> dict[str, Any]:
    """Return a row in the types of JSON, without limits that are infinite."""
    values = {"quantity": row.quantity, "there": row.there, "here": row.here, "low": row.low, "high": row.high}
    return {name: value for name, value in values.items() if not (isinstance(value, float) and math.isinf(value))}


def keep(values: dict[str, Any]) -> None:
    """Put values on record; entries that do not exist any more are dropped."""
    from codegen.machine import machine

    own = machine()
    names = ("codegen", "processor", "processors", "python", "numba", "numpy", "scipy", "sympy")
    before = json.loads(KEPT.read_text(encoding="utf-8"))["entries"] if KEPT.exists() else {}
    entries = {name: (before | values)[name] for name in ENTRIES if name in before | values}
    record = {"date": date.today().isoformat(), "machine": {name: own[name] for name in names}, "entries": entries}
    KEPT.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def main() -> int:
    """Measure the chosen entries, and return 1 if a value is outside its limits."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=list(ENTRIES), default=list(ENTRIES), metavar="NAME")
    parser.add_argument("--list", action="store_true", help="print names and commands")
    chosen = parser.parse_args()
    if chosen.list:
        for name in chosen.only:
            print(name, *ENTRIES[name].commands, sep="\n    ")
        return 0
    os.chdir(ROOT)
    values, failed = {}, 0
    with tempfile.TemporaryDirectory() as folder:
        for name in chosen.only:
            begin = time.process_time()
            rows, commands = measured(ENTRIES[name], Path(folder))
            seconds = time.process_time() - begin
            failed += sum(not row.holds for row in rows)
            values[name] = {
                "date": date.today().isoformat(), "seconds": round(seconds, 1),
                "commands": [{"last": texts[-1], "runs": len(texts)} for texts in commands],
                "rows": [plain(row) for row in rows],
            }  # fmt: skip
            print(f"{name} ({seconds:.1f} s)")
            for row in rows:
                mark = " " if row.holds else "!"
                limits = f"{row.low:.6g} .. {row.high:.6g}"
                print(f"  {mark} {row.quantity}: {row.here:.10g}   thesis: {row.there or '-'}   limits: {limits}")
            sys.stdout.flush()
    keep(values)
    print(f"{failed} values outside their limits")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
