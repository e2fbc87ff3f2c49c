"""The JSON of a report: environment, seeds, and a flat record for every case."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.errors import ArgumentError
from codegen.evidence.report.building import MODULES
from codegen.evidence.report.kinds import KINDS, Chosen
from codegen.evidence.report.store import Store

ERROR_FACTOR, LEAST_ERROR = 2.0, 1e-11
"""An error is worse if it grew by more than this factor, and is larger than rounding explains."""
TIME_FACTOR, LEAST_SECONDS = 2.0, 2e-3
"""A time is worse if it grew by more than this factor, and is longer than a busy machine explains."""
ORDER_LOSS = 0.3
"""An order is worse if it fell by more than this."""
MORE_ITERATIONS, MORE_LINES = 1.1, 1.1
"""Iterations, of which one more is none, and lines of a module are worse if they grew by more than these factors."""


@dataclass(frozen=True)
class Regression:
    """A case that became worse: in what, and from what to what."""

    problem: str
    case: str
    what: str
    before: Any
    after: Any

    @property
    def decides(self) -> bool:
        """Whether it is a failure by itself: times depend on what else the machine does, and inform."""
        return self.what != "seconds"


def regressions(before: Sequence[Mapping[str, Any]], after: Sequence[Mapping[str, Any]]) -> list[Regression]:
    """What is worse in `after`; cases are flat records with problem and case, those in only one report are left out."""
    known = {(row["problem"], row["case"]): row for row in before}
    found: list[Regression] = []
    for row in after:
        old = known.get((row["problem"], row["case"]))
        if old is not None:
            found += [Regression(row["problem"], row["case"], *change) for change in _worse(old, row)]
    return found


def _worse(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    if old.get("status") in ("solved", "built") and new.get("status") != old["status"]:
        yield "status", old["status"], new.get("status")
        return
    for key, factor, least in (("error", ERROR_FACTOR, LEAST_ERROR), ("seconds", TIME_FACTOR, LEAST_SECONDS)):
        one, other = old.get(key), new.get(key)
        if one is not None and other is not None and other > max(factor * one, least):
            yield key, one, other
    for key, factor, slack in (("iterations", MORE_ITERATIONS, 1), ("lines", MORE_LINES, 0)):
        one, other = old.get(key), new.get(key)
        if one is not None and other is not None and other > max(factor * one, one + slack):
            yield key, one, other
    one, other = old.get("order"), new.get("order")
    if one is not None and (other is None or other < one - ORDER_LOSS):
        yield "order", one, other


def table_of(worse: Sequence[Regression]) -> Any:
    """What became worse as a table for a terminal (of rich, which takes long to import)."""
    from rich.table import Table

    table = Table(title="Worse than on record (times inform, the rest decides)", title_justify="left")
    for name in ("problem", "case", "what", "before", "now"):
        table.add_column(name, justify="right" if name in ("before", "now") else "left")
    for row in worse:
        values = (f"{v:.4g}" if isinstance(v, (int, float)) else str(v or "none") for v in (row.before, row.after))
        table.add_row(row.problem, row.case, row.what, *values)
    return table


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
