"""Registration by landmarks (inventory G1 to G4 and F1) on a page of many problems: the study in its quick form."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from codegen.report import page, study
from codegen.report.building import Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.section import Section
from codegen.report.settings import quick_settings
from codegen.report.store import Case, Store


def variants(problem: Path) -> list[Variant]:
    """None: the study makes its modules when it needs them, of several schemes, methods and kernels."""
    del problem
    return []


def cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """What the quick form of the study measures, whatever the extent: the whole one takes longer than all the rest."""
    del extent
    for _, part in study.PARTS:
        yield from part(quick_settings(problem), workshop.store)


def sections(store: Store, problem: Path) -> list[Section]:
    """The thesis's tables and figures of one set of few landmarks and of the trilobites."""
    reason = f"One set of few landmarks, fast routes, no open questions: codegen report {problem.name} has them all."
    return [Section(f"{problem.stem}: landmarks", (reason,)), *page.of_study(quick_settings(problem), store)]
