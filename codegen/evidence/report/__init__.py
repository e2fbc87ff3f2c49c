"""Reports: one HTML page with all measurements of a problem, or of all problems in a folder.

"The thesis" treats symplectic integrators in optimal control and image registration; reports repeat its experiments.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from codegen.errors import ArgumentError, ProblemFileError

if TYPE_CHECKING:
    from codegen.evidence.report.gallery import Report

STUDIES = ("image_registration",)
"""The names of problem files whose report is a special study, without sections for every problem."""


def problems_report(
    problem: Path | None,
    folder: Path,
    *,
    everything: bool = False,
    quick: bool = False,
    limit: float | None = None,
    earlier: Path | None = None,
) -> Report:
    """Write the report on a problem or on a folder of problems; return its path and regressions.

    Parameters
    ----------
    problem
        The problem file. With `everything` it is a folder of problem files, by default ./problems.
    folder
        The folder of the page, the CSV, the JSON and the measurements. Measured cases are not repeated.
    everything
        Report on all problems of a folder.
    quick
        Measure a few cases only.
    limit
        Seconds of one solve, after which a scheme is not solved on finer grids; None keeps the default.
    earlier
        The JSON file or the folder of an earlier report, which is compared with the new report.

    Raises
    ------
    ArgumentError
        The choice of problems cannot be used, or no comparison with an earlier report is possible.
    ProblemFileError
        The problem file does not exist.
    """
    if not everything:
        if problem is None:
            raise ArgumentError("no problem was given", "give the path of a problem file, or --all")
        if not problem.is_file():
            raise ProblemFileError(f"{problem}: no such file", "give the path of a problem file")
    from codegen.evidence.report import gallery, store

    if not everything and problem is not None and problem.stem in STUDIES:
        if earlier is not None:
            raise ArgumentError("the study of landmarks is not compared", "leave --compare out")
        from codegen.evidence.report import landmark_study

        settings = store.quick_settings(problem) if quick else store.Settings(problem)
        settings = settings if limit is None else replace(settings, limit=limit)
        return gallery.Report(landmark_study.run(settings, folder))
    extent = store.QUICK if quick else store.GALLERY if everything else store.FULL
    extent = extent if limit is None else replace(extent, limit=limit)
    problems = [] if problem is None else [problem]
    if everything:
        source = Path("problems") if problem is None else problem
        problems = sorted(path for path in source.glob("*.py") if not path.name.startswith("_"))
        if not problems:
            raise ArgumentError(f"{source} holds no problem files", "give a folder that does, or none for ./problems")
        if quick:
            problems = [path for path in problems if path.stem in store.QUICK_PROBLEMS] or problems[:3]
    return gallery.run(problems, folder, extent, earlier)
