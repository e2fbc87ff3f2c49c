"""What stands first on a page of many problems: a table of all, and what became worse since an earlier report."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from codegen.report import compare
from codegen.report.building import MODULES, SURVEYS
from codegen.report.compare import Regression
from codegen.report.kinds import KINDS
from codegen.report.records import Record, shared
from codegen.report.section import Section, Table, number, seconds
from codegen.report.selection import Chosen
from codegen.report.store import Store

_LOAD = "load of the machine when the page was made"


def summary(selection: Sequence[Chosen], store: Store) -> Section:
    """One row for every problem."""
    rows = tuple(_row(chosen, store) for chosen in selection)
    head = ("problem", "task", "schemes", "best order measured", "default N", "error at default N", "solve time there",
            "status there", "lines", "parts left out")  # fmt: skip
    text = (
        "Errors are relative: of the trajectory for simulations, of the cost for optimal control. Default N is the "
        "ladder's number of steps that is next to the problem's own; error, time, status and lines are of the default "
        "scheme."
    )
    tables = (Table("", head, rows), _orders(selection, store))
    return Section("All problems at a glance", (text,), tables)


def _orders(selection: Sequence[Chosen], store: Store) -> Table:
    """How many pairs of a problem and a scheme have the expected order, and which do not."""
    rows = []
    for task, kind in KINDS.items():
        said: dict[str, list[str]] = {}
        for chosen in (c for c in selection if c.task == task):
            for variant in chosen.variants:
                if kind.rows(store, chosen.problem, variant):
                    verdict = kind.verdict(store, chosen.problem, variant) or "as expected"
                    said.setdefault(verdict, []).append(f"{chosen.problem.stem} by {variant.label}")
        for verdict, names in sorted(said.items(), key=lambda item: -len(item[1])):
            rows.append((task, verdict, str(len(names)), "" if verdict == "as expected" else "; ".join(names)))
    caption = "Measured orders of every problem and scheme, beside those that are expected."
    return Table(caption, ("task", "order", "number", "which"), tuple(rows), "words")


def _row(chosen: Chosen, store: Store) -> tuple[str, ...]:
    name = chosen.problem.stem
    if chosen.task not in KINDS:
        status = (store.get(SURVEYS, name) or {}).get("status")
        return (
            name,
            chosen.task or "–",
            *["–"] * 5,
            "refused" if status == "refused" else "see its study below",
            "–",
            "–",
        )
    kind = KINDS[chosen.task]
    orders = [(kind.order(store, chosen.problem, v), v) for v in chosen.variants]
    known = [(order.value, v) for order, v in orders if order is not None]
    best = max(known, key=lambda pair: pair[0], default=None)
    default = chosen.variants[0]
    made: Any = store.get(MODULES, default.case) or {}
    rows = kind.rows(store, chosen.problem, default)
    errors = kind.errors(store, chosen.problem, default)
    index = _next_to(made.get("steps"), [v["steps"] for v in rows])
    return (
        name,
        chosen.task,
        str(sum(bool(kind.rows(store, chosen.problem, v)) for v in chosen.variants)),
        f"{number(best[0])} ({best[1].scheme})" if best else "–",
        str(rows[index]["steps"]) if rows else "–",
        number(errors[index], 2) if rows else "–",
        seconds(rows[index]["seconds"]) if rows else "–",
        rows[index]["status"] if rows else made.get("status", "–"),
        str(made.get("lines", "–")),
        str(len(made.get("left out", ()))),
    )


def _next_to(own: int | None, steps: Sequence[int]) -> int:
    """The index of the number of steps that is closest to the problem's own."""
    return min(range(len(steps)), key=lambda i: abs(steps[i] - (own or 0)), default=0)


def comparison(worse: Sequence[Regression], before: Record, after: Record) -> Section:
    """Regressions, or that there are none."""
    text = (
        f"A case is worse if its error grew by more than a factor {compare.ERROR_FACTOR:g} (and exceeds "
        f"{compare.LEAST_ERROR:g}), its time by more than {compare.TIME_FACTOR:g} (and exceeds "
        f"{1e3 * compare.LEAST_SECONDS:g} ms), its order fell by more than {compare.ORDER_LOSS:g}, its iterations or "
        f"the lines of its module grew by more than {compare.MORE_ITERATIONS:g}, or it is no longer solved. Times "
        f"inform, the rest decides. {shared(before, after)} cases are in both reports."
    )
    machines = [f"{r.environment.get('processor')}, load {r.environment.get(_LOAD)}" for r in (before, after)]
    machine = f"Times were measured on {machines[0]} then, on {machines[1]} now; times of a busy machine prove little."
    rows = tuple((r.problem, r.case, r.what, _value(r.before), _value(r.after)) for r in worse)
    head = ("problem", "case", "what is worse", "before", "now")
    tables = (Table(f"{len(rows)} regressions.", head, rows),) if rows else ()
    return Section(
        "Compared with the earlier report: " + ("regressions" if rows else "nothing is worse"), (text, machine), tables
    )


def _value(value: Any) -> str:
    return number(float(value)) if isinstance(value, (int, float)) else str(value or "none")
