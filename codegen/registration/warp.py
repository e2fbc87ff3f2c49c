"""Warped images: every pixel of the result is looked up where the inverse map says that it comes from.

Positions of all pixels from a coarse grid: cubic splines between exactly mapped points, with a measured error. The map
is smooth except at landmarks, where its second derivative grows like a logarithm. So it is mapped exactly at every
`spacing`-th pixel of a grid, and a cubic spline through these points gives all other pixels; but the cells in which the
spline was found to err too much, about landmarks a quarter of that, and their neighbours are mapped exactly, pixel by
pixel.

What is proved and what is sampled: nothing is proved. The error of the spline through every second node in each
direction is measured at all nodes, and a quarter of it is taken for the error of the spline through all of them, since
halving the spacing divides the error of a cubic spline by four where second derivatives are bounded and no more is
known, and by sixteen where the map is smooth. `bound` is the largest of these errors outside the cells that were mapped
exactly, or the largest that was found at the centres of the worst cells, which is `checked`, if that is larger.

Displacement fields: where each pixel goes, or comes from, as arrays and as files that other programs read.

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
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import binary_dilation, maximum_filter

from codegen.errors import ArgumentError, ExtraError, ImageError
from codegen.files import replacing
from codegen.registration.grid import pixel_grid
from codegen.registration.maps import Registration
from codegen.registration.pairs import PointArray

Spacing: TypeAlias = int | Literal["auto"] | None
Map: TypeAlias = Callable[[PointArray], PointArray]

BOUND = 0.01
"""Largest error in pixels that a coarse grid may have where positions are not exact."""
LARGEST, SMALLEST = 32, 2
HALVING = 4.0
"""The least factor by which half the spacing reduces the error of a cubic spline; see above."""
SINGULAR = 4.0
"""How many times smaller an error must be about a landmark, where it varies within a cell."""
PORTION = 1 << 20
"""Pixels that are mapped at once, a whole number of the blocks in which a flow carries points."""
CHECKED = 256
"""Cells at whose centres the spline is compared with exact positions."""


@dataclass(frozen=True, eq=False)
class Positions:
    """Where each pixel of a grid is mapped to, shape (h, w, 2), and how that was found.

    `spacing` is 1 where all pixels were mapped exactly; otherwise `exact` is the share of pixels that were, `bound` the
    largest estimated error of the others, and `checked` that found at the centres of the worst cells, all in pixels.
    """

    places: NDArray[np.float64]
    spacing: int = 1
    exact: float = 1.0
    bound: float = 0.0
    checked: float = 0.0


def map_grid(
    function: Map, shape: Sequence[int], singular: PointArray, spacing: Spacing = None, bound: float = BOUND
) -> Positions:
    """Map every pixel of an image of shape (height, width, ...) by a function of points, exactly or from a coarse grid.

    `singular` are the points, shape (n, 2), at which the function is not smooth. With "auto", the spacing is halved
    until that no longer pays. Raises ArgumentError for a spacing that is no power of two from 2 to 32 and not "auto".
    """
    height, width = int(shape[0]), int(shape[1])
    largest = LARGEST
    while largest > SMALLEST and 6 * largest > min(height, width):
        largest //= 2
    if spacing is None or 6 * largest > min(height, width):
        # Where every pixel is mapped to, shape (h, w, 2), of which few are on their way at once.
        places = np.empty((height * width, 2))
        for begin in range(0, len(places), PORTION):
            rows, columns = np.divmod(np.arange(begin, min(begin + PORTION, len(places))), width)
            places[begin : begin + PORTION] = function(np.stack([columns, rows], axis=1).astype(float))
        return Positions(places.reshape(height, width, 2))
    if spacing == "auto":
        # Halve the spacing while the pixels to be mapped exactly are more than the nodes that halving would add.
        grid = _Grid.exact(function, ((height, width)), largest)
        while grid.spacing > SMALLEST:
            doubtful = grid.doubtful(grid.errors(), singular, bound)
            if doubtful.sum() * grid.spacing**2 <= 3 * grid.shifts[..., 0].size:
                break
            grid = grid.refined(function)
        return _completed(function, grid, singular, bound)
    if spacing not in (2, 4, 8, 16, 32):
        raise ArgumentError(f"the spacing is {spacing!r}", "give 2, 4, 8, 16, 32 or auto")
    return _completed(function, _Grid.exact(function, (height, width), min(spacing, largest)), singular, bound)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Exactly mapped nodes, from pixel 0 to beyond the last, an even number of cells in each direction.

    `shifts`, shape (rows, columns, 2), are what the function adds to the nodes: where that is nothing, splines keep it.
    """

    shape: tuple[int, int]
    spacing: int
    x: NDArray[np.float64]
    y: NDArray[np.float64]
    shifts: NDArray[np.float64]

    @classmethod
    def exact(cls, function: Map, shape: tuple[int, int], spacing: int) -> _Grid:
        y, x = (_nodes(length, spacing) for length in shape)
        nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return cls(shape, spacing, x, y, (function(nodes) - nodes).reshape(y.size, x.size, 2))

    def refined(self, function: Map) -> _Grid:
        """The grid of half the spacing; only what is new is mapped."""
        shape, spacing = self.shape, self.spacing // 2
        y, x = (_nodes(length, spacing) for length in shape)
        shifts = np.full((y.size, x.size, 2), np.nan)
        rows, columns = min(self.y.size, (y.size + 1) // 2), min(self.x.size, (x.size + 1) // 2)
        shifts[: 2 * rows : 2, : 2 * columns : 2] = self.shifts[:rows, :columns]
        new = np.isnan(shifts[..., 0])
        nodes = np.stack(np.meshgrid(x, y), axis=-1)
        shifts[new] = function(nodes[new]) - nodes[new]
        return _Grid(shape, spacing, x, y, shifts)

    def errors(self) -> NDArray[np.float64]:
        """The spline's estimated error about each node, shape (rows, columns), in pixels."""
        coarse = spline(self.y[::2], self.x[::2], self.shifts[::2, ::2], self.y, self.x)
        return np.asarray(np.linalg.norm(coarse - self.shifts, axis=-1) / HALVING)

    def doubtful(self, errors: NDArray[np.float64], singular: PointArray, bound: float) -> NDArray[np.bool_]:
        """Cells with a corner of large error, or a singular point and an error that is not small; and neighbours."""
        at_cells = _at_cells(errors)
        large = ~(at_cells <= bound)
        columns, rows = np.floor(singular / self.spacing).astype(int).T
        inside = (rows >= 0) & (rows < large.shape[0]) & (columns >= 0) & (columns < large.shape[1])
        rows, columns = rows[inside], columns[inside]
        large[rows, columns] |= ~(maximum_filter(at_cells, 3)[rows, columns] <= bound / SINGULAR)
        return np.asarray(binary_dilation(large, np.ones((3, 3))))

    def pixels(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """The pixels that lie in cells."""
        wide = np.repeat(np.repeat(cells, self.spacing, axis=0), self.spacing, axis=1)
        return np.asarray(wide[: self.shape[0], : self.shape[1]])


def _at_cells(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(maximum_filter(errors, size=(2, 2), origin=-1)[:-1, :-1])


def _nodes(length: int, spacing: int) -> NDArray[np.float64]:
    cells = 2 * -(-length // (2 * spacing))
    return spacing * np.arange(cells + 1.0)


def _completed(function: Map, grid: _Grid, singular: PointArray, bound: float) -> Positions:
    errors = grid.errors()
    doubtful = grid.doubtful(errors, singular, bound)
    height, width = grid.shape
    places = spline(grid.y, grid.x, grid.shifts, np.arange(height), np.arange(width))
    places[..., 0] += np.arange(width)
    places[..., 1] += np.arange(height)[:, None]
    rows, columns = np.nonzero(grid.pixels(doubtful))
    if rows.size:
        places[rows, columns] = function(np.stack([columns, rows], axis=1).astype(float))
    remaining = np.where(doubtful, 0.0, _at_cells(errors))
    checked = _checked(function, grid, remaining)
    found = max(float(remaining.max()), checked)
    return Positions(places, grid.spacing, rows.size / (height * width), found, checked)


def _checked(function: Map, grid: _Grid, remaining: NDArray[np.float64]) -> float:
    """The largest error of the spline at the centres of the cells in which the largest errors were measured."""
    worst = np.argsort(remaining, axis=None)[-CHECKED:]
    worst = worst[remaining.ravel()[worst] > 0.0]
    if not worst.size:
        return 0.0
    rows, columns = np.unravel_index(worst, remaining.shape)
    x, y = (columns + 0.5) * grid.spacing, (rows + 0.5) * grid.spacing
    centres = np.stack([x, y], axis=1)
    exact = function(centres) - centres
    along_rows = basis(grid.y, y) @ _coefficients(grid.y, grid.x, grid.shifts).reshape(grid.y.size, -1)
    weights = basis(grid.x, x).toarray()
    found = np.einsum("nmc,nm->nc", along_rows.reshape(len(x), grid.x.size, 2), weights)
    return float(np.linalg.norm(found - exact, axis=1).max())


def spline(
    y: NDArray[np.float64], x: NDArray[np.float64], values: NDArray[np.float64], to_y: Any, to_x: Any
) -> NDArray[np.float64]:
    """The cubic spline through values on a grid of y and x, shape (rows, columns, 2), at every y of every x of another.

    Its ends are such that the first two cells in each direction share a cubic ("not a knot").
    """
    coefficients = _coefficients(y, x, values)
    along, across = basis(y, to_y), basis(x, to_x)
    rows, columns = len(to_y), len(to_x)
    out = np.empty((rows, columns, 2))
    for component in range(2):
        out[..., component] = (across @ (along @ coefficients[..., component]).T).T
    return out


def _coefficients(y: NDArray[np.float64], x: NDArray[np.float64], values: NDArray[np.float64]) -> Any:
    by_rows = make_interp_spline(y, values, k=3, axis=0).c
    return np.moveaxis(make_interp_spline(x, np.moveaxis(by_rows, 1, 0), k=3, axis=0).c, 0, 1)


def basis(nodes: NDArray[np.float64], at: Any) -> Any:
    """The values of the cubic B-splines of nodes at some places, a sparse matrix."""
    knots = np.concatenate([[nodes[0]] * 4, nodes[2:-2], [nodes[-1]] * 4])
    return BSpline.design_matrix(np.asarray(at, dtype=float), knots, 3).tocsr()


Interpolation: TypeAlias = Literal["nearest", "linear", "cubic"]
ORDERS: dict[str, int] = {"nearest": 0, "linear": 1, "cubic": 3}

BAND_ROWS = 64
"""Rows of the result that one thread looks up at a time."""
SPLINE_PADDING = 12
"""Pixels by which an image is continued before a spline is fitted, as scipy.ndimage does it for this kind of edge."""


@dataclass(frozen=True)
class WarpReport:
    """How positions were found: at every pixel, or from every `spacing`-th and a share of the others, `exact`.

    `bound` is the largest error, in pixels, of a position that was interpolated; see `codegen.registration.warp`.
    `outside` counts the pixels of the result that come from outside the image.
    """

    spacing: int
    exact: float
    bound: float
    outside: int


def warp(
    pixels: Any,
    registration: Registration,
    *,
    interpolation: Interpolation = "linear",
    inverse: bool = False,
    shape: Sequence[int] | None = None,
    spacing: Spacing = None,
    bound: float = BOUND,
    fill: float = 0.0,
    time: float = 1.0,
    positions: Positions | None = None,
) -> NDArray[Any]:
    """The moving image in the frame of the fixed one, or with `inverse` the fixed image in that of the moving one.

    `pixels` has shape (height, width) or (height, width, channels); what is returned has the dtype of `pixels` and
    the size `shape`, by default that of the other image. Pixels that come from outside the image are `fill`. With a
    `spacing`, a number of pixels or "auto", positions are interpolated from a coarse grid where that errs by less than
    `bound` pixels. `time` is that of `Registration.positions`. Where pixels come from is not computed again if it is
    given as `positions`, as by `certify_with_positions`; then `inverse`, `shape`, `spacing` and `time` have no effect.

    Raises ImageError for an array that is no image, ArgumentError for an unknown interpolation or spacing.
    """
    return warp_reported(
        pixels, registration, interpolation=interpolation, inverse=inverse, shape=shape, spacing=spacing, bound=bound,
        fill=fill, time=time, positions=positions,
    )[0]  # fmt: skip


def warp_reported(
    pixels: Any,
    registration: Registration,
    *,
    interpolation: Interpolation = "linear",
    inverse: bool = False,
    shape: Sequence[int] | None = None,
    spacing: Spacing = None,
    bound: float = BOUND,
    fill: float = 0.0,
    time: float = 1.0,
    positions: Positions | None = None,
) -> tuple[NDArray[Any], WarpReport]:
    """The same as `warp`, and a report."""
    image = np.asarray(pixels)
    if interpolation not in ORDERS:
        raise ArgumentError(f"interpolation is {interpolation!r}", f"use {', '.join(ORDERS)}")
    if image.ndim not in (2, 3) or image.size == 0:
        raise ImageError(f"the image has shape {image.shape}", "give (height, width) or (height, width, channels)")
    if image.dtype.kind not in "uif":
        raise ImageError(f"the image's values are of type {image.dtype}", "give integers or floating-point numbers")
    default = registration.shape if inverse else registration.fixed_shape
    found = positions or sources(registration, default if shape is None else shape, inverse, spacing, bound, time)
    warped, outside = sample(image, found.places, ORDERS[interpolation], fill)
    return warped, WarpReport(found.spacing, found.exact, found.bound, outside)


def sources(
    registration: Registration,
    shape: Sequence[int],
    inverse: bool = False,
    spacing: Spacing = None,
    bound: float = BOUND,
    time: float = 1.0,
) -> Positions:
    """Where each pixel of a warped image comes from: of the fixed frame by the inverse map, or the other way about."""
    pairs = registration.pairs
    singular = pairs.moving if inverse else registration.positions(time, pairs.moving)

    def function(xy: PointArray) -> PointArray:
        return registration.positions(time, xy, inverse=not inverse)

    return map_grid(function, shape, singular, spacing, bound)


def sample(image: NDArray[Any], sources: NDArray[np.float64], order: int, fill: float) -> tuple[NDArray[Any], int]:
    """The image at positions (x, y), shape (h, w, 2), by splines of the given order; and how many lie outside.

    A pixel reaches half a pixel about its centre; what lies beyond the outermost centres, but within their pixels, has
    the value at the edge.
    """
    layers = [spline_of(image[(..., *channel)], order) for channel in np.ndindex(image.shape[2:])]
    warped = np.empty((*sources.shape[:2], *image.shape[2:]), image.dtype)

    def band(rows: slice) -> int:
        return sample_band(layers, sources[rows], image.shape, order, fill, warped[rows])

    # Interpolation holds no lock, and a band's places stay in the processor's cache.
    bands = [slice(k, k + BAND_ROWS) for k in range(0, len(warped), BAND_ROWS)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return warped, sum(pool.map(band, bands))


def spline_of(layer: NDArray[Any], order: int) -> NDArray[Any]:
    """What is interpolated: the values, or the coefficients of the cubic spline through them, beyond the edges, too."""
    if order < 2:
        return layer
    wide = np.pad(layer.astype(np.float64), SPLINE_PADDING, mode="edge")
    return np.asarray(scipy.ndimage.spline_filter(wide, order, mode="nearest"))


def sample_band(
    layers: Sequence[NDArray[Any]], sources: NDArray[np.float64], shape: Sequence[int], order: int, fill: float,
    warped: NDArray[Any],
) -> int:  # fmt: skip
    """Fill some rows of the result, or of a slice, from places (x, y, ...); how many pixels come from outside."""
    axes = sources.shape[-1]
    places = np.moveaxis(sources[..., ::-1], -1, 0).copy()
    outside = np.zeros(sources.shape[:-1], np.bool_)
    for place, length in zip(places, shape[:axes], strict=True):
        outside |= ~((place >= -0.5) & (place <= length - 0.5))
        np.clip(place, 0.0, length - 1.0, out=place)
    places += SPLINE_PADDING if order > 1 else 0
    for channel, layer in zip(np.ndindex(tuple(shape[axes:])), layers, strict=True):
        values = scipy.ndimage.map_coordinates(
            layer, places, order=order, mode="nearest", prefilter=False,
            output=warped.dtype if order == 0 else np.float64,
        )  # fmt: skip
        warped[(..., *channel)] = as_type(values, warped.dtype)
    if outside.any():
        warped[outside] = as_type(np.float64(fill), warped.dtype)
    return int(outside.sum())


def as_type(values: Any, dtype: np.dtype[Any]) -> Any:
    """Values of another type: rounded to the nearest integer and clipped to what the type holds."""
    if values.dtype == dtype or not np.issubdtype(dtype, np.integer):
        return values.astype(dtype, copy=False)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)


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
