"""Stacks of TIFF: volumes whose slices are the pages of a file, with the spacing that ImageJ writes, if any.

Coordinates are column, row and slice times the spacing, which is 1 where a file carries none.
"""

from __future__ import annotations

import importlib
import logging
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import CodegenError, ExtraError, ImageError
from codegen.registration.grid import Grid
from codegen.registration.images.by_tifffile import SAMPLES

SUFFIXES = (".tif", ".tiff")
_IMAGEJ = frozenset(np.dtype(name) for name in ("u1", "u2", "f4"))
_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_UNITS = {"micron": "µm", "microns": "µm", "um": "µm", "\\u00b5m": "µm", "pixel": "pixels", "": "pixels"}


def _tifffile() -> Any:
    try:
        found = importlib.import_module("tifffile")
    except ImportError as error:
        finding = "TIFF files take tifffile, which is not installed"
        raise ExtraError(finding, "install the extra: pip install 'variational-codegen[volumes]'") from error
    found.logger().setLevel(logging.CRITICAL)
    return found


def is_stack(path: Path) -> bool:
    """Whether a file is TIFF with several slices of grey, as far as can be told."""
    try:
        with _tifffile().TiffFile(path) as file:
            return bool(len(file.series[0].shape) == 3 and file.pages[0].samplesperpixel == 1)
    except Exception:  # which whoever reads it as an image says better
        return False


def read_stack(path: Path, most: int) -> tuple[NDArray[Any], Grid]:
    """Samples and grid of a stack; ImageError for what is none, is damaged or too large."""
    try:
        with _tifffile().TiffFile(path) as file:
            series = file.series[0]
            shape = tuple(int(length) for length in series.shape)
            said = " x ".join(map(str, shape))
            if len(shape) != 3 or file.pages[0].samplesperpixel != 1 or min(shape) < 2:
                raise ImageError(
                    f"{path} is no stack of grey slices: {said}", "save it as slices of one number a pixel"
                )
            if int(np.prod(shape, dtype=object)) > most:
                raise ImageError(f"{path} has {said} voxels, more than {most}", "give a smaller volume")
            if np.dtype(series.dtype) not in SAMPLES:
                raise ImageError(f"{path} holds samples of {series.dtype}", "save it with integers or 32-bit floats")
            spacing, unit = _spacing(file)
            samples = np.ascontiguousarray(series.asarray())
    except CodegenError:
        raise
    except Exception as error:  # decoders raise nearly everything for damaged files
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:160] or type(error).__name__
        raise ImageError(f"{path} cannot be read ({reason})", "give a whole TIFF stack") from error
    grid = Grid(samples.shape[::-1], (0.0, 0.0, 0.0), spacing, _UPRIGHT, unit)
    return samples.astype(samples.dtype.newbyteorder("="), copy=False), grid


def _spacing(file: Any) -> tuple[tuple[float, float, float], str]:
    """Of columns, rows and slices; 1 pixel where it is not known of all three."""
    seen = file.imagej_metadata if file.is_imagej else None
    x, y = (_number(file.pages[0].tags.valueof(tag)) for tag in (282, 283))
    z = float((seen or {}).get("spacing", 0.0))
    if not (x > 0.0 and y > 0.0 and z > 0.0):
        return (1.0, 1.0, 1.0), "pixels"
    unit = str((seen or {}).get("unit", ""))
    return (1.0 / x, 1.0 / y, z), _UNITS.get(unit, unit)[:12]


def _number(value: Any) -> float:
    top, bottom = value if isinstance(value, tuple) else (value or 0, 1)
    return float(top) / float(bottom) if bottom else 0.0


def require_fitting(path: Path, dtype: np.dtype[Any]) -> None:
    """Refuse samples that are not written; ImageError names the file."""
    if dtype not in SAMPLES:
        raise ImageError(f"{path}: samples of {dtype} cannot be written", "write NIfTI, MetaImage or NRRD")


def write_stack(path: Path, samples: NDArray[Any], grid: Grid) -> None:
    """Write slices as pages, with the spacing as ImageJ has it where the kind of samples allows for that."""
    if samples.dtype not in _IMAGEJ:
        _tifffile().imwrite(path, samples, photometric="minisblack", compression="zlib", metadata=None)
        return
    x, y, z = grid.spacing
    _tifffile().imwrite(
        path, samples, imagej=True, resolution=(1.0 / x, 1.0 / y), photometric="minisblack",
        metadata={"axes": "ZYX", "spacing": z, "unit": {"µm": "um", "pixels": "pixel"}.get(grid.unit, grid.unit)},
    )  # fmt: skip
