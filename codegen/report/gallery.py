"""Reports of problems: survey, build, measure what is missing, then write page, CSV and JSON."""

from __future__ import annotations

import ast
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from codegen.files import write_text
from codegen.machine import machine
from codegen.report import overview, records
from codegen.report.building import SURVEYS, Variant, Workshop, build_all, surveyed, workers
from codegen.report.compare import Regression
from codegen.report.extent import Extent
from codegen.report.kinds import EXTRAS, KINDS
from codegen.report.measure import drift, leaving_out
from codegen.report.page import page
from codegen.report.section import Section
from codegen.report.sections.modules import modules
from codegen.report.selection import Chosen, choose
from codegen.report.store import Store
from codegen.terminal import progress

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
    sections = [] if before is None else [overview.comparison(worse, before, record)]
    if len(selection) > 1:
        sections.append(overview.summary(selection, store))
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
