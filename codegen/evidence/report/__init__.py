"""Reports: everything that is measured about problems, on one page."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from codegen.errors import ArgumentError, ProblemFileError

if TYPE_CHECKING:
    from codegen.evidence.report.gallery import Report

STUDIES = ("image_registration",)
"""Problem files, by their names, that have a study of their own."""


def report(problem: Path, folder: Path, quick: bool = False, limit: float | None = None) -> Path:
    """The study of landmark registration: measure what `folder` lacks, write page, CSV and JSON; return the page.

    A route is taken no further once a single solve takes more than `limit` seconds. Raises ArgumentError for a problem
    that has no study, ProblemFileError if there is no such file.
    """
    if not problem.is_file():
        raise ProblemFileError(f"{problem}: no such file", "give the path of a problem file")
    if problem.stem not in STUDIES:
        raise ArgumentError(f"{problem} has no study", f"there is one for problems/{STUDIES[0]}.py only")
    from dataclasses import replace

    from codegen.evidence.report.landmark_study import run
    from codegen.evidence.report.store import Settings, quick_settings

    settings = quick_settings(problem) if quick else Settings(problem)
    return run(settings if limit is None else replace(settings, limit=limit), folder)


def problems_report(
    problem: Path | None,
    folder: Path,
    *,
    everything: bool = False,
    quick: bool = False,
    limit: float | None = None,
    earlier: Path | None = None,
) -> Report:
    """Report on one problem, or on all of a folder (default: ./problems); compare with an earlier report if given.

    Raises ArgumentError for an unusable choice, ProblemFileError if there is no such file.
    """
    from codegen.evidence.report.gallery import Report, run

    if not everything and problem is not None and problem.stem in STUDIES:
        if earlier is not None:
            raise ArgumentError("the study of landmarks is not compared", "leave --compare out")
        return Report(report(problem, folder, quick, limit))
    from dataclasses import replace

    from codegen.evidence.report.store import FULL, GALLERY, QUICK, QUICK_PROBLEMS

    extent = QUICK if quick else GALLERY if everything else FULL
    chosen = [_one(problem)] if not everything else _all(Path("problems") if problem is None else problem)
    if everything and quick:
        chosen = [path for path in chosen if path.stem in QUICK_PROBLEMS] or chosen[:3]
    return run(chosen, folder, extent if limit is None else replace(extent, limit=limit), earlier)


def _one(problem: Path | None) -> Path:
    if problem is None:
        raise ArgumentError("no problem was given", "give the path of a problem file, or --all")
    if not problem.is_file():
        raise ProblemFileError(f"{problem}: no such file", "give the path of a problem file")
    return problem


def _all(folder: Path) -> list[Path]:
    found = sorted(path for path in folder.glob("*.py") if not path.name.startswith("_"))
    if not found:
        raise ArgumentError(f"{folder} holds no problem files", "give a folder that does, or none for ./problems")
    return found
