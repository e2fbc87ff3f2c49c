"""The page: sections from the store, rendered into one HTML file that needs no other."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from codegen.files import rendered
from codegen.report.section import Section
from codegen.report.sections.questions import sections as of_questions
from codegen.report.sections.thesis import sections as of_thesis
from codegen.report.settings import Settings
from codegen.report.store import Store

_TITLE = "Geodesic interpolating splines: the thesis's chapter 5 and its open questions, measured"
_INTRODUCTION = (
    "Landmarks in the unit disc move by H = ½ Σ pᵢ·pⱼ G(qᵢ, qⱼ), G being the Green's function of the clamped plate, "
    "from given places to given places. Every number on this page was measured by the run that made it; sentences take "
    "their numbers, and what they claim, from these measurements. All of them are in measurements.csv beside this page."
)


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


def page(title: str, introduction: str, sections: Sequence[Section], environment: Mapping[str, Any]) -> str:
    """One HTML file that needs no other, from any sections."""
    template, named = Path(__file__).parent / "templates/page.html.j2", [*_flat(environment)]
    return rendered(template, title=title, introduction=introduction, sections=sections, environment=named)


def _flat(environment: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Names and values, of records inside the record as well."""
    for name, value in environment.items():
        if isinstance(value, Mapping):
            yield from ((f"{name}, {inner}", entry) for inner, entry in value.items())
        else:
            yield name, value
