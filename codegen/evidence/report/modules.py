"""Sections about the modules of a problem: times, sizes, omitted parts, and the savings against the general form.

A module omits the parts that its problem does not need. The general form is the same module with all parts.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report import timing
from codegen.evidence.report.building import MODULES, SURVEYS, Variant, Workshop
from codegen.evidence.report.optima import MOST_STEPS
from codegen.evidence.report.page import Section, Table, listed, number, seconds
from codegen.evidence.report.store import Case, Extent, Store, Values, section_of
from codegen.solving import api

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


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Yield a case for each general form: the comparison of its solve with the plain module's solve."""
    for general in workshop.built(general_forms(workshop.store, problem, variants, extent)):
        yield Case(
            section_of(problem, "general form"),
            general.label,
            partial(_compared, workshop, general, extent.time_budget),
        )


def _compared(workshop: Workshop, general: Variant, budget: float) -> Values:
    """Return status and seconds of a solve with both forms, and the relative difference of costs or final states."""
    modules = workshop.module(replace(general, general=False)), workshop.module(general)
    steps = min(MOST_STEPS, int(modules[0].metadata.steps))
    try:
        plain, other = (api.solve(module, steps=steps) for module in modules)
        times = [timing.timed(timing.solver(module, steps), budget).processor for module in modules]
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


def modules(store: Store, variants: Sequence[Variant], title: str, omitted: Sequence[str]) -> Section:
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
