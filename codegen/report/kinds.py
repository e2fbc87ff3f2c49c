"""The registry of reports: what is measured of a task, and what the thesis adds to some problems."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from codegen.report.building import Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.measure import optima, simulations
from codegen.report.measure.orders import Order
from codegen.report.section import Section
from codegen.report.sections import control as sections_control
from codegen.report.sections import simulation as sections_simulation
from codegen.report.store import Case, Store, Values
from codegen.report.thesis import (
    craft as thesis_craft,
)
from codegen.report.thesis import (
    landmarks as thesis_landmarks,
)
from codegen.report.thesis import (
    linear as thesis_linear,
)
from codegen.report.thesis import (
    orbit as thesis_orbit,
)
from codegen.report.thesis import (
    pendulum as thesis_pendulum,
)


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
    "pendulum": Extra(thesis_pendulum.variants, thesis_pendulum.cases, thesis_pendulum.sections),
    "linear_pendulum": Extra(thesis_linear.variants, thesis_linear.cases, thesis_linear.sections),
    "orbital_transfer": Extra(thesis_orbit.variants, thesis_orbit.cases, thesis_orbit.sections),
    "image_registration": Extra(thesis_landmarks.variants, thesis_landmarks.cases, thesis_landmarks.sections),
    "hovercraft": Extra(thesis_craft.variants, thesis_craft.cases, thesis_craft.sections),
}
"""Experiments by the names of problem files."""
