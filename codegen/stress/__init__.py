"""Stiff and extreme cases of every kind of problem, each with an expected outcome, and an honest verdict on each.

`families` holds the cases, as data; `pool` measures them in worker processes that can be killed; `classify` judges;
`page` shows. `codegen stress` is all of it. No sympy: what is stressed are generated modules.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from codegen.stress.cases import Case, Measurement, Row


def run(cases: Sequence[Case], folder: Path, advance: Callable[[], None] = lambda: None) -> list[Row]:
    """Measure and judge all cases, and write stress.csv and stress.html into a folder; `advance` is called for each."""
    from codegen.stress import page, pool
    from codegen.stress.classify import classify

    begin = time.perf_counter()

    def report(case: Case, measurement: Measurement) -> None:
        advance()

    measured = pool.run(cases, min(2, os.cpu_count() or 1), report)
    rows = [classify(case, measurement) for case, measurement in zip(cases, measured, strict=True)]
    folder.mkdir(parents=True, exist_ok=True)
    page.write_csv(rows, folder / "stress.csv")
    page.write_page(rows, time.perf_counter() - begin, folder / "stress.html")
    return rows
