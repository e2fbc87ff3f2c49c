"""What a problem's module leaves out, and what that saves: beside it the general form, which leaves nothing out."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from codegen.errors import CodegenError
from codegen.report.building import MODULES, SURVEYS, Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.optima import MOST_STEPS, well_timed
from codegen.report.section import Section, Table, number, seconds
from codegen.report.store import Case, Store, Values

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
    """The general form of the default scheme, unless it takes too long to make for this extent, or there is none."""
    if not variants or (store.get(SURVEYS, problem.stem) or {}).get("form") == PARTICLES:
        return []
    made = store.get(MODULES, variants[0].case) or {}
    if made.get("status") != "built" or _operations(made) > extent.general_operations:
        return []
    return [replace(variants[0], general=True)]


def cases(problem: Path, variants: Sequence[Variant], workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """Both forms on the problem's own number of steps."""
    for general in workshop.built(wanted(workshop.store, problem, variants, extent)):
        yield Case(section_of(problem), general.label, lambda g=general: _compared(workshop, g, extent.repeat))  # type: ignore[misc]


def _compared(workshop: Workshop, general: Variant, repeat: int) -> Values:
    """Status and seconds of a solve by either form, and how far the answers are apart."""
    modules = workshop.module(replace(general, general=False)), workshop.module(general)
    steps = min(MOST_STEPS, int(modules[0].metadata["steps"]))
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
    """What the default module omits in words, and the table of the two forms where both were made."""
    made = store.get(MODULES, variants[0].case) or {} if variants else {}
    if made.get("status") != "built":
        return []
    left = made["left out"]
    texts = [f"Left out of {variants[0].label}, because the problem does not need it: " + "; ".join(left) + "."]
    survey = store.get(SURVEYS, problem.stem) or {}
    general = replace(variants[0], general=True)
    other, run = store.get(MODULES, general.case), store.get(section_of(problem), general.label)
    if other is None or other["status"] != "built" or run is None:
        why = (
            "particles have none"
            if survey.get("form") == PARTICLES
            else "only a whole report on this problem alone has it"
        )
        texts.append(f"The general form is not measured here: {why}.")
        return [Section(title, tuple(texts))]
    texts.append(f"In the general form {_FORMS[survey['task']]} {_answers(run)}")
    return [Section(title, tuple(texts), (_table(made, other, run),))]


def _answers(run: Values) -> str:
    if run.get("difference") is None:
        return f"It does not give the answer: {run.get('general status') or run.get('message')}."
    return (
        f"Its answer differs by {number(run['difference'], 2)}, relatively, and took {run['general iterations']} "
        f"iterations in place of {run['iterations']}."
    )


def _table(made: Values, other: Values, run: Values) -> Table:
    pairs: list[tuple[str, Any, Any, Callable[[Any], str]]] = [
        ("lines", made["lines"], other["lines"], str),
        ("of these kernels", made["kernel lines"], other["kernel lines"], str),
        ("operations of all kernels", _operations(made), _operations(other), str),
        ("derive", made["derivation seconds"], other["derivation seconds"], seconds),
        ("compile", made["compile seconds"], other["compile seconds"], seconds),
        (f"solve on {run.get('steps')} steps", run.get("seconds"), run.get("general seconds"), seconds),
    ]
    rows = tuple((name, *("–" if v is None else show(v) for v in (a, b)), _ratio(a, b)) for name, a, b, show in pairs)
    caption = "The module as it is, and the form that leaves nothing out. Times of making them depend on what else ran."
    return Table(caption, ("", "as emitted", "general form", "ratio"), rows)


def _ratio(one: float | None, other: float | None) -> str:
    return number(other / one) if one and other is not None and math.isfinite(other) else "–"


def _operations(made: Values) -> int:
    """Operations of one evaluation of every kernel, after common subexpressions are shared."""
    return sum(pair[1] for pair in made["operations"].values())
