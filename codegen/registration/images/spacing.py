"""How large the pixels of an image are, where its file says so: TIFF files of ImageJ, of OME and with a resolution.

What NIfTI, NRRD and MetaImage say is read with their samples, in `codegen.registration.app.reading`.
"""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

_NAMES = {"micron": "µm", "microns": "µm", "um": "µm", "\\u00b5m": "µm", "inch": "in", "": "mm"}
_PRINT = (1.0, 72.0, 96.0, 100.0, 150.0, 200.0, 240.0, 300.0, 600.0, 1200.0)
"""Dots to an inch that programs write without having measured anything."""
_SIZE = r'PhysicalSize{}="([0-9.eE+-]+)"'
LONGEST = 1000.0
"""How many times as long as wide a pixel may be."""
MOST_UNIT = 12


@dataclass(frozen=True)
class Spacing:
    """Width and height of a pixel in a unit of length."""

    x: float
    y: float
    unit: str

    @property
    def side(self) -> float:
        """The side of a square with the area of a pixel."""
        return self.x if self.x == self.y else float(np.sqrt(self.x) * np.sqrt(self.y))

    def lengths(self, misses: NDArray[np.float64]) -> NDArray[np.float64]:
        """The lengths in the unit of vectors, shape (n, 2), that are in units of `side`, as misses are."""
        return np.asarray(np.linalg.norm(misses * self.side, axis=1))


def spacing_of(kind: str, data: bytes) -> Spacing | None:
    """The spacing that an image file carries; None where it carries none that means anything."""
    if kind != "TIFF":
        return None  # what PNG and JPEG files carry is how they are to be printed
    try:
        found = _of_tiff(data)
    except Exception:  # the pixels could be read; whatever is wrong with the rest is no reason to refuse them
        return None
    return None if found is None else meant(found)


def meant(spacing: Spacing) -> Spacing | None:
    """The same, if anything can have that size and shape."""
    sides = sorted((spacing.x, spacing.y))
    return spacing if 1e-12 < sides[0] <= sides[1] < min(1e12, LONGEST * sides[0]) else None


def _of_tiff(data: bytes) -> Spacing | None:
    import tifffile

    with tifffile.TiffFile(io.BytesIO(data)) as file:
        if file.is_ome and file.ome_metadata:
            return _of_ome(file.ome_metadata)
        page: Any = file.pages[0]
        x, y = (_number(page.tags.valueof(tag)) for tag in (282, 283))
        if not (x and y):
            return None
        if file.is_imagej:
            unit = str((file.imagej_metadata or {}).get("unit", ""))
            return Spacing(1 / x, 1 / y, named(unit)) if unit and unit != "pixel" else None
        code = int(page.tags.valueof(296) or 2)
        if code == 3:
            return Spacing(10 / x, 10 / y, "mm")
        return Spacing(25.4 / x, 25.4 / y, "mm") if code == 2 and x not in _PRINT else None


def _of_ome(text: str) -> Spacing | None:
    x, y = (re.search(_SIZE.format(axis), text) for axis in "XY")
    if x is None or y is None:
        return None
    unit = re.search(r'PhysicalSizeXUnit="([^"]*)"', text)
    return Spacing(float(x[1]), float(y[1]), named(unit[1] if unit else "µm"))


def named(unit: str) -> str:
    """A unit as the page shows it."""
    return _NAMES.get(unit, unit)[:MOST_UNIT]


def _number(value: Any) -> float:
    """A rational number as TIFF stores it; zero where there is none."""
    if not value:
        return 0.0
    top, bottom = value if isinstance(value, tuple) else (value, 1)
    return float(top) / float(bottom) if bottom else 0.0
