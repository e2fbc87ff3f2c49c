"""What a problem's module leaves out, and what that saves: beside it the general form, which leaves nothing out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from codegen.errors import CodegenError
from codegen.evidence.report.building import MODULES, SURVEYS, Variant, Workshop
from codegen.evidence.report.optima import MOST_STEPS, well_timed
from codegen.evidence.report.page import Section, Table, number, seconds
from codegen.evidence.report.settings import Extent
from codegen.evidence.report.store import Case, Store, Values

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


def section_of(problem: Path) -> str:
    """The section of the store that compares the two forms."""
    return f"{problem.stem}: general form"


def wanted(store: Store, problem: Path, variants: Sequence[Variant], extent: Extent) -> list[Variant]:
    """General forms to be made: none for particles, nor where that takes too long for the extent."""
    if (store.get(SURVEYS, problem.stem) or {}).get("form") == PARTICLES:
        return []
    shown = [(v, store.get(MODULES, v.case) or {}) for v in _shown(store, variants)]
    return [replace(v, general=True) for v, made in shown if _operations(made) <= extent.general_operations]


def _shown(store: Store, variants: Sequence[Variant]) -> list[Variant]:
    """The default scheme, and beside it, where that is implicit, the first explicit one of order 2 or more."""
    built = [v for v in variants if (store.get(MODULES, v.case) or {}).get("status") == "built"]
    explicit = [v for v in built if v.order > 1 and (store.get(MODULES, v.case) or {}).get("solver") == "explicit"]
    return list(dict.fromkeys([*built[:1], *explicit[:1]]))


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Both forms on the problem's own number of steps."""
    for general in workshop.built(wanted(workshop.store, problem, variants, extent)):
        yield Case(section_of(problem), general.label, lambda g=general: _compared(workshop, g, extent.repeat))  # type: ignore[misc]


def _compared(workshop: Workshop, general: Variant, repeat: int) -> Values:
    """Status and seconds of a solve by either form, and how far the answers are apart."""
    modules = workshop.module(replace(general, general=False)), workshop.module(general)
    steps = min(MOST_STEPS, int(modules[0].metadata.steps))
    try:
        own, other = (well_timed(module, "newton", repeat, steps=steps) for module in modules)
    except CodegenError as error:
        return {"status": "refused", "message": str(error)}
    return {
        "status": own.status, "general status": other.status, "steps": steps, "seconds": own.seconds_solve,
        "general seconds": other.seconds_solve, "iterations": own.iterations, "general iterations": other.iterations,
        "difference": _difference(own, other),
    }  # fmt: skip


def _difference(own: Any, other: Any) -> float | None:
    """Of costs, or of the last positions and momenta by their size where nothing is optimised; relative."""
    if not (own.solved and other.solved):
        return None
    if own.cost is not None:
        return float(abs(own.cost - other.cost) / (abs(own.cost) or 1.0))
    ends = [np.concatenate([np.ravel(result.q[-1]), np.ravel(result.p[-1])]) for result in (own, other)]
    return float(np.abs(ends[1] - ends[0]).max() / (np.abs(ends[0]).max() or 1.0))


def section(store: Store, problem: Path, variants: Sequence[Variant], title: str) -> list[Section]:
    """What modules omit and why, and a table of the two forms of each module that was made in both."""
    survey, tables, answers = store.get(SURVEYS, problem.stem) or {}, list[Table](), list[str]()
    for variant in _shown(store, variants):
        made, general = store.get(MODULES, variant.case) or {}, replace(variant, general=True)
        tables.append(_omissions(variant, made["left out"]))
        other, run = store.get(MODULES, general.case), store.get(section_of(problem), general.label)
        if other is not None and other["status"] == "built" and run is not None:
            tables.append(_table(variant, made, other, run))
            answers.append(_answer(variant, run))
    if not tables:
        return []
    text = (
        "The general form is not measured here: it has to be compiled as well, which takes at least as long as the "
        f"module itself ({_compilation(store, variants)}), too long for a page of all problems. A report on this "
        "problem alone has it."
    )
    if survey.get("form") == PARTICLES:
        text = "There is no general form of particles."
    if answers:
        text = f"In the general form {_FORMS[survey['task']]} {' '.join(answers)}"
    return [Section(title, (text,), tuple(tables))]


def _compilation(store: Store, variants: Sequence[Variant]) -> str:
    made = store.get(MODULES, variants[0].case) or {}
    known = made.get("compile processor seconds")
    return "compiled before" if known is None else f"{seconds(known)} of processor time"


def _omissions(variant: Variant, left: Sequence[str]) -> Table:
    rows = tuple((what, why) for what, _, why in (line.partition(": ") for line in left))
    return Table(f"Left out of {variant.label}, because the problem does not need it.", ("what", "why"), rows, "words")


def _answer(variant: Variant, run: Values) -> str:
    """How the answer of the general form compares."""
    if run.get("difference") is None:
        return f"That of {variant.label} does not give the answer: {run.get('general status') or run.get('message')}."
    return (
        f"The answer of {variant.label} differs by {number(run['difference'], 2)}, relatively, after "
        f"{run['general iterations']} iterations in place of {run['iterations']}."
    )


def _table(variant: Variant, made: Values, other: Values, run: Values) -> Table:
    pairs: list[tuple[Any, ...]] = [
        ("lines", made["lines"], other["lines"], str),
        ("of these kernels", made["kernel lines"], other["kernel lines"], str),
        ("operations of all kernels", _operations(made), _operations(other), str),
        ("derive", *(other.get(f"{form} derivation processor seconds") for form in ("plain", "general")), seconds),
        ("compile", *(m.get("compile processor seconds") for m in (made, other)), seconds),
        (f"solve on {run.get('steps')} steps", run.get("seconds"), run.get("general seconds"), seconds),
    ]
    rows = tuple((name, *("–" if v is None else show(v) for v in (a, b)), _ratio(a, b)) for name, a, b, show in pairs)
    caption = (
        f"{variant.label}: the module as it is, and the form that leaves nothing out. Deriving and compiling "
        "are processor time."
    )
    return Table(caption, ("", "as emitted", "general form", "ratio"), rows)


def _ratio(one: float | None, other: float | None) -> str:
    return number(other / one) if one and other is not None and math.isfinite(other) else "–"


def _operations(made: Values) -> int:
    return sum(pair[1] for pair in made["operations"].values())
