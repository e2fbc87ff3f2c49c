"""Displacement fields: where each pixel goes, or comes from, as arrays and as files that other programs read.

A field on the fixed frame, made with `inverse=True`, is what resampling programs such as ITK expect: added to the place
of a fixed pixel, it gives the place in the moving image at which to look. NIfTI, MetaImage and NRRD have one voxel a
pixel, of size 1, with the origin at the centre of the top-left pixel, and vectors (x, y) in pixels; axes are ITK's,
that is x to the left of the patient and y to the back, so that no sign changes between the array and ITK.

MetaImage in two files: a header, `.mhd`, and beside it the samples that it names. What is written names `stem.raw`,
which holds bare numbers, not compressed, so that any program can read them.
"""

from __future__ import annotations

import gzip
import importlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, ExtraError, ImageError
from codegen.files import replacing
from codegen.registration.grid import pixel_grid
from codegen.registration.maps import Registration
from codegen.registration.warp import Positions, Spacing, map_grid

SUFFIX = ".mhd"
_SAMPLES = ".raw"
_KEY = "ElementDataFile"
_NAMING = {SUFFIX: ("=", (_KEY,)), ".nhdr": (":", ("data file", "datafile"))}
"""Kinds of headers: what is between a key and its value, and the keys that name samples."""
_MOST = 1 << 16
"""Bytes of a header that are looked through."""


def written_with(path: Path) -> Path | None:
    """The file of samples that is written beside a header; None where a volume is one file."""
    return path.with_suffix(_SAMPLES) if path.suffix.lower() == SUFFIX else None


def read_with(path: Path) -> Path | None:
    """The file of samples that a header names, of NRRD as well; None where there is none, or it cannot be read."""
    separator, keys = _NAMING.get(path.suffix.lower(), ("", ()))
    if not keys:
        return None
    try:
        with path.open("rb") as file:
            lines = file.read(_MOST).decode("latin-1").splitlines()
    except OSError:
        return None  # whoever reads the volume says so
    parts = (line.partition(separator) for line in lines)
    named = [value.strip() for key, _, value in parts if key.strip() in keys]
    return path.parent / named[-1] if named and named[-1] not in ("", "LOCAL", "LIST") else None


@contextmanager
def replacing_volume(path: Path) -> Iterator[Path]:
    """As `codegen.files.replacing`, for whatever kind of volume SimpleITK writes; the header is replaced last."""
    samples = written_with(path)
    if samples is None:
        with replacing(path) as temporary:
            yield temporary
        return
    with replacing(path) as header, replacing(samples) as temporary:
        made = header.with_suffix(_SAMPLES)
        try:
            yield header
            made.replace(temporary)
            text = header.read_text(encoding="latin-1")
            header.write_text(text.replace(f"{_KEY} = {made.name}", f"{_KEY} = {samples.name}"), encoding="latin-1")
        finally:
            made.unlink(missing_ok=True)


KINDS = (".npz", ".nii", ".nii.gz", ".mha", ".mhd", ".nrrd")
_VECTOR = "vector"  # the NIfTI intent whose components ITK takes as they are


def displacement_field(
    registration: Registration,
    shape: Sequence[int] | None = None,
    inverse: bool = False,
    *,
    spacing: Spacing = None,
) -> NDArray[np.float64]:
    """What the map adds to the place of each pixel of the moving image, shape (h, w, 2): (dx, dy) in pixels.

    With `inverse`, what the inverse map adds to the place of each pixel of the fixed image. `shape` is by default that
    of the image; `spacing` allows for interpolation, as in `codegen.registration.warp`.
    """
    default = registration.fixed_shape if inverse else registration.shape
    height, width = (int(length) for length in tuple(default if shape is None else shape)[:2])
    function = registration.map_points_inverse if inverse else registration.map_points
    singular = registration.pairs.fixed if inverse else registration.pairs.moving
    return displacements(map_grid(function, (height, width), singular, spacing))


def displacements(positions: Positions) -> NDArray[np.float64]:
    """The same field, shape (h, w, 2), where it is known already where each pixel goes or comes from."""
    return np.asarray(positions.places - pixel_grid(positions.places.shape).reshape(positions.places.shape))


def write_field(path: Path | str, field: NDArray[np.float64], direction: str = "") -> None:
    """Write a displacement field, shape (h, w, 2), by the ending of its name; `direction` is noted in the file.

    Raises ArgumentError for another kind of file, FileError for a place that cannot be written, ExtraError when the
    library is missing (nibabel for NIfTI, SimpleITK for MetaImage and NRRD), ImageError for an array that is no field.
    """
    path, values = Path(path), np.asarray(field, dtype=np.float64)
    if values.ndim != 3 or values.shape[2] != 2:
        raise ImageError(f"the displacement field has shape {values.shape}", "give (height, width, 2)")
    kind = next((kind for kind in reversed(KINDS) if path.name.endswith(kind)), None)
    if kind is None:
        raise ArgumentError(f"{path}: unknown kind of displacement field", f"let it end in {', '.join(KINDS)}")
    writer = {".npz": _write_npz, ".nii": _write_nifti, ".nii.gz": _write_nifti}.get(kind, _write_by_itk)
    with replacing_volume(path) as temporary:
        writer(temporary, values, direction)


def _write_npz(path: Path, field: NDArray[np.float64], direction: str) -> None:
    np.savez_compressed(path, displacement=field, direction=np.array(direction))


def _write_nifti(path: Path, field: NDArray[np.float64], direction: str) -> None:
    nibabel = _library("nibabel")
    # Axes x, y, z, t, component; NIfTI's x and y run against ITK's.
    data = np.ascontiguousarray(field.transpose(1, 0, 2)[:, :, None, None, :])
    image = nibabel.Nifti1Image(data, np.diag([-1.0, -1.0, 1.0, 1.0]))
    image.header.set_intent(_VECTOR)
    image.header["descrip"] = f"displacement {direction}".strip().encode()[:79]
    content = image.to_bytes()
    path.write_bytes(gzip.compress(content, 6) if path.suffix.lower() == ".gz" else content)


def _write_by_itk(path: Path, field: NDArray[np.float64], direction: str) -> None:
    itk = _library("SimpleITK")
    image = itk.GetImageFromArray(np.ascontiguousarray(field), isVector=True)
    if direction:
        image.SetMetaData("Comment", f"displacement {direction}")
    itk.WriteImage(image, str(path), useCompression=written_with(path) is None)


def _library(name: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        remedy = "install the extra: pip install 'variational-codegen[fields]'"
        raise ExtraError(f"{name}, which writes this kind of file, is not installed", remedy) from error
