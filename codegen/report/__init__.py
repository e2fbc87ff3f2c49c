"""Reports: everything that is measured about a problem, on one page; for now the study of landmark registration."""

from __future__ import annotations

from pathlib import Path

from codegen.errors import ArgumentError, ProblemFileError

STUDIES = ("image_registration",)
"""Problem files, by their names, that have a report."""


def report(problem: Path, folder: Path, quick: bool = False, limit: float | None = None) -> Path:
    """Measure what `folder` lacks and write the page, a CSV and a JSON there; return the path of the page.

    A route is taken no further once a single solve takes more than `limit` seconds. Raises ArgumentError for a problem
    that has no report yet, ProblemFileError if there is no such file.
    """
    if not problem.is_file():
        raise ProblemFileError(f"{problem}: no such file", "give the path of a problem file")
    if problem.stem not in STUDIES:
        raise ArgumentError(
            f"{problem} has no report yet", f"there is one for problems/{STUDIES[0]}.py only; use solve or check"
        )
    from dataclasses import replace

    from codegen.report.settings import Settings, quick_settings
    from codegen.report.study import run

    settings = quick_settings(problem) if quick else Settings(problem)
    return run(settings if limit is None else replace(settings, limit=limit), folder)
