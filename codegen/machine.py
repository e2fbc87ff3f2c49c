"""The versions of packages and the processor of the machine, for pages that report measured times."""

from __future__ import annotations

import os
import platform
from functools import cache
from importlib import metadata
from pathlib import Path

from codegen import __version__

_PACKAGES = ("numpy", "scipy", "numba", "sympy", "matplotlib")


def machine() -> dict[str, object]:
    """Return the versions of packages, the processor and the present load of the machine, by name."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text(encoding="utf-8").splitlines() if cpuinfo.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    # The load is the mean number of running or waiting processes in the last 15 minutes. Other work increases times.
    load = round(os.getloadavg()[2], 1) if hasattr(os, "getloadavg") else None
    return {
        **versions(),
        "machine": platform.machine(),
        "processor": names[0] if names else platform.processor(),
        "processors": os.cpu_count() or 1,
        "system": platform.system(),
        "load of the machine when the page was made": load,
    }


def versions() -> dict[str, str]:
    """Return the versions of codegen, Python and the packages on which results and measured times depend."""
    return {"codegen": __version__, "python": platform.python_version(), **dict(_packages())}


@cache
def _packages() -> tuple[tuple[str, str], ...]:
    """Return the versions of packages, from a cache because reading the versions takes longer than some sweeps."""
    return tuple((name, metadata.version(name)) for name in _PACKAGES)
