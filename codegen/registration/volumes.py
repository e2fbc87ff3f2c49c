"""Registration of volumes: files with orientation and spacing, landmarks in space, warps in blocks, fields, pages.

Landmarks and what is said of them are in the coordinates of the files, LPS in millimetres as a rule. Inside, maps have
coordinates in units of the finest spacing of the fixed volume, so that what is a pixel for pictures is about a voxel.

Volumes in files: NIfTI, MetaImage and NRRD by SimpleITK, stacks of TIFF by tifffile.

What a file says of spacing, origin and orientation becomes a grid in LPS coordinates, as ITK has them: x to the left of
the patient, y to the back, z to the head, in millimetres. Size and kind are looked at before samples are read.

Displacement fields of volumes in files that ITK, and with it 3D Slicer, elastix and ANTs, read as a transform. A field
is a volume of vectors on the grid of the result: x, y and z in LPS and in the units of the file, that lead from the
place of a voxel to that in the source at which its value is read, as ITK's displacement field transforms do. In NIfTI
the intent is `vector`, whose components ITK takes as they are; numbers are 32-bit floats.

Stacks of TIFF: volumes whose slices are the pages of a file, with the spacing that ImageJ writes, if any. Coordinates
are column, row and slice times the spacing, which is 1 where a file carries none.

Warped volumes: places by slabs on a coarse grid of nodes, samples by blocks, and the result of a pair.

Where voxels come from, by slabs: cubic splines between exactly mapped nodes, and exact places where these err. As for
pictures in `codegen.registration.warp`, nothing is proved of the splines' errors. They are measured at all nodes, with
those of the splines through every second one; a quarter of that is taken for the error, and what is larger than a bound
is mapped exactly, voxel by voxel, with all that lies about it. In space a map has a kink at every landmark, so that
what lies about these is mapped exactly whatever was measured. Distances between nodes are as equal in all directions as
the spacing allows; only one slab of places is in memory at a time.
"""

from __future__ import annotations

import gzip
import importlib
import logging
import os
import threading
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline
from scipy.ndimage import binary_dilation, maximum_filter

from codegen.errors import ArgumentError, CodegenError, ExtraError, ImageError
from codegen.registration.grid import Grid, mesh, slabs
from codegen.registration.images import SAMPLES, VOLUMES
from codegen.registration.pairs import PointArray
from codegen.registration.warp import HALVING, ORDERS, basis, replacing_volume, sample_band, spline_of

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


BOUND = 5e-4
"""The largest error of a place in finest spacings: a thousandth of a voxel is promised, and fields are rounded."""
LARGEST = 16
"""Voxels between nodes, at most."""
FEWEST = 6
"""Intervals along an axis, at least: every second node must determine a cubic spline."""
CHEAP = 12
"""Half the distance makes eight times as many nodes, each of which has to be worth more than a voxel."""
CHECKED, NODES_PORTION = 256, 32
"""Cells at whose centres the spline is compared with exact places, and how many of them at once."""

Map: TypeAlias = Callable[[PointArray], PointArray]


@dataclass(frozen=True, eq=False)
class Nodes:
    """Every so-many-th sample of a grid along each axis, `steps`, and what the map adds to its place.

    `lines` are the nodes' indices and `shifts` has shape (slices, rows, columns, 3), in this order. `doubtful` says
    which cells between nodes are to be mapped exactly. `bound` is the largest estimated error of the others, in the
    units of the grid, and `exact` the share of samples that are mapped.
    """

    function: Map
    grid: Grid
    steps: tuple[int, ...]
    lines: tuple[NDArray[np.float64], ...]
    shifts: NDArray[np.float64]
    doubtful: NDArray[np.bool_]
    bound: float

    @classmethod
    def of(cls, function: Map, grid: Grid, singular: PointArray, bound: float = BOUND) -> Nodes:
        """Halve the distance between nodes until that no longer pays; `bound` is in finest spacings.

        `function` carries places, shape (n, 3), and is not smooth at those that are `singular`.
        """
        distance = float(LARGEST)
        while True:
            found = cls._with_steps(function, grid, _steps(grid, distance), singular, bound * grid.pixel)
            cells = found.doubtful.sum() * np.prod(found.steps)
            if max(found.steps) == 1 or cells <= CHEAP * found.shifts[..., 0].size:
                return found.checked(bound * grid.pixel)
            distance *= 0.5

    @classmethod
    def _with_steps(
        cls, function: Map, grid: Grid, steps: tuple[int, ...], singular: PointArray, bound: float
    ) -> Nodes:
        lines = tuple(_line(length, step) for length, step in zip(grid.size[::-1], steps[::-1], strict=True))
        places = grid.to_places(mesh(lines[::-1]))
        shifts = (function(places) - places).reshape(*map(len, lines), 3)
        found = cls(function, grid, steps, lines, shifts, np.zeros([len(line) - 1 for line in lines], np.bool_), 0.0)
        errors = found._errors()
        large = ~(errors <= bound)
        cells = np.floor(grid.to_indices(singular) / steps).astype(int)[:, ::-1]
        inside = ((cells >= 0) & (cells < large.shape)).all(axis=1)
        large[tuple(cells[inside].T)] = True
        doubtful = np.asarray(binary_dilation(large, np.ones((3, 3, 3))))
        left = float(np.where(doubtful, 0.0, errors).max())
        return cls(function, grid, steps, lines, shifts, doubtful, left)

    def _errors(self) -> NDArray[np.float64]:
        """The spline's estimated error in each cell, the largest at its corners."""
        coarse = self.shifts[::2, ::2, ::2]
        for axis, line in enumerate(self.lines):
            coarse = np.asarray(make_interp_spline((line[::2]), coarse, k=3, axis=axis)(line))
        errors = np.linalg.norm(coarse - self.shifts, axis=-1) / HALVING
        return np.asarray(maximum_filter(errors, size=(2, 2, 2), origin=-1)[:-1, :-1, :-1])

    def checked(self, bound: float) -> Nodes:
        """The same with cells of neighbours, too, where the spline errs at the centres of cells that were trusted."""
        trusted = np.argwhere(~self.doubtful)
        chosen = trusted[np.random.default_rng(0).permutation(len(trusted))[:CHECKED]]
        if not len(chosen):
            return self
        steps = np.array(self.steps[::-1])
        inside = ((chosen + 0.5) * steps <= np.array(self.grid.shape) - 1.0).all(axis=1)
        centres = ((chosen[inside] + 0.5) * steps)[:, ::-1]
        if not len(centres):
            return self
        places = self.grid.to_places(centres)
        found = np.concatenate(
            [self._at(centres[k : k + NODES_PORTION]) for k in range(0, len(centres), NODES_PORTION)]
        )
        errors = np.linalg.norm(found - (self.function(places) - places), axis=1)
        doubtful = self.doubtful.copy()
        doubtful[tuple(chosen[inside][~(errors <= bound)].T)] = True
        doubtful = np.asarray(binary_dilation(doubtful, np.ones((3, 3, 3)))) if (errors > bound).any() else doubtful
        left = max(self.bound, float(errors[errors <= bound].max(initial=0.0)))
        return Nodes(self.function, self.grid, self.steps, self.lines, self.shifts, doubtful, left)

    def _at(self, indices: NDArray[np.float64]) -> NDArray[np.float64]:
        """The spline at indices (column, row, slice), shape (n, 3)."""
        z, y, x = (basis(line, at) for line, at in zip(self.lines, indices.T[::-1], strict=True))
        flat = (z @ self._coefficients.reshape(len(self.lines[0]), -1)).reshape(len(indices), *self.shifts.shape[1:])
        rows = np.einsum("nyxc,ny->nxc", flat, y.toarray())
        return np.asarray(np.einsum("nxc,nx->nc", rows, x.toarray()))

    @property
    def exact(self) -> float:
        """The share of samples that are mapped exactly."""
        volumes = [np.diff(np.minimum(line, length)) for line, length in zip(self.lines, self.grid.shape, strict=True)]
        return float(np.einsum("zyx,z,y,x->", self.doubtful.astype(float), *volumes) / self.grid.count)

    @cached_property
    def _coefficients(self) -> NDArray[np.float64]:
        found = self.shifts
        for axis, line in enumerate(self.lines):
            found = np.moveaxis(make_interp_spline(line, np.moveaxis(found, axis, 0), k=3).c, 0, axis)
        return found

    def slab(self, part: slice) -> NDArray[np.float64]:
        """What the map adds to the places of some slices, shape (slices, rows, columns, 3)."""
        found = self._coefficients
        indices = [np.arange(part.start, part.stop), *(np.arange(length) for length in self.grid.shape[1:])]
        for axis, (line, at) in enumerate(zip(self.lines, indices, strict=True)):
            # A sparse matrix applied along an axis.
            matrix = basis(line, at)
            first = np.moveaxis(found, axis, 0)
            made = matrix @ first.reshape(len(first), -1)
            found = np.moveaxis(made.reshape(-1, *first.shape[1:]), 0, axis)
        cells = [np.minimum(at // step, len(line) - 2) for at, step, line in zip(indices, self.steps[::-1], self.lines)]
        marked = np.nonzero(self.doubtful[np.ix_(*cells)])
        if marked[0].size:
            places = self.grid.to_places(np.stack([marked[2], marked[1], marked[0] + part.start], axis=1).astype(float))
            found[marked] = self.function(places) - places
        return found


def _steps(grid: Grid, distance: float) -> tuple[int, ...]:
    """Powers of two along columns, rows and slices, whose lengths are about `distance` finest spacings."""
    steps = []
    for length, spacing in zip(grid.size, grid.spacing, strict=True):
        step = 2 ** max(0, round(np.log2(distance * grid.pixel / spacing)))
        while step > 1 and FEWEST * step > length:
            step //= 2
        steps.append(int(step))
    return tuple(steps)


def _line(length: int, step: int) -> NDArray[np.float64]:
    return step * np.arange(max(FEWEST, 2 * -(-length // (2 * step))) + 1.0)


BLOCKS_PORTION = 1 << 19
"""Voxels whose places are in memory at once."""


@dataclass(frozen=True, eq=False)
class Warped:
    """Samples of the result, shape (slices, rows, columns), and how many of them come from outside the source.

    `field`, shape (slices, rows, columns, 3), or None if it was not asked for, is what is added to the place of a voxel
    of the result to come to that in the source at which its value is read.
    """

    samples: NDArray[Any]
    outside: int
    field: NDArray[np.float32] | None


def warped(source: Volume, nodes: Nodes, interpolation: str, with_field: bool = False, fill: float = 0.0) -> Warped:
    """The source in the grid of the nodes, whose map says where voxels come from; its dtype is kept."""
    grid, order = nodes.grid, ORDERS[interpolation]
    samples = np.empty(grid.shape, source.samples.dtype)
    field = np.empty((*grid.shape, 3), np.float32) if with_field else None
    layer, outside = spline_of(source.samples, order), 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        columns, rows, slices = grid.size
        for part in list(slabs(slices, max(1, BLOCKS_PORTION // (columns * rows)))):
            shifts = nodes.slab(part)
            if field is not None:
                field[part] = shifts
            indices = _sources(source.grid, grid, part, shifts)

            def one(k: int, first: int = part.start, indices: NDArray[np.float64] = indices) -> int:
                return sample_band([layer], indices[k], source.samples.shape, order, fill, samples[first + k])

            outside += sum(pool.map(one, range(len(indices))))
    return Warped(samples, outside, field)


def _sources(source: Grid, grid: Grid, part: slice, shifts: NDArray[np.float64]) -> NDArray[np.float64]:
    """Indices (column, row, slice) in the source of the voxels of some slices, shape (slices, rows, columns, 3)."""
    columns, rows, _ = grid.size
    lines = [np.arange(float(columns)), np.arange(float(rows)), np.arange(float(part.start), float(part.stop))]
    places = grid.to_places(mesh(lines))
    places = places + shifts.reshape(places.shape)
    return source.to_indices(places).reshape(shifts.shape)
