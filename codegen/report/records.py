"""The JSON of a report: environment, seeds, and a flat record for every case."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.errors import ArgumentError
from codegen.report.building import MODULES
from codegen.report.compare import Regression, regressions
from codegen.report.kinds import KINDS
from codegen.report.selection import Chosen
from codegen.report.store import Store

NAME = "report.json"
SEEDS = {"states at which conserved momenta are sought": "numpy default_rng(0)"}


@dataclass(frozen=True)
class Record:
    """What a later report is compared with."""

    environment: Mapping[str, Any]
    cases: tuple[Mapping[str, Any], ...]

    def plain(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"environment": dict(self.environment), "cases": [dict(case) for case in self.cases]}


def record(selection: Sequence[Chosen], store: Store, environment: Mapping[str, Any]) -> Record:
    """Every run with its status, error and seconds, every scheme with its order and the size of its module."""
    cases = tuple(row for chosen in selection if chosen.task in KINDS for row in _cases(chosen, store))
    return Record({**environment, "seeds": SEEDS}, cases)


def _cases(chosen: Chosen, store: Store) -> Iterator[dict[str, Any]]:
    kind, name = KINDS[chosen.task], chosen.problem.stem
    for variant in chosen.variants:
        made, order = store.get(MODULES, variant.case) or {}, kind.order(store, chosen.problem, variant)
        expected = kind.expected(store, chosen.problem, variant)
        yield {
            "problem": name, "case": variant.label, "status": made.get("status"), "lines": made.get("lines"),
            "order": order and order.value, "stated order": variant.order, "expected order": expected,
            "order verdict": kind.verdict(store, chosen.problem, variant) if made.get("status") == "built" else "",
        }  # fmt: skip
        rows = kind.rows(store, chosen.problem, variant)
        for values, error in zip(rows, kind.errors(store, chosen.problem, variant), strict=True):
            yield {
                "problem": name, "case": f"{variant.label}; N {values['steps']}", "status": values["status"],
                "error": error, "error of": kind.error, "seconds": values["seconds"],
                "iterations": values.get("iterations"),
            }  # fmt: skip


def read(path: Path) -> Record:
    """An earlier report, by its JSON or its folder; ArgumentError if it is none."""
    file = path / NAME if path.is_dir() else path
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        cases = tuple({**row, "problem": row["problem"], "case": row["case"]} for row in found["cases"])
        return Record(found["environment"], cases)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArgumentError(f"--compare {path}: no report is there", f"give a folder that holds {NAME}") from error


def compared(before: Record, after: Record) -> list[Regression]:
    """What became worse; ArgumentError if the reports have no case in common."""
    if not shared(before, after):
        raise ArgumentError("the two reports have no case in common", "compare reports of the same problems")
    return regressions(before.cases, after.cases)


def shared(before: Record, after: Record) -> int:
    """The number of cases that both reports have."""
    keys = [{(row["problem"], row["case"]) for row in record.cases} for record in (before, after)]
    return len(keys[0] & keys[1])
