"""Reports of problems: survey, build, measure what is missing, then write page, CSV and JSON."""

from __future__ import annotations

import ast
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.evidence.report import drift, leaving_out, records
from codegen.evidence.report.building import MODULES, SURVEYS, Variant, Workshop, build_all, surveyed, workers
from codegen.evidence.report.kinds import EXTRAS, KINDS, Chosen, choose
from codegen.evidence.report.page import Section, Table, listed, number, page, seconds
from codegen.evidence.report.records import Record, Regression, shared
from codegen.evidence.report.settings import Extent
from codegen.evidence.report.store import Store
from codegen.files import write_text
from codegen.machine import machine
from codegen.terminal import progress

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
    return min(range(len(steps)), key=lambda i: abs(steps[i] - (own or 0)), default=0)


def comparison(worse: Sequence[Regression], before: Record, after: Record) -> Section:
    """Regressions, or that there are none."""
    text = (
        f"A case is worse if its error grew by more than a factor {records.ERROR_FACTOR:g} (and exceeds "
        f"{records.LEAST_ERROR:g}), its time by more than {records.TIME_FACTOR:g} (and exceeds "
        f"{1e3 * records.LEAST_SECONDS:g} ms), its order fell by more than {records.ORDER_LOSS:g}, its iterations or "
        f"the lines of its module grew by more than {records.MORE_ITERATIONS:g}, or it is no longer solved. Times "
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


def modules(store: Store, variants: Sequence[Variant], title: str, left: Sequence[str] = ()) -> Section:
    """Times and sizes of every module, operations of its kernels, and refusals."""
    rows, refused = [], []
    for variant in variants:
        values = store.get(MODULES, variant.case)
        if values is None:
            continue
        if values["status"] != "built":
            refused.append(f"{variant.label} ({values['message']})")
            continue
        before, after = (sum(pair[i] for pair in values["operations"].values()) for i in (0, 1))
        rows.append((
            variant.label, number(values["derivation seconds"]),
            number(values.get("compile processor seconds")), number(values["load seconds"]),
            str(values["lines"]), str(values["kernel lines"]), f"{values['bytes'] / 1024:.1f}",
            f"{before} → {after}", str(len(values["left out"])),
        ))  # fmt: skip
    head = ("module", "derive [s]", "compile [s]", "load [s]", "lines", "of these kernels", "KiB",
            "operations, before → after sharing", "parts left out")  # fmt: skip
    texts = []
    if refused:
        texts.append("Schemes that do not apply: " + "; ".join(refused) + ".")
    if left:
        texts.append(f"Not measured, to keep the report short: {_by_method(left)}.")
    table = Table(
        "Modules. Operations are those of one evaluation of every kernel. Two modules are made at a time, and what "
        "the build cache holds is not derived again; compiling is processor time.", head, tuple(rows),
    )  # fmt: skip
    return Section(title, tuple(texts), (table,) if rows else ())


def _by_method(labels: Sequence[str]) -> str:
    """Schemes after the name of their method."""
    groups: dict[str, list[str]] = {}
    for label in labels:
        method, scheme = label.split(" ", 1)
        groups.setdefault(method, []).append(scheme)
    return "; ".join(f"{method} {listed(schemes)}" for method, schemes in groups.items())


_INTRODUCTION = (
    "Every number was measured by the run that made this page; all of them are in measurements.csv beside it. "
    "A scheme has one colour in all figures. Run times are of one solve with warm machine code, the least of a few."
)


@dataclass(frozen=True)
class Report:
    """The page, and what became worse since an earlier report."""

    page: Path
    regressions: tuple[Regression, ...] = ()


def run(problems: Sequence[Path], folder: Path, extent: Extent, earlier: Path | None = None) -> Report:
    """Measure every case that `folder` does not hold yet; compare with an earlier report if there is one."""
    before = None if earlier is None else records.read(earlier)
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / ("quick.jsonl" if extent.quick else "measurements.jsonl"))
    workshop = Workshop(folder / "modules", store)
    with progress("", len(problems) + 2) as report_progress:
        with workers() as pool:
            surveyed(pool, store, problems, lambda name: report_progress(0, f"reading {name}"))
            selection = [choose(problem, store, extent) for problem in problems]
            wanted = {v.case: v for chosen in selection for v in (*chosen.variants, *_extra_variants(chosen.problem))}
            build_all(pool, workshop, wanted.values(), lambda name: report_progress(1, f"building {name}"))
            forms = [v for c in selection for v in leaving_out.wanted(store, c.problem, c.variants, extent)]
            build_all(pool, workshop, forms, lambda name: report_progress(1, f"building {name}"))
        for done, chosen in enumerate(selection):
            for case in _cases(chosen, workshop, extent):
                report_progress(done + 2, f"{chosen.problem.stem}: {case.name}")
                store.measured(case)
    return _written(selection, store, folder, extent, before)


def _extra_variants(problem: Path) -> list[Variant]:
    return EXTRAS[problem.stem].variants(problem) if problem.stem in EXTRAS else []


def _cases(chosen: Chosen, workshop: Workshop, extent: Extent) -> Any:
    if chosen.task in KINDS:
        yield from KINDS[chosen.task].cases(chosen.problem, chosen.variants, workshop, extent)
        if chosen.task == "simulate":
            yield from drift.cases(chosen.problem, chosen.variants, workshop, extent)
        yield from leaving_out.cases(chosen.problem, chosen.variants, workshop, extent)
    if chosen.problem.stem in EXTRAS:
        yield from EXTRAS[chosen.problem.stem].cases(chosen.problem, workshop, extent)


def _written(
    selection: Sequence[Chosen], store: Store, folder: Path, extent: Extent, before: records.Record | None
) -> Report:
    """Page, CSV and JSON."""
    record = records.record(selection, store, {**machine(), "quick": extent.quick})
    worse = () if before is None else records.compared(before, record)
    sections = [] if before is None else [comparison(worse, before, record)]
    if len(selection) > 1:
        sections.append(summary(selection, store))
    for chosen in selection:
        sections += _sections(chosen, store)
    title = "Problems, measured" if len(selection) > 1 else title_of(selection[0].problem)
    introduction = _INTRODUCTION + (" This is the quick form: few schemes, short ladders." if extent.quick else "")
    path = folder / "index.html"
    write_text(folder / "measurements.csv", store.table())
    write_text(folder / "report.json", json.dumps(record.plain(), indent=1) + "\n")
    write_text(path, page(title, introduction, sections, record.environment))
    return Report(path, tuple(worse))


def _sections(chosen: Chosen, store: Store) -> list[Section]:
    problem, name = chosen.problem, chosen.problem.stem
    survey = store.get(SURVEYS, name) or {}
    if chosen.task not in KINDS:
        if survey.get("status") == "refused" or name not in EXTRAS:
            reason = survey.get("message") or f"problems with the task {chosen.task} are not measured"
            return [Section(f"{name}: not measured here", (reason,))]
        return EXTRAS[name].sections(store, problem)
    found = KINDS[chosen.task].sections(store, problem, chosen.variants, f"{name}: {title_of(problem)}")
    found += drift.section(store, problem, chosen.variants, f"{name}: energy in the long run")
    if name in EXTRAS:
        found += EXTRAS[name].sections(store, problem)
    found.append(modules(store, chosen.variants, f"{name}: modules", chosen.left))
    return found + leaving_out.section(store, problem, chosen.variants, f"{name}: what is left out")


def title_of(problem: Path) -> str:
    """The first sentence of a problem file."""
    text = ast.get_docstring(ast.parse(problem.read_bytes())) or problem.stem
    return text.split("\n\n")[0].replace("\n", " ").rstrip(".")
