"""Which schemes are measured on a problem, of those that its survey lists."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from codegen.report.building import SURVEYS, Variant
from codegen.report.extent import Extent
from codegen.report.kinds import KINDS
from codegen.report.store import Store


@dataclass(frozen=True)
class Chosen:
    """A problem with the variants that are measured, and the names of schemes that are left out."""

    problem: Path
    task: str
    variants: tuple[Variant, ...]
    left: tuple[str, ...]


def choose(problem: Path, store: Store, extent: Extent) -> Chosen:
    """The schemes to be measured: the default, those of highest and lowest order, then the rest, up to the cap."""
    survey = store.get(SURVEYS, problem.stem) or {}
    task = survey.get("task", "")
    if task not in KINDS:
        return Chosen(problem, task, (), ())
    rows = [Variant(problem, method, scheme, order) for method, scheme, order, _ in survey["schemes"]]
    cap = extent.most_simulated if task == "simulate" else extent.most_schemes
    if survey["phases"] and extent.only_default_of_phases:
        cap = 1
    usable = [v for v in rows if task == "simulate" or v.order <= extent.most_order]
    lowest = min(usable, key=lambda v: (v.order, v.scheme != "explicit-euler"))
    first = [rows[0], max(usable, key=lambda v: (v.order, v.method == rows[0].method)), lowest]
    kept = list(dict.fromkeys([*first, *usable]))[:cap]
    left = tuple(v.label for v in rows if v not in kept)
    return Chosen(problem, task, tuple(v for v in rows if v in kept), left)
