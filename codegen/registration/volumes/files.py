"""Volumes in files: NIfTI, MetaImage and NRRD by SimpleITK, stacks of TIFF by tifffile.

What a file says of spacing, origin and orientation becomes a grid in LPS coordinates, as ITK has them: x to the left of
the patient, y to the back, z to the head, in millimetres. Size and kind are looked at before samples are read.

Displacement fields of volumes in files that ITK, and with it 3D Slicer, elastix and ANTs, read as a transform. A field
is a volume of vectors on the grid of the result: x, y and z in LPS and in the units of the file, that lead from the
place of a voxel to that in the source at which its value is read, as ITK's displacement field transforms do. In NIfTI
the intent is `vector`, whose components ITK takes as they are; numbers are 32-bit floats.

Stacks of TIFF: volumes whose slices are the pages of a file, with the spacing that ImageJ writes, if any. Coordinates
are column, row and slice times the spacing, which is 1 where a file carries none.
"""

from __future__ import annotations

import gzip
import importlib
import logging
import os
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, CodegenError, ExtraError, ImageError
from codegen.registration.fields import replacing_volume
from codegen.registration.grid import Grid
from codegen.registration.images.codecs import SAMPLES, VOLUMES

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


READ = VOLUMES
WRITTEN = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd")
_BARE = (".nii", ".mhd")
"""Kinds that are not compressed."""
MOST_VOXELS = 1 << 30
THINNEST = 2
"""Samples along each axis that make a volume."""
_SILENCE = threading.Lock()
INSTALL = "install the extra: pip install 'variational-codegen[volumes]'"


@dataclass(frozen=True, eq=False)
class Volume:
    """Samples, shape (slices, rows, columns), and their grid."""

    samples: NDArray[Any]
    grid: Grid


def ending(path: Path, kinds: tuple[str, ...]) -> str | None:
    """Which of the kinds a file's name ends in, the longest that fits."""
    fitting = [kind for kind in kinds if path.name.lower().endswith(kind)]
    return max(fitting, key=len, default=None)


def is_volume(path: Path) -> bool:
    """Whether the name of a file is that of a volume, or it is a TIFF file of several slices."""
    return ending(path, READ) is not None or (ending(path, SUFFIXES) is not None and is_stack(path))


def read_volume(path: Path, most: int = MOST_VOXELS) -> Volume:
    """Read a volume of one number a voxel.

    Raises ImageError, naming the file, for what is no volume, is damaged, has more than `most` voxels, several numbers
    a voxel, several times, or axes that are not orthogonal; ExtraError where the library that reads it is missing.
    """
    if ending(path, SUFFIXES) is not None:
        return Volume(*read_stack(path, most))
    if ending(path, READ) is None:
        raise ImageError(f"{path}: unknown kind of volume", f"give {', '.join((*READ, *SUFFIXES))}")
    if not path.is_file():
        raise ImageError(f"{path} cannot be read (no such file)", "give a volume")
    itk = library("SimpleITK")
    with telling(path), silent():
        reader = itk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        size = reader.GetSize()
        said = " x ".join(map(str, size))
        if len(size) == 4 and size[3] > 1:
            raise ImageError(f"{path} holds {size[3]} volumes", "save the one to be registered as a file of its own")
        if len(size) not in (3, 4) or min(size[:3]) < THINNEST:
            raise ImageError(f"{path} is no volume: {said} voxels", "save a single slice as PNG or TIFF")
        if int(np.prod(size, dtype=object)) > most:
            raise ImageError(f"{path} has {said} voxels, more than {most}", "give a smaller volume")
        if reader.GetNumberOfComponents() != 1:
            finding = f"{path} has {reader.GetNumberOfComponents()} numbers in each voxel"
            raise ImageError(finding, "give a volume of one number a voxel")
        require_whole(path, reader)
        if reader.GetDimension() == 4:  # of one time
            reader.SetExtractSize((*reader.GetSize()[:3], 0))
        image = reader.Execute()
        samples = itk.GetArrayFromImage(image)
    direction = np.array(image.GetDirection()).reshape(3, 3) + 0.0
    grid = Grid(image.GetSize(), image.GetOrigin(), image.GetSpacing(), tuple(map(tuple, direction.tolist())), "mm")
    return Volume(np.ascontiguousarray(samples), grid)


def require_whole(path: Path, reader: Any, name: str = "") -> None:
    """Refuse NIfTI files that are cut off, which the library fills up with zeros; errors may call them by a `name`."""
    kind = ending(path, READ)
    if kind not in (".nii", ".nii.gz"):
        return
    bits, offset = (float(reader.GetMetaData(key)) for key in ("bitpix", "vox_offset"))
    needed = int(np.prod(reader.GetSize(), dtype=object)) * int(bits) // 8 + int(offset)
    held = path.stat().st_size
    if kind == ".nii.gz":
        with gzip.open(path) as file:
            held = 0
            while held < needed and (part := file.read(1 << 22)):  # and no further, whatever else is in it
                held += len(part)
    if held < needed:
        raise ImageError(f"{name or path} is cut off: {held} bytes of {needed}", "give a whole file")


@contextmanager
def telling(path: Path | str) -> Iterator[None]:
    """Errors of libraries as one ImageError with the last thing they say."""
    try:
        yield
    except CodegenError:
        raise
    except MemoryError as error:
        raise ImageError(f"{path} does not fit into memory", "give a smaller volume") from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ImageError(f"{path} is cut off or damaged ({error})", "give a whole file") from error
    except Exception as error:  # the library raises RuntimeError for everything
        lines = [line.split("ERROR:")[-1].strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[-1][:160] if lines else type(error).__name__
        if "orthonormal" in str(error):
            raise ImageError(f"{path} has axes that are not orthogonal", "resample it on an upright grid") from error
        raise ImageError(f"{path} is damaged or no volume ({reason})", "give a whole file") from error


@contextmanager
def silent() -> Iterator[None]:
    """What libraries in C write to stderr beside the errors that they raise goes nowhere; for one thread at a time."""
    with _SILENCE:
        kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, 2)
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            os.close(nowhere)


def require_written(path: Path, dtype: np.dtype[Any] | None = None) -> None:
    """Refuse names of volumes that are not written, and without the library that writes them."""
    kind = ending(path, (*WRITTEN, *SUFFIXES))
    if kind is None or (kind in WRITTEN and not path.name.endswith(kind)):  # SimpleITK knows no capitals
        raise ImageError(f"{path}: volumes are not written so", f"let it end in {', '.join((*WRITTEN, '.tif'))}")
    library("tifffile" if kind in SUFFIXES else "SimpleITK")
    if dtype is not None and kind in SUFFIXES:
        require_fitting(path, dtype)


def write_volume(path: Path, samples: NDArray[Any], grid: Grid) -> None:
    """Write samples on a grid as the file's name says, as a whole or not at all; FileError where that is refused."""
    require_written(path, samples.dtype)
    with replacing_volume(path) as temporary, telling(path):
        if ending(path, SUFFIXES):
            write_stack(temporary, samples, grid)
            return
        write_image(temporary, samples, grid)


def write_image(path: Path, samples: NDArray[Any], grid: Grid, note: str = "") -> None:
    """Write samples, shape (slices, rows, columns) or with vectors along a fourth axis, by SimpleITK."""
    itk = library("SimpleITK")
    image = itk.GetImageFromArray(samples, isVector=samples.ndim == 4)
    image.SetSpacing(grid.spacing)
    image.SetOrigin(grid.origin)
    image.SetDirection([cosine for row in grid.direction for cosine in row])
    if note:
        image.SetMetaData("descrip" if ending(path, READ) in (".nii", ".nii.gz") else "Comment", note)
    with silent():
        itk.WriteImage(image, str(path), useCompression=ending(path, READ) not in _BARE)


def library(name: str) -> Any:
    """SimpleITK or tifffile; ExtraError with the command that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ExtraError(f"{name}, which reads and writes volumes, is not installed", INSTALL) from error


def require_field(path: Path) -> None:
    """Refuse names of other kinds of files; ArgumentError names the file."""
    if not path.name.endswith(WRITTEN):  # SimpleITK knows no capitals
        finding = f"--field {path}: displacements of volumes are not written so"
        raise ArgumentError(finding, f"let it end in {', '.join(WRITTEN)}")
    library("SimpleITK")


def write_field(path: Path, field: NDArray[np.float32], grid: Grid, direction: str = "") -> None:
    """Write a field, shape (slices, rows, columns, 3), on its grid; FileError where the file system refuses."""
    require_field(path)
    with replacing_volume(path) as temporary:
        write_image(temporary, np.asarray(field), grid, f"displacement {direction}".strip())
