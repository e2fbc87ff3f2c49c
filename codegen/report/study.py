"""The study of landmark registration from one command: measure what is missing, then write page, CSV and JSON."""

from __future__ import annotations

import json
import os
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import metadata
from pathlib import Path
from typing import Any

from codegen import __version__, output
from codegen.report import accuracy, ansatz, dimension, effort, jumps, paths, smoothness, sweeps
from codegen.report.settings import Settings
from codegen.report.store import Case, Store

PARTS: tuple[tuple[str, Callable[[Settings, Store], Iterator[Case]]], ...] = (
    ("accuracy", accuracy.cases),
    ("routes", sweeps.cases),
    ("initial paths", paths.cases),
    ("midpoint", effort.cases),
    ("dimension", dimension.cases),
    ("smoothness", smoothness.cases),
    ("weak solution", ansatz.cases),
    ("jumps", jumps.cases),
)
"""Parts of the study in the order in which they are measured."""


def run(settings: Settings, folder: Path) -> Path:
    """Measure every case that `folder` does not hold yet; return the page, beside which are the CSV and the JSON."""
    folder.mkdir(parents=True, exist_ok=True)
    store = Store(folder / ("quick.jsonl" if settings.quick else "measurements.jsonl"))
    with _progress() as told:
        for number, (name, cases) in enumerate(PARTS):
            for case in cases(settings, store):
                told(number, f"{name}: {case.name}")
                store.measured(case)
    from codegen.report.page import render

    _write(folder / "measurements.csv", store.table())
    _write(folder / "environment.json", json.dumps(environment(settings), indent=2) + "\n")
    page = folder / "index.html"
    _write(page, render(settings, store, environment(settings)))
    return page


def _write(path: Path, text: str) -> None:
    with output.replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def environment(settings: Settings) -> dict[str, Any]:
    """Where the study ran and what it drew at random."""
    packages = ("numpy", "scipy", "numba", "sympy", "matplotlib")
    return {
        "codegen": __version__,
        "python": platform.python_version(),
        **{name: metadata.version(name) for name in packages},
        "machine": platform.machine(),
        "processor": _processor(),
        "processors": _processors(),
        "system": platform.system(),
        "load of the machine when the page was made": _load(),
        "problem": settings.problem.name,
        "quick": settings.quick,
        "seconds allowed for one solve before a route goes no further": settings.limit,
        "seeds": {
            "few landmarks": "numpy default_rng(nc)",
            "smooth displacements": "numpy default_rng(1)",
            "test functions": "numpy default_rng(5)",
        },
    }


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _processors() -> int:
    return os.cpu_count() or 1


def _load() -> float | None:
    """Processes that wanted a processor over the last quarter of an hour: other work makes measured times longer."""
    return round(os.getloadavg()[2], 1) if hasattr(os, "getloadavg") else None


@contextmanager
def _progress() -> Iterator[Callable[[int, str], None]]:
    """A bar over the parts on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        yield lambda number, text: None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        BarColumn(),
        TextColumn("{task.completed:.0f}/{task.total:.0f}"),
        TimeElapsedColumn(),
        TextColumn("{task.description}"),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task("", total=len(PARTS))
        yield lambda number, text: progress.update(task, completed=number, description=text)
