"""Reports of problems: survey, build, measure missing cases, then write page, CSV and JSON; comparison of reports.

KINDS lists the measurements for each task, EXTRAS the experiments of the thesis on single problems. The JSON file of a
report contains the environment, the seeds, and a record for every case. A later report is compared with these records.

Sections about modules show times, sizes, omitted parts, and the savings against the general form. A module omits the
parts that its problem does not need. The general form is the same module with all parts.
"""

from __future__ import annotations

import ast
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from codegen.errors import ArgumentError, CodegenError
from codegen.evidence.report import building, optima, simulations, thesis
from codegen.evidence.report.building import MODULES, SURVEYS, Variant, Workshop, build_one, gather, survey_of, workers
from codegen.evidence.report.comparison import Measured
from codegen.evidence.report.optima import MOST_STEPS
from codegen.evidence.report.page import Section, Table, listed, number, page, seconds
from codegen.evidence.report.store import Case, Extent, Store, Values, section_of
from codegen.files import write_text
from codegen.machine import machine
from codegen.solving import api
from codegen.terminal import progress

if TYPE_CHECKING:
    from rich.table import Table as TerminalTable

PARTICLES = "particles"
_FORMS = {
    "simulate": (
        "inner stages and the state at the right node are all unknowns of Newton's method, with a dense Jacobian "
        "that is factored in every iteration."
    ),
    "control": (
        "the interior point method, the border of the linear system and curved ends are there, since one more "
        "parameter, which nothing reads, is free and bounded; controls stay in the linear system, and every entry of "
        "the Hessian is stored, also those that are zero. (With several phases the last two alone.)"
    ),
}


def general_forms(store: Store, problem: Path, variants: Sequence[Variant], extent: Extent) -> list[Variant]:
    """Return the general forms to build: none for particles, and none for modules with too many operations."""
    if (store.get(SURVEYS, problem.stem) or {}).get("form") == PARTICLES:
        return []
    shown = [(v, store.get(MODULES, v.case) or {}) for v in _shown(store, variants)]
    return [replace(v, general=True) for v, plain in shown if _operations(plain, 1) <= extent.general_operations]


def _shown(store: Store, variants: Sequence[Variant]) -> list[Variant]:
    """Return the variants that are shown in detail: the default, and the first explicit scheme of order 2 or more."""
    modules = {v: store.get(MODULES, v.case) or {} for v in variants}
    built = [v for v in variants if modules[v].get("status") == "built"]
    explicit = [v for v in built if v.order > 1 and modules[v].get("solver") == "explicit"]
    return list(dict.fromkeys([*built[:1], *explicit[:1]]))


def _operations(module: Values, column: int) -> int:
    """Return the number of operations of all kernels: for `column` 0 before, for 1 after, sharing subexpressions."""
    return sum(pair[column] for pair in module["operations"].values())


def _compared(workshop: Workshop, general: Variant, budget: float) -> Values:
    """Return status and seconds of a solve with both forms, and the relative difference of costs or final states."""
    modules = workshop.module(replace(general, general=False)), workshop.module(general)
    steps = min(MOST_STEPS, int(modules[0].metadata.steps))
    try:
        plain, other = (api.solve(module, steps=steps) for module in modules)
        times = [building.timed(building.solver(module, steps), budget).processor for module in modules]
    except CodegenError as error:
        return {"status": "refused", "message": str(error)}
    difference = None
    if plain.solved and other.solved:
        if plain.cost is not None and other.cost is not None:
            difference = float(abs(plain.cost - other.cost) / (abs(plain.cost) or 1.0))
        else:
            ends = [np.concatenate([np.ravel(r.q[-1]), np.ravel(r.p[-1])]) for r in (plain, other)]
            difference = float(np.abs(ends[1] - ends[0]).max() / (np.abs(ends[0]).max() or 1.0))
    return {
        "status": plain.status, "general status": other.status, "steps": steps, "seconds": times[0],
        "general seconds": times[1], "iterations": plain.iterations, "general iterations": other.iterations,
        "difference": difference,
    }  # fmt: skip


def modules_of(store: Store, variants: Sequence[Variant], title: str, omitted: Sequence[str]) -> Section:
    """Return the section with times, sizes and operations of modules, and the refused and the `omitted` schemes."""
    rows, refused = [], []
    for variant in variants:
        values = store.get(MODULES, variant.case)
        if values is None:
            continue
        if values["status"] != "built":
            refused.append(f"{variant.label} ({values['message']})")
            continue
        rows.append((
            variant.label, number(values["derivation seconds"]),
            number(values.get("compile processor seconds")), number(values["load seconds"]),
            str(values["lines"]), str(values["kernel lines"]), f"{values['bytes'] / 1024:.1f}",
            f"{_operations(values, 0)} → {_operations(values, 1)}", str(len(values["left out"])),
        ))  # fmt: skip
    head = ("module", "derive [s]", "compile [s]", "load [s]", "lines", "of these kernels", "KiB",
            "operations, before → after sharing", "parts not needed")  # fmt: skip
    texts = []
    if refused:
        texts.append("Schemes that do not apply: " + "; ".join(refused) + ".")
    if omitted:
        by_method: dict[str, list[str]] = {}
        for label in omitted:
            method, scheme = label.split(" ", 1)
            by_method.setdefault(method, []).append(scheme)
        schemes = "; ".join(f"{method} {listed(names)}" for method, names in by_method.items())
        texts.append(f"Not measured, to keep the report short: {schemes}.")
    table = Table(
        "Modules. Operations are those of one evaluation of every kernel. Two modules are made at a time, and what "
        "the build cache holds is not derived again; compiling is processor time.", head, tuple(rows),
    )  # fmt: skip
    return Section(title, tuple(texts), (table,) if rows else ())


def omissions(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """Return the section with the omitted parts of modules, their reasons, and a comparison with the general form."""
    survey, tables, answers = store.get(SURVEYS, problem.stem) or {}, list[Table](), list[str]()
    for variant in _shown(store, variants):
        plain, general = store.get(MODULES, variant.case) or {}, replace(variant, general=True)
        rows = tuple((part, reason) for part, _, reason in (line.partition(": ") for line in plain["left out"]))
        caption = f"Parts of the general solver that {variant.label} does not contain."
        tables.append(Table(caption, ("part", "why the problem does not need it"), rows, "words"))
        other, run = store.get(MODULES, general.case), store.get(section_of(problem, "general form"), general.label)
        if other is None or other["status"] != "built" or run is None:
            continue
        quantities: list[tuple[str, float | None, float | None, Callable[[float], str]]] = [
            ("lines", plain["lines"], other["lines"], str),
            ("of these kernels", plain["kernel lines"], other["kernel lines"], str),
            ("operations of all kernels", _operations(plain, 1), _operations(other, 1), str),
        ]
        derivation, compilation = "derivation processor seconds", "compile processor seconds"
        times = other.get(f"plain {derivation}"), other.get(f"general {derivation}")
        quantities.append(("derive", *times, seconds))
        quantities.append(("compile", plain.get(compilation), other.get(compilation), seconds))
        quantities.append(
            (f"solve on {run.get('steps')} steps", run.get("seconds"), run.get("general seconds"), seconds)
        )
        cells = []
        for name, a, b, written in quantities:
            ratio = number(b / a) if a and b is not None and math.isfinite(b) else "–"
            cells.append((name, *("–" if value is None else written(value) for value in (a, b)), ratio))
        caption = (
            f"{variant.label}: the module as it is, and the general form, which contains all parts. Deriving and "
            "compiling are processor time."
        )
        tables.append(Table(caption, ("", "as emitted", "general form", "ratio"), tuple(cells)))
        if run.get("difference") is None:
            reason = run.get("general status") or run.get("message")
            answers.append(f"The general form of {variant.label} does not give the answer: {reason}.")
        else:
            answers.append(
                f"The answer of {variant.label} differs by {number(run['difference'], 2)}, relatively, after "
                f"{run['general iterations']} iterations in place of {run['iterations']}."
            )
    if not tables:
        return []
    busy = (store.get(MODULES, variants[0].case) or {}).get("compile processor seconds")
    duration = "compiled before" if busy is None else f"{seconds(busy)} of processor time"
    text = (
        "The general form is not measured here: it has to be compiled as well, which takes at least as long as the "
        f"module itself ({duration}), too long for a page of all problems. A report on this "
        "problem alone has it."
    )
    if survey.get("form") == PARTICLES:
        text = "There is no general form of particles."
    if answers:
        text = f"In the general form {_FORMS[survey['task']]} {' '.join(answers)}"
    introduction = (
        "A module contains only the code that its problem needs. The tables list the parts of the general solver that "
        "are missing in the modules, and why."
    )
    return [Section(title, (introduction, text), tuple(tables))]


Row: TypeAlias = tuple[Any, ...]
"""The fields of a Variant after the problem: method, scheme, order, and perhaps the others."""


@dataclass(frozen=True)
class Kind:
    """The functions that measure and show problems of one task; `error` names the quantity whose error is measured.

    Cases that are `untimed` are measured side by side. They have to be independent of each other.
    """

    cases: Callable[[Path, Sequence[Variant], Workshop, Extent], Iterator[Case]]
    sections: Callable[[Store, Path, Sequence[Variant], str], list[Section]]
    measured: Callable[[Store, Path, Variant], Measured]
    error: str
    untimed: Callable[[Path, Sequence[Variant], Workshop, Extent], Iterable[Case]] = lambda *_: ()


KINDS = {
    "simulate": Kind(simulations.cases, simulations.sections, simulations.measured, "trajectory"),
    "control": Kind(optima.cases, optima.sections, optima.measured, "cost", optima.untimed),
}
"""The measurements by task; landmark registration is one of the EXTRAS."""


@dataclass(frozen=True)
class Extra:
    """An experiment of the thesis: `rows` of its modules (see Row), and functions for its cases and sections."""

    rows: Sequence[Row]
    cases: Callable[[Path, Sequence[Variant], Workshop, Extent], Iterator[Case]]
    sections: Callable[[Store, Path], list[Section]]

    def variants(self, problem: Path) -> list[Variant]:
        """Return the variants that the experiment needs."""
        return [Variant(problem, *row) for row in self.rows]


EXTRAS = {
    "pendulum": Extra(thesis.PENDULUM_ROWS, thesis.pendulum_cases, thesis.pendulum_sections),
    "linear_pendulum": Extra(thesis.LINEAR_ROWS, thesis.linear_pendulum_cases, thesis.linear_pendulum_sections),
    "orbital_transfer": Extra(thesis.ORBIT_ROWS, thesis.orbit_cases, thesis.orbit_sections),
    "image_registration": Extra((), thesis.landmark_cases, thesis.landmark_sections),  # the study builds its modules
    "hovercraft": Extra(thesis.HOVERCRAFT_ROWS, thesis.hovercraft_cases, thesis.hovercraft_sections),
}
"""The experiments by the name of the problem file."""


@dataclass(frozen=True)
class Chosen:
    """A problem with the variants that are measured, and the labels of the variants that are omitted."""

    problem: Path
    task: str
    variants: tuple[Variant, ...]
    omitted: tuple[str, ...]

    @property
    def extra(self) -> Extra | None:
        """Return the experiment of the thesis on the problem, or None."""
        return EXTRAS.get(self.problem.stem)

    def measured(self, store: Store) -> dict[Variant, Measured]:
        """Return the results of every variant."""
        return {v: KINDS[self.task].measured(store, self.problem, v) for v in self.variants}


def choose(problem: Path, store: Store, extent: Extent) -> Chosen:
    """Select the variants to measure: the default, the highest and the lowest order, then others up to the limit."""
    survey = store.get(SURVEYS, problem.stem) or {}
    task = survey.get("task", "")
    if task not in KINDS:
        return Chosen(problem, task, (), ())
    parts = {
        Variant(problem, method, scheme, order, controls=place): parts
        for method, scheme, order, _, place, parts in survey["schemes"]
    }
    rows = list(parts)
    most = extent.most_simulated if task == "simulate" else extent.most_schemes
    if survey["phases"] and extent.only_default_of_phases:
        most = 1
    usable = [v for v in rows if task == "simulate" or (v.order <= extent.most_order and parts[v] <= extent.most_parts)]
    lowest = min(usable, key=lambda v: (v.order, v.scheme != "explicit-euler"))
    highest = max(usable, key=lambda v: (v.order, v.method == rows[0].method, v.controls == "stages"))
    first = [rows[0], highest, lowest]
    kept = list(dict.fromkeys([*first, *usable]))[:most]
    omitted = tuple(v.label for v in rows if v not in kept)
    return Chosen(problem, task, tuple(v for v in rows if v in kept), omitted)


@dataclass(frozen=True)
class Report:
    """The path of the page, and the regressions against an earlier report."""

    page: Path
    regressions: tuple[Regression, ...] = ()


def run(problems: Sequence[Path], folder: Path, extent: Extent, earlier: Path | None = None) -> Report:
    """Measure every case that `folder` does not contain; write the report and compare it with the `earlier` report."""
    before = None if earlier is None else read_record(earlier)
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / ("quick.jsonl" if extent.quick else "measurements.jsonl"))
    workshop = Workshop(folder / "modules", store)
    with progress("", len(problems) + 2) as report_progress:
        with workers() as pool:
            surveys = (Case(SURVEYS, problem.stem, partial(survey_of, problem)) for problem in problems)
            gather(pool, store, surveys, lambda name: report_progress(0, f"reading {name}"))
            selection = [choose(problem, store, extent) for problem in problems]
            plain = [v for c in selection for v in (*c.variants, *(c.extra.variants(c.problem) if c.extra else ()))]
            general = (v for c in selection for v in general_forms(store, c.problem, c.variants, extent))
            groups: tuple[Iterable[Variant], ...] = (plain, general)  # sizes of plain modules select general forms
            for variants in groups:
                builds = (Case(MODULES, v.case, partial(build_one, v, workshop.folder)) for v in variants)
                gather(pool, store, builds, lambda name: report_progress(1, f"building {name}"))
            untimed = (
                case
                for c in selection
                if c.task in KINDS
                for case in KINDS[c.task].untimed(c.problem, c.variants, workshop, extent)
            )
            gather(pool, store, untimed, lambda name: report_progress(1, f"solving {name}"))
        for done, chosen in enumerate(selection):
            for case in _cases(chosen, workshop, extent):
                report_progress(done + 2, f"{chosen.problem.stem}: {case.name}")
                store.measured(case)
    record = record_of(selection, store, {**machine(), "quick": extent.quick})
    worse = () if before is None else compared(before, record)
    sections = [] if before is None else [comparison(worse, before, record)]
    if len(selection) > 1:
        sections.append(summary(selection, store))
    for chosen in selection:
        problem, name = chosen.problem, chosen.problem.stem
        survey = store.get(SURVEYS, name) or {}
        if chosen.task not in KINDS:
            if survey.get("status") == "refused" or chosen.extra is None:
                reason = survey.get("message") or f"problems with the task {chosen.task} are not measured"
                sections += [Section(f"{name}: not measured here", (reason,))]
            else:
                sections += chosen.extra.sections(store, problem)
        else:
            sections += [
                *KINDS[chosen.task].sections(store, problem, chosen.variants, f"{name}: {_title_of(problem)}"),
                *simulations.drift_section(store, problem, chosen.variants, f"{name}: energy in the long run"),
                *(chosen.extra.sections(store, problem) if chosen.extra else []),
                modules_of(store, chosen.variants, f"{name}: modules", chosen.omitted),
                *omissions(store, problem, chosen.variants, f"{name}: parts that its modules do not need"),
            ]
    title = "Problems, measured" if len(selection) > 1 else _title_of(selection[0].problem)
    introduction = "Every number was measured by the run that made this page; measurements.csv has all numbers."
    if extent.quick:
        introduction += " This is the quick form: few schemes, short ladders."
    path = folder / "index.html"
    write_text(folder / "measurements.csv", store.table())
    write_text(folder / NAME, json.dumps(record.plain(), indent=1) + "\n")
    write_text(path, page(title, introduction, sections, record.environment))
    return Report(path, tuple(worse))


def _cases(chosen: Chosen, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    if chosen.task in KINDS:
        yield from KINDS[chosen.task].cases(chosen.problem, chosen.variants, workshop, extent)
        if chosen.task == "simulate":
            yield from simulations.drift_cases(chosen.problem, chosen.variants, workshop, extent)
        for general in workshop.built(general_forms(workshop.store, chosen.problem, chosen.variants, extent)):
            compare = partial(_compared, workshop, general, extent.time_budget)
            yield Case(section_of(chosen.problem, "general form"), general.label, compare)
    if chosen.extra:
        yield from chosen.extra.cases(chosen.problem, chosen.extra.variants(chosen.problem), workshop, extent)


def _title_of(problem: Path) -> str:
    """Return the first paragraph of the docstring of a problem file."""
    text = ast.get_docstring(ast.parse(problem.read_bytes())) or problem.stem
    return text.split("\n\n")[0].replace("\n", " ").rstrip(".")


# ---- Summary of all problems ----


def summary(selection: Sequence[Chosen], store: Store) -> Section:
    """Return the section with a row for each problem, and with the number of schemes for each verdict on orders."""
    rows = tuple(_row(chosen, store) for chosen in selection)
    head = ("problem", "task", "schemes", "best order measured", "default N", "error at default N", "solve time there",
            "status there", "lines", "parts not needed")  # fmt: skip
    text = (
        "Errors are relative: of the trajectory for simulations, of the cost for optimal control. Default N is the "
        "ladder's number of steps that is next to the problem's own; error, time, status and lines are of the default "
        "scheme."
    )
    orders = []
    for task in KINDS:
        verdicts: dict[str, list[str]] = {}
        for chosen in (c for c in selection if c.task == task):
            for variant, measured in chosen.measured(store).items():
                if measured.rows:
                    name = f"{chosen.problem.stem} by {variant.label}"
                    verdicts.setdefault(measured.verdict or "as expected", []).append(name)
        for verdict, names in sorted(verdicts.items(), key=lambda item: -len(item[1])):
            orders.append((task, verdict, str(len(names)), "" if verdict == "as expected" else "; ".join(names)))
    caption = "Measured orders of every problem and scheme, beside those that are expected."
    tables = (Table("", head, rows), Table(caption, ("task", "order", "number", "which"), tuple(orders), "words"))
    return Section("All problems at a glance", (text,), tables)


def _row(chosen: Chosen, store: Store) -> tuple[str, ...]:
    name = chosen.problem.stem
    if chosen.task not in KINDS:
        refused = (store.get(SURVEYS, name) or {}).get("status") == "refused"
        return (name, chosen.task or "–", *["–"] * 5, "refused" if refused else "see its study below", "–", "–")
    measured = chosen.measured(store)
    orders = [(m.order.value, v.scheme) for v, m in measured.items() if m.order is not None]
    best = max(orders, key=lambda pair: pair[0], default=None)
    default = chosen.variants[0]
    module = store.get(MODULES, default.case) or {}
    count, lines = str(sum(bool(m.rows) for m in measured.values())), str(module.get("lines", "–"))
    best_order, omissions = f"{number(best[0])} ({best[1]})" if best else "–", str(len(module.get("left out", ())))
    rows = measured[default].rows
    if not rows:
        return (name, chosen.task, count, best_order, *["–"] * 3, module.get("status", "–"), lines, omissions)
    steps = module.get("steps") or 0
    row, error = min(zip(rows, measured[default].errors, strict=True), key=lambda pair: abs(pair[0]["steps"] - steps))
    return (
        name, chosen.task, count, best_order, str(row["steps"]), number(error, 2), seconds(row["seconds"]),
        row["status"], lines, omissions,
    )  # fmt: skip


# ---- Records, and their comparison ----

NAME = "report.json"
SEEDS = {"states at which conserved momenta are sought": "numpy default_rng(0)"}
ERROR_FACTOR, LEAST_ERROR = 2.0, 1e-11
"""An error is worse if it grew by more than this factor, and is larger than rounding errors can explain."""
TIME_FACTOR, LEAST_SECONDS = 2.0, 2e-3
"""A time is worse if it grew by more than this factor, and is longer than a busy machine can explain."""
ORDER_LOSS = 0.3  # an order is worse if it fell by more than this value
MORE_ITERATIONS, MORE_LINES = 1.1, 1.1
"""Iterations and lines are worse if they grew by more than these factors; one more iteration is accepted."""
_LOAD = "load of the machine when the page was made"


@dataclass(frozen=True)
class Record:
    """The environment of a report, and a dictionary of plain values for every case."""

    environment: Values
    cases: tuple[Values, ...]

    def plain(self) -> Values:
        """Return the record as plain values for JSON."""
        return {"environment": dict(self.environment), "cases": [dict(case) for case in self.cases]}


def record_of(selection: Sequence[Chosen], store: Store, environment: Values) -> Record:
    """Return the record of a report: status, error and time of solves, order and module size of schemes."""
    cases: list[Values] = []
    for chosen in (c for c in selection if c.task in KINDS):
        name = chosen.problem.stem
        for variant, measured in chosen.measured(store).items():
            module = store.get(MODULES, variant.case) or {}
            cases.append({
                "problem": name, "case": variant.label, "status": module.get("status"), "lines": module.get("lines"),
                "order": measured.order and measured.order.value, "stated order": variant.order,
                "expected order": measured.expected,
                "order verdict": measured.verdict if module.get("status") == "built" else "",
            })  # fmt: skip
            for values, error in zip(measured.rows, measured.errors, strict=True):
                cases.append({
                    "problem": name, "case": variant.run(values["steps"]), "status": values["status"],
                    "error": error, "error of": KINDS[chosen.task].error, "seconds": values["seconds"],
                    "iterations": values.get("iterations"),
                })  # fmt: skip
    return Record({**environment, "seeds": SEEDS}, tuple(cases))


def read_record(path: Path) -> Record:
    """Return the record of an earlier report by its JSON file or its folder; raise ArgumentError without a report."""
    file = path / NAME if path.is_dir() else path
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        cases = tuple({**row, "problem": row["problem"], "case": row["case"]} for row in content["cases"])
        return Record(content["environment"], cases)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ArgumentError(f"--compare {path}: no report is there", f"give a folder that holds {NAME}") from error


@dataclass(frozen=True)
class Regression:
    """A quantity of a case that became worse, with its values in both reports."""

    problem: str
    case: str
    what: str
    before: object
    after: object

    @property
    def decides(self) -> bool:
        """Return True if the regression is a failure; times depend on the load of the machine and only inform."""
        return self.what != "seconds"


def compared(before: Record, after: Record) -> list[Regression]:
    """Return the regressions between two reports; raise ArgumentError if the reports have no case in common."""
    if not _shared(before, after):
        raise ArgumentError("the two reports have no case in common", "compare reports of the same problems")
    return regressions(before.cases, after.cases)


def _shared(before: Record, after: Record) -> int:
    """Return the number of cases in both reports."""
    keys = [{(row["problem"], row["case"]) for row in record.cases} for record in (before, after)]
    return len(keys[0] & keys[1])


def regressions(before: Sequence[Values], after: Sequence[Values]) -> list[Regression]:
    """Return the quantities that are worse in `after`, for the cases that both sequences contain."""
    earlier = {(row["problem"], row["case"]): row for row in before}
    worse: list[Regression] = []
    for new in after:
        problem, case = new["problem"], new["case"]
        old = earlier.get((problem, case))
        if old is None:
            continue
        if old.get("status") in ("solved", "built") and new.get("status") != old["status"]:
            worse.append(Regression(problem, case, "status", old["status"], new.get("status")))
            continue
        for key, factor, least in (
            ("error", ERROR_FACTOR, LEAST_ERROR), ("seconds", TIME_FACTOR, LEAST_SECONDS),
            ("iterations", MORE_ITERATIONS, (old.get("iterations") or 0) + 1),
            ("lines", MORE_LINES, old.get("lines") or 0),
        ):  # fmt: skip
            one, other = old.get(key), new.get(key)
            if one is not None and other is not None and other > max(factor * one, least):
                worse.append(Regression(problem, case, key, one, other))
        one, other = old.get("order"), new.get("order")
        if one is not None and (other is None or other < one - ORDER_LOSS):
            worse.append(Regression(problem, case, "order", one, other))
    return worse


def comparison(worse: Sequence[Regression], before: Record, after: Record) -> Section:
    """Return the section on regressions against the earlier report."""
    text = (
        f"A case is worse if its error grew by more than a factor {ERROR_FACTOR:g} (and exceeds "
        f"{LEAST_ERROR:g}), its time by more than {TIME_FACTOR:g} (and exceeds "
        f"{1e3 * LEAST_SECONDS:g} ms), its order fell by more than {ORDER_LOSS:g}, its iterations or "
        f"the lines of its module grew by more than {MORE_ITERATIONS:g}, or it is no longer solved. Times "
        f"inform, the rest decides. {_shared(before, after)} cases are in both reports."
    )
    machines = [f"{r.environment.get('processor')}, load {r.environment.get(_LOAD)}" for r in (before, after)]
    times = f"Times were measured on {machines[0]} then, on {machines[1]} now; times of a busy machine prove little."

    def cell(value: object) -> str:
        return number(float(value)) if isinstance(value, (int, float)) else str(value or "none")

    rows = tuple((r.problem, r.case, r.what, cell(r.before), cell(r.after)) for r in worse)
    head = ("problem", "case", "what is worse", "before", "now")
    tables = (Table(f"{len(rows)} regressions.", head, rows),) if rows else ()
    title = "Compared with the earlier report: " + ("regressions" if rows else "nothing is worse")
    return Section(title, (text, times), tables)


def table_of(worse: Sequence[Regression]) -> TerminalTable:
    """Return the regressions as a table for a terminal; rich is imported here because its import is slow."""
    from rich.table import Table as TerminalTable

    table = TerminalTable(title="Worse than on record (times inform, the rest decides)", title_justify="left")
    for name in ("problem", "case", "what", "before", "now"):
        table.add_column(name, justify="right" if name in ("before", "now") else "left")
    for row in worse:
        values = (f"{v:.4g}" if isinstance(v, (int, float)) else str(v or "none") for v in (row.before, row.after))
        table.add_row(row.problem, row.case, row.what, *values)
    return table
