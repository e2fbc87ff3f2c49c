"""The study of landmark registration from one command: measure what is missing, then write page, CSV and JSON."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from codegen.evidence.report import landmark_effort, landmark_motion
from codegen.evidence.report.landmark_questions import sections as of_questions
from codegen.evidence.report.landmark_tables import sections as of_thesis
from codegen.evidence.report.page import Section, page
from codegen.evidence.report.settings import Settings
from codegen.evidence.report.store import Case, Store
from codegen.files import write_text
from codegen.machine import machine
from codegen.terminal import progress

PARTS: tuple[tuple[str, Callable[[Settings, Store], Iterator[Case]]], ...] = (
    ("accuracy", landmark_effort.accuracy_cases),
    ("routes", landmark_effort.route_cases),
    ("fastest", landmark_effort.fastest_cases),
    ("initial paths", landmark_motion.path_cases),
    ("midpoint", landmark_effort.midpoint_cases),
    ("dimension", landmark_effort.dimension_cases),
    ("smoothness", landmark_motion.smoothness_cases),
    ("weak solution", landmark_effort.weak_solution_cases),
    ("jumps", landmark_motion.jump_cases),
)
"""Parts of the study in the order in which they are measured."""

_TITLE = "Geodesic interpolating splines: the thesis's chapter 5 and its open questions, measured"
_INTRODUCTION = (
    "Landmarks in the unit disc move by H = ½ Σ pᵢ·pⱼ G(qᵢ, qⱼ), G being the Green's function of the clamped plate, "
    "from given places to given places. Every number on this page was measured by the run that made it; sentences take "
    "their numbers, and what they claim, from these measurements. All of them are in measurements.csv beside this page."
)


def run(settings: Settings, folder: Path) -> Path:
    """Measure every case that `folder` does not hold yet; return the page, beside which are the CSV and the JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / ("quick.jsonl" if settings.quick else "measurements.jsonl"))
    with progress("", len(PARTS)) as moved:
        for number, (name, cases) in enumerate(PARTS):
            for case in cases(settings, store):
                moved(number, f"{name}: {case.name}")
                store.measured(case)
    write_text(folder / "measurements.csv", store.table())
    write_text(folder / "environment.json", json.dumps(environment(settings), indent=2) + "\n")
    path = folder / "index.html"
    write_text(path, render(settings, store, environment(settings)))
    return path


def environment(settings: Settings) -> dict[str, Any]:
    """Where the study ran and what it drew at random."""
    return {
        **machine(),
        "problem": settings.problem.name,
        "quick": settings.quick,
        "seconds allowed for one solve before a route goes no further": settings.limit,
        "seeds": {
            "few landmarks": "numpy default_rng(nc)",
            "smooth displacements": "numpy default_rng(1)",
            "test functions": "numpy default_rng(5)",
        },
    }


def render(settings: Settings, store: Store, environment: Mapping[str, Any]) -> str:
    """The text of the page."""
    introduction = _INTRODUCTION
    if settings.quick:
        introduction += (
            " This is the quick form: one set of landmarks, three numbers of steps, the fast routes, no open questions."
        )
    return page(_TITLE, introduction, of_study(settings, store), environment)


def of_study(settings: Settings, store: Store) -> list[Section]:
    """The sections of the study of landmark registration."""
    return of_thesis(settings, store) + ([] if settings.quick else of_questions(settings, store))
