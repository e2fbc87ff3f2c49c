"""Registration by landmarks (inventory G1 to G4 and F1) on a page of many problems: the study, on a short leash."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from codegen.report import page, study
from codegen.report.building import Variant, Workshop
from codegen.report.extent import Extent
from codegen.report.section import Section
from codegen.report.settings import Settings
from codegen.report.store import Case, Store


def variants(problem: Path) -> list[Variant]:
    """None: the study makes its modules when it needs them, of several schemes, methods and kernels."""
    del problem
    return []


def cases(problem: Path, workshop: Workshop, extent: Extent) -> Iterator[Case]:
    """What the study measures; no route goes further than single solves of `extent.limit` seconds."""
    settings = Settings(problem, limit=extent.limit)
    for _, part in study.PARTS:
        yield from part(settings, workshop.store)


def sections(store: Store, problem: Path) -> list[Section]:
    """The thesis's tables and figures, and its open questions."""
    return page.of_study(Settings(problem), store)
