"""Stiff and extreme cases of every kind of problem, each with an expected outcome and a verdict.

`families` and `motions` contain the cases as data. `pool` measures them by `measure` in worker processes that can be
killed. `cases.classify` gives the verdicts, and `page` shows them. `codegen stress` runs all of these.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from codegen.evidence.stress.cases import Case, Row


def run(cases: Sequence[Case], folder: Path, report_progress: Callable[[int, str], None]) -> list[Row]:
    """Measure and judge all cases, write stress.csv and stress.html into a folder, and return the rows.

    `report_progress` is called with the number of finished cases and the name of the last finished case.
    """
    from codegen.evidence.stress import page, pool
    from codegen.evidence.stress.cases import classify

    begin, done = time.perf_counter(), count(1)
    workers = min(2, os.cpu_count() or 1)
    measured = pool.run(cases, workers, lambda case, _: report_progress(next(done), case.name))
    rows = [classify(case, measurement) for case, measurement in zip(cases, measured, strict=True)]
    rows = [row for row in rows if row.case.truth is None or not row.measurement.refusal]  # schemes that do not apply
    folder.mkdir(parents=True, exist_ok=True)
    page.write_csv(rows, folder / "stress.csv")
    page.write_page(rows, time.perf_counter() - begin, folder / "stress.html")
    return rows
