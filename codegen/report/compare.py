"""Two reports beside each other: what became worse."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

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
