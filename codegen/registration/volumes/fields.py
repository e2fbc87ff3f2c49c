"""Displacement fields of volumes in files that ITK, and with it 3D Slicer, elastix and ANTs, read as a transform.

A field is a volume of vectors on the grid of the result: x, y and z in LPS and in the units of the file, that lead from
the place of a voxel to that in the source at which its value is read, as ITK's displacement field transforms do. In
NIfTI the intent is `vector`, whose components ITK takes as they are; numbers are 32-bit floats.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError
from codegen.registration.grid import Grid
from codegen.registration.volumes.files import WRITTEN, library, write_image
from codegen.registration.volumes.two_files import replacing_volume


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
