"""What a page of measurements says of the machine and the versions that it was made with."""

from __future__ import annotations

import os
import platform
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

from codegen import __version__

_PACKAGES = ("numpy", "scipy", "numba", "sympy", "matplotlib")


def machine() -> dict[str, Any]:
    """Versions, processor and present load by name."""
    return {
        **versions(),
        "machine": platform.machine(),
        "processor": _processor(),
        "processors": os.cpu_count() or 1,
        "system": platform.system(),
        "load of the machine when the page was made": _load(),
    }


def versions() -> dict[str, str]:
    """The versions of codegen, Python and the packages that decide about numbers and times."""
    return {"codegen": __version__, "python": platform.python_version(), **dict(_packages())}


@cache
def _packages() -> tuple[tuple[str, str], ...]:
    """Versions of packages, whose files take longer to read than some sweeps to solve."""
    return tuple((name, metadata.version(name)) for name in _PACKAGES)


def _processor() -> str:
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").splitlines() if file.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _load() -> float | None:
    """Processes that wanted a processor over the last quarter of an hour: other work makes measured times longer."""
    return round(os.getloadavg()[2], 1) if hasattr(os, "getloadavg") else None
