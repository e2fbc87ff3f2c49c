"""Volumes in files: NIfTI, MetaImage and NRRD by SimpleITK, stacks of TIFF by tifffile.

What a file says of spacing, origin and orientation becomes a grid in LPS coordinates, as ITK has them: x to the left of
the patient, y to the back, z to the head, in millimetres. Size and kind are looked at before samples are read.
"""

from __future__ import annotations

import gzip
import importlib
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

from codegen.errors import CodegenError, ExtraError, ImageError
from codegen.registration.grid import Grid
from codegen.registration.images.header import VOLUMES
from codegen.registration.volumes import stacks
from codegen.registration.volumes.two_files import replacing_volume

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
    return ending(path, READ) is not None or (ending(path, stacks.SUFFIXES) is not None and stacks.is_stack(path))


def read_volume(path: Path, most: int = MOST_VOXELS) -> Volume:
    """Read a volume of one number a voxel.

    Raises ImageError, naming the file, for what is no volume, is damaged, has more than `most` voxels, several numbers
    a voxel, several times, or axes that are not orthogonal; ExtraError where the library that reads it is missing.
    """
    if ending(path, stacks.SUFFIXES) is not None:
        return Volume(*stacks.read_stack(path, most))
    if ending(path, READ) is None:
        raise ImageError(f"{path}: unknown kind of volume", f"give {', '.join((*READ, *stacks.SUFFIXES))}")
    if not path.is_file():
        raise ImageError(f"{path} cannot be read (no such file)", "give a volume")
    itk = library("SimpleITK")
    with telling(path), silent():
        reader = itk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        _require_scalars(path, reader, most)
        require_whole(path, reader)
        if reader.GetDimension() == 4:  # of one time
            reader.SetExtractSize((*reader.GetSize()[:3], 0))
        image = reader.Execute()
        samples = itk.GetArrayFromImage(image)
    direction = np.array(image.GetDirection()).reshape(3, 3) + 0.0
    grid = Grid(image.GetSize(), image.GetOrigin(), image.GetSpacing(), tuple(map(tuple, direction.tolist())), "mm")
    return Volume(np.ascontiguousarray(samples), grid)


def _require_scalars(path: Path, reader: Any, most: int) -> None:
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
    kind = ending(path, (*WRITTEN, *stacks.SUFFIXES))
    if kind is None or (kind in WRITTEN and not path.name.endswith(kind)):  # SimpleITK knows no capitals
        raise ImageError(f"{path}: volumes are not written so", f"let it end in {', '.join((*WRITTEN, '.tif'))}")
    library("tifffile" if kind in stacks.SUFFIXES else "SimpleITK")
    if dtype is not None and kind in stacks.SUFFIXES:
        stacks.require_fitting(path, dtype)


def write_volume(path: Path, samples: NDArray[Any], grid: Grid) -> None:
    """Write samples on a grid as the file's name says, as a whole or not at all; FileError where that is refused."""
    require_written(path, samples.dtype)
    with replacing_volume(path) as temporary, telling(path):
        if ending(path, stacks.SUFFIXES):
            stacks.write_stack(temporary, samples, grid)
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
