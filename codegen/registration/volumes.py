"""Volumes: files with orientation and spacing, displacement fields, and warped volumes.

SimpleITK reads NIfTI, MetaImage and NRRD, and tifffile reads TIFF stacks. Spacing, origin and orientation of a file
become a grid in LPS coordinates, as in ITK. They are in millimetres: x to the left of the patient, y to the back, z to
the head. Landmarks and reports are in these coordinates. Size and type are checked before samples are read. The slices
of a TIFF stack are its pages. Its coordinates are column, row and slice times the spacing from ImageJ, or times 1.

Displacement fields are files that ITK, and so 3D Slicer, elastix and ANTs, read as a transform. A field has a vector
for each voxel of the result: x, y and z in LPS and in the unit of the file. It leads from the voxel to the position in
the source whose value the voxel gets. NIfTI files have the intent `vector`, whose components ITK reads without a change
of sign. Numbers are 32-bit floats.

Positions of voxels are interpolated by cubic splines between exactly mapped nodes. Where the splines are inaccurate,
positions are exact. As for pictures (`codegen.registration.warp`), errors are estimated, not proved: a quarter of the
error of the spline through every second node. Cells with errors above a bound, and their neighbours, are mapped voxel
by voxel. In space a map has a kink at every landmark, so all cells with landmarks are mapped exactly. Nodes are spaced
as equally in all directions as the spacing allows. Only one slab of positions is in memory at a time.
"""

from __future__ import annotations

import gzip
import os
import threading
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation

from codegen.errors import ArgumentError, CodegenError, ImageError
from codegen.registration.grid import Grid, mesh
from codegen.registration.images import SAMPLES, VOLUMES, Pixels, SampleType, library, rational, tifffile
from codegen.registration.pairs import PointArray
from codegen.registration.warp import (
    ORDERS,
    Map,
    cell_errors,
    replacing_volume,
    sample_band,
    spline_at,
    spline_coefficients,
    spline_of,
    spline_on_grid,
)

Array: TypeAlias = NDArray[np.float64]

ITK = "SimpleITK", "which reads and writes volumes,"  # name and purpose of the library, as arguments of `library`
TIFF = (".tif", ".tiff")
WRITTEN = (".nii", ".nii.gz", ".mha", ".mhd", ".nrrd")
_UNCOMPRESSED = (".nii", ".mhd")
MOST_VOXELS = 1 << 30
THINNEST = 2  # fewest samples of a volume along each axis
_IMAGEJ = frozenset(np.dtype(name) for name in ("u1", "u2", "f4"))
"""Sample types of TIFF stacks that ImageJ reads; only such stacks are written with their spacing."""
_UPRIGHT = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_STACK_UNITS = {"micron": "µm", "microns": "µm", "um": "µm", "\\u00b5m": "µm", "pixel": "pixels", "": "pixels"}
_STDERR = threading.Lock()

BOUND = 5e-4
"""Largest error of a position, in finest spacings: half of the promised 0.001 voxels, because fields are rounded."""
LARGEST = 16  # largest distance between nodes, in finest spacings
FEWEST = 6  # fewest intervals between nodes along an axis, so that every second node determines a cubic spline
CHEAP = 12
"""Exactly mapped voxels per node above which half the node distance, with eight times as many nodes, is cheaper."""
CHECKED, NODES_PORTION = 256, 32
"""Cells at whose centres the spline is compared with the map, and the number of cells that are evaluated together."""
BLOCKS_PORTION = 1 << 19  # voxels whose positions are in memory at the same time


@dataclass(frozen=True, eq=False)
class Volume:
    """Samples, shape (slices, rows, columns), and their grid."""

    samples: Pixels
    grid: Grid


class VolumeReader(Protocol):
    """The methods of SimpleITK's ImageFileReader that describe a file."""

    GetSize: Callable[[], tuple[int, ...]]
    GetDimension: Callable[[], int]
    GetSpacing: Callable[[], tuple[float, ...]]
    GetDirection: Callable[[], tuple[float, ...]]
    GetMetaData: Callable[[str], str]


def suffix_of(path: Path, suffixes: tuple[str, ...]) -> str | None:
    """Return the longest of the lower-case suffixes that the file name has, ignoring case, or None if it has none."""
    return max((suffix for suffix in suffixes if path.name.lower().endswith(suffix)), key=len, default=None)


def is_volume(path: Path) -> bool:
    """Return True for a file name with the suffix of a volume, and for a TIFF file of several grey slices."""
    if suffix_of(path, VOLUMES) is not None:
        return True
    if suffix_of(path, TIFF) is None:
        return False
    try:
        with tifffile().TiffFile(path) as file:
            return bool(len(file.series[0].shape) == 3 and file.pages[0].samplesperpixel == 1)
    except Exception:  # reading the file as an image gives a better message
        return False


def read_volume(path: Path, most: int = MOST_VOXELS) -> Volume:
    """Read a volume with one number per voxel.

    Raise ImageError for other files, damaged files, more than `most` voxels, several numbers per voxel, several points
    in time, and axes that are not orthogonal. Raise ExtraError if SimpleITK or tifffile is missing.
    """
    if suffix_of(path, TIFF) is not None:
        return _read_stack(path, most)
    if suffix_of(path, VOLUMES) is None:
        raise ImageError(f"{path}: unknown kind of volume", f"give {', '.join((*VOLUMES, *TIFF))}")
    if not path.is_file():
        raise ImageError(f"{path} cannot be read (no such file)", "give a volume")
    itk = library(*ITK)
    with library_errors(path), silent():
        reader = itk.ImageFileReader()
        reader.SetFileName(str(path))
        reader.ReadImageInformation()
        size = reader.GetSize()
        text = " x ".join(map(str, size))
        if len(size) == 4 and size[3] > 1:
            raise ImageError(f"{path} holds {size[3]} volumes", "save the one to be registered as a file of its own")
        if len(size) not in (3, 4) or min(size[:3]) < THINNEST:
            raise ImageError(f"{path} is no volume: {text} voxels", "save a single slice as PNG or TIFF")
        if int(np.prod(size, dtype=object)) > most:
            raise ImageError(f"{path} has {text} voxels, more than {most}", "give a smaller volume")
        if reader.GetNumberOfComponents() != 1:
            finding = f"{path} has {reader.GetNumberOfComponents()} numbers in each voxel"
            raise ImageError(finding, "give a volume of one number a voxel")
        require_whole(path, reader)
        if reader.GetDimension() == 4:  # with a single point in time
            reader.SetExtractSize((*reader.GetSize()[:3], 0))
        image = reader.Execute()
        samples = itk.GetArrayFromImage(image)
    direction = np.array(image.GetDirection()).reshape(3, 3) + 0.0
    grid = Grid(image.GetSize(), image.GetOrigin(), image.GetSpacing(), tuple(map(tuple, direction.tolist())), "mm")
    return Volume(np.ascontiguousarray(samples), grid)


def _read_stack(path: Path, most: int) -> Volume:
    """Read a TIFF stack; raise ImageError for other files, damaged files and more than `most` voxels."""
    try:
        with tifffile().TiffFile(path) as file:
            series, page = file.series[0], file.pages[0]
            shape = tuple(int(length) for length in series.shape)
            text = " x ".join(map(str, shape))
            if len(shape) != 3 or page.samplesperpixel != 1 or min(shape) < 2:
                remedy = "save it as slices of one number a pixel"
                raise ImageError(f"{path} is no stack of grey slices: {text}", remedy)
            if int(np.prod(shape, dtype=object)) > most:
                raise ImageError(f"{path} has {text} voxels, more than {most}", "give a smaller volume")
            if np.dtype(series.dtype) not in SAMPLES:
                raise ImageError(f"{path} holds samples of {series.dtype}", "save it with integers or 32-bit floats")
            metadata = (file.imagej_metadata if file.is_imagej else None) or {}
            x, y = (rational(page.tags.valueof(tag)) for tag in (282, 283))
            z = float(metadata.get("spacing", 0.0))
            spacing, unit = (1.0, 1.0, 1.0), "pixels"
            if x > 0.0 and y > 0.0 and z > 0.0:
                unit = str(metadata.get("unit", ""))
                spacing, unit = (1.0 / x, 1.0 / y, z), _STACK_UNITS.get(unit, unit)[:12]
            samples = np.ascontiguousarray(series.asarray())
    except CodegenError:
        raise
    except Exception as error:  # for damaged files decoders raise exceptions of almost every class
        reason = getattr(error, "strerror", None) or " ".join(str(error).split())[:160] or type(error).__name__
        raise ImageError(f"{path} cannot be read ({reason})", "give a whole TIFF stack") from error
    grid = Grid(samples.shape[::-1], (0.0, 0.0, 0.0), spacing, _UPRIGHT, unit)
    return Volume(samples.astype(samples.dtype.newbyteorder("="), copy=False), grid)


def require_whole(path: Path, reader: VolumeReader, name: str = "") -> None:
    """Raise ImageError, with `name` for `path`, for a truncated NIfTI file, which SimpleITK would fill with zeros."""
    kind = suffix_of(path, VOLUMES)
    if kind not in (".nii", ".nii.gz"):
        return
    bits, offset = (float(reader.GetMetaData(key)) for key in ("bitpix", "vox_offset"))
    needed = int(np.prod(reader.GetSize(), dtype=object)) * int(bits) // 8 + int(offset)
    size = path.stat().st_size
    if kind == ".nii.gz":
        with gzip.open(path) as file:
            size = 0
            while size < needed and (part := file.read(1 << 22)):  # bytes after the samples are not read
                size += len(part)
    if size < needed:
        raise ImageError(f"{name or path} is cut off: {size} bytes of {needed}", "give a whole file")


@contextmanager
def library_errors(path: Path | str) -> Iterator[None]:
    """Convert exceptions of libraries in this context to an ImageError with the last line of their message."""
    try:
        yield
    except CodegenError:
        raise
    except MemoryError as error:
        raise ImageError(f"{path} does not fit into memory", "give a smaller volume") from error
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ImageError(f"{path} is cut off or damaged ({error})", "give a whole file") from error
    except Exception as error:  # SimpleITK raises RuntimeError for everything
        lines = [line.split("ERROR:")[-1].strip() for line in str(error).splitlines() if line.strip()]
        reason = lines[-1][:160] if lines else type(error).__name__
        if "orthonormal" in str(error):
            raise ImageError(f"{path} has axes that are not orthogonal", "resample it on an upright grid") from error
        raise ImageError(f"{path} is damaged or no volume ({reason})", "give a whole file") from error


@contextmanager
def silent() -> Iterator[None]:
    """Discard the output of C libraries on stderr in this context, which only one thread can enter at a time."""
    with _STDERR:
        stderr, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
        try:
            os.dup2(nowhere, 2)
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            os.close(nowhere)


def require_written(path: Path, dtype: SampleType | None = None) -> None:
    """Raise ImageError for a file name or sample type that cannot be written, ExtraError if the library is missing."""
    kind = suffix_of(path, (*WRITTEN, *TIFF))
    if kind is None or (kind in WRITTEN and not path.name.endswith(kind)):  # SimpleITK accepts no capitals
        raise ImageError(f"{path}: volumes are not written so", f"let it end in {', '.join((*WRITTEN, '.tif'))}")
    library("tifffile" if kind in TIFF else "SimpleITK", *ITK[1:])
    if dtype is not None and kind in TIFF and dtype not in SAMPLES:
        raise ImageError(f"{path}: samples of {dtype} cannot be written", "write NIfTI, MetaImage or NRRD")


def write_volume(path: Path, samples: Pixels, grid: Grid) -> None:
    """Write samples, shape (slices, rows, columns), on a grid in the format of the suffix.

    On failure an existing file remains unchanged. Raise ImageError for an unknown suffix or sample type, and FileError
    if the file cannot be written.
    """
    require_written(path, samples.dtype)
    with replacing_volume(path) as temporary, library_errors(path):
        if not suffix_of(path, TIFF):
            _write_by_itk(temporary, samples, grid)
        elif samples.dtype not in _IMAGEJ:
            tifffile().imwrite(temporary, samples, photometric="minisblack", compression="zlib", metadata=None)
        else:
            x, y, z = grid.spacing
            unit = {"µm": "um", "pixels": "pixel"}.get(grid.unit, grid.unit)
            tifffile().imwrite(
                temporary, samples, imagej=True, resolution=(1.0 / x, 1.0 / y), photometric="minisblack",
                metadata={"axes": "ZYX", "spacing": z, "unit": unit},
            )  # fmt: skip


def require_field(path: Path) -> None:
    """Raise ArgumentError for the name of a displacement field that cannot be written, ExtraError without SimpleITK."""
    if not path.name.endswith(WRITTEN):  # SimpleITK accepts no capitals
        finding = f"--field {path}: displacements of volumes are not written so"
        raise ArgumentError(finding, f"let it end in {', '.join(WRITTEN)}")
    library(*ITK)


def write_field(path: Path, field: NDArray[np.float32], grid: Grid, direction: str = "") -> None:
    """Write a displacement field, shape (slices, rows, columns, 3), on its grid; `direction` is a note in the file."""
    require_field(path)
    with replacing_volume(path) as temporary:
        _write_by_itk(temporary, np.asarray(field), grid, f"displacement {direction}".strip())


def _write_by_itk(path: Path, samples: Pixels, grid: Grid, note: str = "") -> None:
    """Write samples, shape (slices, rows, columns), or vectors, shape (slices, rows, columns, 3), with a `note`."""
    itk, kind = library(*ITK), suffix_of(path, VOLUMES)
    image = itk.GetImageFromArray(samples, isVector=samples.ndim == 4)
    image.SetSpacing(grid.spacing)
    image.SetOrigin(grid.origin)
    image.SetDirection([cosine for row in grid.direction for cosine in row])
    if note:
        image.SetMetaData("descrip" if kind in (".nii", ".nii.gz") else "Comment", note)
    with silent():
        itk.WriteImage(image, str(path), useCompression=kind not in _UNCOMPRESSED)


@dataclass(frozen=True, eq=False)
class Nodes:
    """A coarse grid of nodes, every n-th sample along each axis with n in `steps`, and their exact displacements.

    `function` maps points, shape (n, 3). `lines` has the indices of the nodes along each axis, slices first, and
    `shifts` their displacements, shape (slices, rows, columns, 3). `doubtful` is True for cells between nodes in which
    all voxels are mapped exactly. `bound` is the largest estimated error in the other cells, in the unit of the grid.
    """

    function: Map
    grid: Grid
    steps: tuple[int, ...]
    lines: tuple[Array, ...]
    shifts: Array
    doubtful: NDArray[np.bool_]
    bound: float

    @classmethod
    def of(cls, function: Map, grid: Grid, singular: PointArray, bound: float = BOUND) -> Nodes:
        """Map the nodes, and halve their distance while that reduces the number of evaluations.

        `function` maps points, shape (n, 3), and is not smooth at the points `singular`. `bound` is in finest spacings.
        """
        distance = float(LARGEST)
        while True:
            # Powers of two along columns, rows and slices, whose lengths are about `distance` finest spacings.
            steps = []
            for length, spacing in zip(grid.size, grid.spacing, strict=True):
                step = 2 ** max(0, round(np.log2(distance * grid.pixel / spacing)))
                while step > 1 and FEWEST * step > length:
                    step //= 2
                steps.append(int(step))
            nodes = cls._with_steps(function, grid, tuple(steps), singular, bound * grid.pixel)
            cells = nodes.doubtful.sum() * np.prod(nodes.steps)
            if max(nodes.steps) == 1 or cells <= CHEAP * nodes.shifts[..., 0].size:
                return nodes._checked(bound * grid.pixel)
            distance *= 0.5

    @classmethod
    def _with_steps(
        cls, function: Map, grid: Grid, steps: tuple[int, ...], singular: PointArray, bound: float
    ) -> Nodes:
        lines = tuple(
            step * np.arange(max(FEWEST, 2 * -(-length // (2 * step))) + 1.0)
            for length, step in zip(grid.shape, steps[::-1], strict=True)
        )
        places = grid.to_places(mesh(lines[::-1]))
        shifts = (function(places) - places).reshape(*map(len, lines), 3)
        errors = cell_errors(lines, shifts)
        large = ~(errors <= bound)
        cells = np.floor(grid.to_indices(singular) / steps).astype(int)[:, ::-1]
        inside = ((cells >= 0) & (cells < large.shape)).all(axis=1)
        large[tuple(cells[inside].T)] = True
        doubtful = np.asarray(binary_dilation(large, np.ones((3, 3, 3))))
        return cls(function, grid, steps, lines, shifts, doubtful, float(np.where(doubtful, 0.0, errors).max()))

    def _checked(self, bound: float) -> Nodes:
        """Compare the spline with the map at centres of cells; return nodes with inaccurate cells made doubtful."""
        trusted = np.argwhere(~self.doubtful)
        cells = trusted[np.random.default_rng(0).permutation(len(trusted))[:CHECKED]]
        if not len(cells):
            return self
        steps = np.array(self.steps[::-1])
        cells = cells[((cells + 0.5) * steps <= np.array(self.grid.shape) - 1.0).all(axis=1)]
        if not len(cells):
            return self
        centres = ((cells + 0.5) * steps)[:, ::-1]
        places, values = self.grid.to_places(centres), []
        for k in range(0, len(centres), NODES_PORTION):
            values.append(spline_at(self.lines, self._coefficients, centres[k : k + NODES_PORTION, ::-1]))
        errors = np.linalg.norm(np.concatenate(values) - (self.function(places) - places), axis=1)
        doubtful = self.doubtful.copy()
        doubtful[tuple(cells[~(errors <= bound)].T)] = True
        if (errors > bound).any():
            doubtful = np.asarray(binary_dilation(doubtful, np.ones((3, 3, 3))))
        remaining = max(self.bound, float(errors[errors <= bound].max(initial=0.0)))
        return replace(self, doubtful=doubtful, bound=remaining)

    @property
    def exact(self) -> float:
        """The fraction of samples that are mapped exactly."""
        volumes = [np.diff(np.minimum(line, length)) for line, length in zip(self.lines, self.grid.shape, strict=True)]
        return float(np.einsum("zyx,z,y,x->", self.doubtful.astype(float), *volumes) / self.grid.count)

    @cached_property
    def _coefficients(self) -> Array:
        return spline_coefficients(self.lines, self.shifts)

    def slab(self, part: slice) -> Array:
        """Return the displacements of all samples in the slices `part`, shape (slices, rows, columns, 3)."""
        indices = [np.arange(part.start, part.stop), *(np.arange(length) for length in self.grid.shape[1:])]
        shifts = spline_on_grid(self.lines, self._coefficients, [at.astype(float) for at in indices])
        cells = [np.minimum(at // step, len(line) - 2) for at, step, line in zip(indices, self.steps[::-1], self.lines)]
        exact = np.nonzero(self.doubtful[np.ix_(*cells)])
        if exact[0].size:
            places = self.grid.to_places(np.stack([exact[2], exact[1], exact[0] + part.start], axis=1).astype(float))
            shifts[exact] = self.function(places) - places
        return shifts


@dataclass(frozen=True, eq=False)
class Warped:
    """The warped samples, shape (slices, rows, columns), and the number of positions `outside` the source.

    `field`, shape (slices, rows, columns, 3), has the displacements from the voxels of the result to the positions in
    the source at which their values are read. `field` is None if it was not requested.
    """

    samples: Pixels
    outside: int
    field: NDArray[np.float32] | None


def warped(source: Volume, nodes: Nodes, interpolation: str, with_field: bool = False) -> Warped:
    """Warp a volume to the grid of the nodes, whose map leads from the result to the source.

    The result has the dtype of the source; voxels whose position is outside the source are zero. `with_field` requests
    the displacement field.
    """
    grid, order = nodes.grid, ORDERS[interpolation]
    columns, rows, _ = grid.size
    samples = np.empty(grid.shape, source.samples.dtype)
    field = np.empty((*grid.shape, 3), np.float32) if with_field else None
    layer, outside, done = spline_of(source.samples, order), 0, 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        thickness = max(1, BLOCKS_PORTION // (columns * rows))
        for _, places in grid.portions(thickness * columns * rows):
            part = slice(done, done + len(places) // (columns * rows))
            shifts, done = nodes.slab(part), part.stop
            if field is not None:
                field[part] = shifts
            indices = source.grid.to_indices(places + shifts.reshape(places.shape)).reshape(shifts.shape)

            def one(k: int, first: int = part.start, indices: Array = indices) -> int:
                return sample_band([layer], indices[k], source.samples.shape, order, 0.0, samples[first + k])

            outside += sum(pool.map(one, range(len(indices))))
    return Warped(samples, outside, field)
