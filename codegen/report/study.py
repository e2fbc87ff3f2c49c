"""The study of landmark registration from one command: measure what is missing, then write page, CSV and JSON."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path
from typing import Any

from codegen import __version__, output
from codegen.report import accuracy, ansatz, dimension, effort, jumps, paths, smoothness, sweeps
from codegen.report.progress import bar
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
    with bar(len(PARTS)) as told:
        for number, (name, cases) in enumerate(PARTS):
            for case in cases(settings, store):
                told(number, f"{name}: {case.name}")
                store.measured(case)
    from codegen.report.page import render

    written(folder / "measurements.csv", store.table())
    written(folder / "environment.json", json.dumps(environment(settings), indent=2) + "\n")
    page = folder / "index.html"
    written(page, render(settings, store, environment(settings)))
    return page


def written(path: Path, text: str) -> None:
    """Replace a file as a whole."""
    with output.replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def machine() -> dict[str, Any]:
    """Versions and processor."""
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
    }


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
