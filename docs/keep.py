"""Put measurements on record for the page on benchmarks, with machine and date.

    python docs/keep.py report DIR           what `codegen report PROBLEM.py --out DIR` has measured
    python docs/keep.py stress DIR           what `codegen stress --all --out DIR` has found
    python docs/keep.py robustness CSV ...   rows of `tests/benchmarks/robustness.py`; one of a later file counts

`docs/_extensions/benchmarks.py` draws and lists what lies in `docs/measured/`, and measures nothing. The machine is the
one that runs this, but for a report, which says its own; the date is that of the files.
"""

from __future__ import annotations

import csv
import json
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import date
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from codegen.machine import machine

MEASURED = Path(__file__).resolve().parent / "measured"
_LOAD = "load of the machine when the page was made"


def write(name: str, record: dict[str, Any]) -> None:
    """Write a record."""
    MEASURED.mkdir(exist_ok=True)
    (MEASURED / f"{name}.json").write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def dated(paths: Iterable[Path]) -> dict[str, Any]:
    """The last day on which some files were written, and the machine."""
    day = max(date.fromtimestamp(path.stat().st_mtime) for path in paths).isoformat()
    own = machine()
    names = ("codegen", "processor", "processors", "python", "numba", "numpy", "scipy")
    return {"date": day, "machine": {name: own[name] for name in names}}


def report(folder: Path) -> None:
    """Errors and times of every scheme and driver of a problem."""
    path = folder / "report.json"
    read = json.loads(path.read_text(encoding="utf-8"))
    (problem,) = {case["problem"] for case in read["cases"]}
    own = read["environment"]
    wanted = ("case", "status", "error", "error of", "seconds")
    cases = [
        {key: case[key] for key in wanted} for case in read["cases"] if case.get("error") and "; N " in case["case"]
    ]
    orders = [
        {"case": case["case"], "order": case["order"], "stated order": case["stated order"]}
        for case in read["cases"]
        if case.get("order") is not None
    ]
    known = {**dated([path]), "load": own[_LOAD], "quick": own["quick"]}
    write(f"report_{problem}", {**known, "problem": problem, "cases": cases, "orders": orders})


def stress(folder: Path) -> None:
    """How many cases of each family had which outcome."""
    path = folder / "stress.csv"
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    outcomes = Counter((row["family"], row["outcome"] if row["passed"] == "True" else "failed") for row in rows)
    counts = [{"family": family, "outcome": outcome, "cases": n} for (family, outcome), n in outcomes.items()]
    write("stress", {**dated([path]), "counts": counts})


def robustness(paths: Sequence[Path]) -> None:
    """Shares of guesses that are solved, by the generated solver and by IPOPT, of the cases that have both."""
    found: dict[tuple[str, str, str], dict[str, Any]] = {}
    for path in paths:
        with path.open(encoding="utf-8", newline="") as file:
            for row in csv.DictReader(file):
                own = found.setdefault((row["collection"], row["problem"], row["steps"]), {})
                numbers = {"solved": float(row["solved"]), "best": float(row["best"]), "false": int(row["false"])}
                own[row["solver"]] = {"guesses": int(row["guesses"]), **numbers}
    cases = [
        {"collection": collection, "problem": problem, "steps": int(steps), "solvers": solvers}
        for (collection, problem, steps), solvers in found.items()
        if set(solvers) == {"generated", "IPOPT"}
    ]
    write("robustness", {**dated(paths), "cases": cases})


def main() -> None:
    """Keep what is named."""
    kind, *places = sys.argv[1:] or [""]
    paths = [Path(place) for place in places]
    if kind == "robustness" and paths:
        robustness(paths)
    elif kind in ("report", "stress") and len(paths) == 1:
        {"report": report, "stress": stress}[kind](paths[0])
    else:
        raise SystemExit(__doc__)


if __name__ == "__main__":
    main()
