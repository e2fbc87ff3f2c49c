"""The registry of reports: what is measured of a task and of a problem, by which schemes, and what the thesis adds."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from codegen.evidence.report import control_sections as sections_control
from codegen.evidence.report import optima, simulations, thesis
from codegen.evidence.report import simulation_sections as sections_simulation
from codegen.evidence.report.building import SURVEYS, Variant, Workshop
from codegen.evidence.report.orders import Order
from codegen.evidence.report.page import Section
from codegen.evidence.report.settings import Extent
from codegen.evidence.report.store import Case, Store, Values


@dataclass(frozen=True)
class Kind:
    """A task: cases, sections; a scheme's rows by growing N, their errors, measured and expected order, verdict."""

    cases: Callable[[Path, Sequence[Variant], Workshop, Extent], Iterator[Case]]
    sections: Callable[[Store, Path, Sequence[Variant], str], list[Section]]
    rows: Callable[[Store, Path, Variant], list[Values]]
    errors: Callable[[Store, Path, Variant], list[float | None]]
    order: Callable[[Store, Path, Variant], Order | None]
    expected: Callable[[Store, Path, Variant], int]
    verdict: Callable[[Store, Path, Variant], str]
    error: str


KINDS = {
    "simulate": Kind(
        simulations.cases, sections_simulation.sections, sections_simulation.rows_of, sections_simulation.errors,
        sections_simulation.order_of, sections_simulation.expected_order, sections_simulation.verdict_of,
        "trajectory",
    ),
    "control": Kind(
        optima.cases, sections_control.sections, sections_control.rows_of, sections_control.errors,
        sections_control.order_of, sections_control.expected_order, sections_control.verdict_of, "cost",
    ),
}  # fmt: skip
"""Kinds of problems by task; landmark registration is studied apart from them, as one of the extras."""


@dataclass(frozen=True)
class Extra:
    """An experiment of the thesis: further modules, further cases, further sections."""

    variants: Callable[[Path], list[Variant]]
    cases: Callable[[Path, Workshop, Extent], Iterator[Case]]
    sections: Callable[[Store, Path], list[Section]]


EXTRAS = {
    "pendulum": Extra(thesis.pendulum_variants, thesis.pendulum_cases, thesis.pendulum_sections),
    "linear_pendulum": Extra(
        thesis.linear_pendulum_variants, thesis.linear_pendulum_cases, thesis.linear_pendulum_sections
    ),
    "orbital_transfer": Extra(thesis.orbit_variants, thesis.orbit_cases, thesis.orbit_sections),
    "image_registration": Extra(thesis.landmark_variants, thesis.landmark_cases, thesis.landmark_sections),
    "hovercraft": Extra(thesis.hovercraft_variants, thesis.hovercraft_cases, thesis.hovercraft_sections),
}
"""Experiments by the names of problem files."""


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
