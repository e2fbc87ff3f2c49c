"""The effect of a map on all pixels of an image: positions, warped images and displacement fields.

Every pixel of a warped image gets the value of the image at the position that the inverse map assigns to the pixel.

Positions from a coarse grid: the map is smooth except at landmarks, where its second derivative grows like a logarithm.
The map is evaluated at every `spacing`-th pixel, and a cubic spline through these nodes gives the positions of other
pixels. Cells in which the error of the spline is above a bound, and their neighbours, are evaluated pixel by pixel. The
bound is four times smaller in cells with landmarks.

The error of the spline is estimated, not proved. The error of the spline through every second node in each direction is
measured at all nodes. A quarter of this error is the estimate for the spline through all nodes. The reason: half the
spacing divides the error of a cubic spline by four if second derivatives are bounded, and by sixteen where the map is
smooth. In addition the spline is compared with the map at the centres of the cells with the largest errors.

Displacement fields: a field on the fixed frame, made with `inverse=True`, is the input of resampling programs such as
ITK. Added to the position of a fixed pixel, it gives the position in the moving image. NIfTI, MetaImage and NRRD files
have one voxel of size 1 per pixel, the origin at the centre of the top-left pixel, and vectors (x, y) in pixels. Axes
are the axes of ITK: x to the left of the patient and y to the back. So no sign changes between the array and ITK.

MetaImage in two files consists of a header, `.mhd`, and the file of samples that the header names. Written headers
name `stem.raw`, which holds numbers without compression, so that any program can read them.
"""

from __future__ import annotations

import gzip
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import scipy.ndimage
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, make_interp_spline
from scipy.ndimage import binary_dilation, maximum_filter
from scipy.sparse import csr_array

from codegen.errors import ArgumentError, ImageError
from codegen.files import replacing
from codegen.registration.grid import grid_of, pixel_grid
from codegen.registration.images import Pixels, SampleType, library
from codegen.registration.maps import Registration
from codegen.registration.pairs import PointArray

Spacing: TypeAlias = int | Literal["auto"] | None
Map: TypeAlias = Callable[[PointArray], PointArray]
Interpolation: TypeAlias = Literal["nearest", "linear", "cubic"]
Array: TypeAlias = NDArray[np.float64]

ORDERS: dict[str, int] = {"nearest": 0, "linear": 1, "cubic": 3}
BOUND = 0.01  # largest error, in pixels, of positions from a coarse grid
LARGEST, SMALLEST = 32, 2  # most and fewest pixels between nodes
HALVING = 4.0
"""The least factor by which half the spacing reduces the error of a cubic spline; see the module's docstring."""
SINGULAR = 4.0
"""The factor by which the error bound is smaller in cells with a landmark, where the error varies within a cell."""
PORTION = 1 << 20  # pixels that are mapped at once: a multiple of the block size of the flow
CHECKED = 256  # cells at whose centres the spline is compared with the map
BAND_ROWS = 64  # rows of the result that one thread fills at a time
SPLINE_PADDING = 12
"""Pixels of padding at each edge before a spline is fitted, as in scipy.ndimage for this boundary mode."""

FIELD_KINDS = (".npz", ".nii", ".nii.gz", ".mha", ".mhd", ".nrrd")
_FIELDS = "which writes this kind of file,"
_NIFTI_VECTOR = "vector"  # the intent whose components ITK takes without a change of sign
_META_HEADER, _META_SAMPLES, _META_KEY = ".mhd", ".raw", "ElementDataFile"
_SAMPLE_KEYS = {_META_HEADER: ("=", (_META_KEY,)), ".nhdr": (":", ("data file", "datafile"))}
"""The separator of keys and values, and the keys that name the file of samples, by suffix of the header."""
_MOST_HEADER = 1 << 16  # bytes of a header file that are searched for keys


@dataclass(frozen=True, eq=False)
class Positions:
    """The positions to which the pixels of a grid are mapped, shape (h, w, 2), and their accuracy.

    `spacing` is the number of pixels between nodes, or 1 if all pixels were mapped exactly. `exact` is the fraction of
    pixels in exactly mapped cells. `bound` is the largest error of the other pixels, in pixels, either estimated or
    measured at the centres of the cells with the largest errors.
    """

    places: Array
    spacing: int = 1
    exact: float = 1.0
    bound: float = 0.0


@dataclass(frozen=True)
class WarpReport:
    """The accuracy of a warped image.

    `spacing`, `exact` and `bound` are as in `Positions`. `outside` is the number of pixels of the result whose position
    is outside the image.
    """

    spacing: int
    exact: float
    bound: float
    outside: int


def warp(
    pixels: ArrayLike,
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
) -> Pixels:
    """Warp the moving image to the frame of the fixed image.

    Parameters
    ----------
    pixels : array, shape (height, width) or (height, width, channels)
        The moving image, or the fixed image with `inverse`.
    registration : Registration
        The map.
    interpolation : {"nearest", "linear", "cubic"}
        The order of the splines through the pixels: 0, 1 or 3.
    inverse : bool
        Warp the fixed image to the frame of the moving image.
    shape : sequence of int, optional
        Height and width of the result; by default of the other image.
    spacing : int or "auto", optional
        Pixels between the nodes of a coarse grid that interpolates positions; by default all positions are exact.
    bound : float
        The largest error of an interpolated position, in pixels.
    fill : float
        The value of pixels whose position is outside the image.
    time : float
        The time of `Registration.positions`, from 0 to 1.
    positions : Positions, optional
        Positions from `certify_with_positions`, which make `inverse`, `shape`, `spacing` and `time` ineffective.

    Returns
    -------
    array
        The warped image, with the dtype of `pixels`.

    Raises
    ------
    ImageError
        If the array is no image.
    ArgumentError
        For an unknown interpolation or spacing.
    """
    return warp_reported(
        pixels, registration, interpolation=interpolation, inverse=inverse, shape=shape, spacing=spacing, bound=bound,
        fill=fill, time=time, positions=positions,
    )[0]  # fmt: skip


def warp_reported(
    pixels: ArrayLike, registration: Registration, *, interpolation: Interpolation = "linear", inverse: bool = False,
    shape: Sequence[int] | None = None, spacing: Spacing = None, bound: float = BOUND, fill: float = 0.0,
    time: float = 1.0, positions: Positions | None = None,
) -> tuple[Pixels, WarpReport]:  # fmt: skip
    """Warp an image as `warp` does, and return the image and a report of its accuracy."""
    image = np.asarray(pixels)
    if interpolation not in ORDERS:
        raise ArgumentError(f"interpolation is {interpolation!r}", f"use {', '.join(ORDERS)}")
    if image.ndim not in (2, 3) or image.size == 0:
        raise ImageError(f"the image has shape {image.shape}", "give (height, width) or (height, width, channels)")
    if image.dtype.kind not in "uif":
        raise ImageError(f"the image's values are of type {image.dtype}", "give integers or floating-point numbers")
    if positions is None:
        default = (registration.grid if inverse else registration.fixed_grid).shape
        positions = sources(registration, default if shape is None else shape, inverse, spacing, bound, time)
    places, order = positions.places, ORDERS[interpolation]
    layers = [spline_of(image[(..., *channel)], order) for channel in np.ndindex(image.shape[2:])]
    warped = np.empty((*places.shape[:2], *image.shape[2:]), image.dtype)

    def band(rows: slice) -> int:
        return sample_band(layers, places[rows], image.shape, order, fill, warped[rows])

    # Interpolation holds no lock, and the positions of a band fit into the cache of the processor.
    bands = [slice(k, k + BAND_ROWS) for k in range(0, len(warped), BAND_ROWS)]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        outside = sum(pool.map(band, bands))
    return warped, WarpReport(positions.spacing, positions.exact, positions.bound, outside)


def sources(
    registration: Registration,
    shape: Sequence[int],
    inverse: bool = False,
    spacing: Spacing = None,
    bound: float = BOUND,
    time: float = 1.0,
) -> Positions:
    """Return the position in the source image of each pixel of a warped image; arguments are as in `warp`."""
    pairs = registration.pairs
    singular = pairs.moving if inverse else registration.positions(time, pairs.moving)

    def function(xy: PointArray) -> PointArray:
        return registration.positions(time, xy, inverse=not inverse)

    return map_grid(function, shape, singular, spacing, bound)


def displacement_field(
    registration: Registration, shape: Sequence[int] | None = None, inverse: bool = False, *, spacing: Spacing = None
) -> Array:
    """Return the displacements of all pixels of the moving image.

    Parameters
    ----------
    registration : Registration
        The map.
    shape : sequence of int, optional
        Height and width of the field; by default of the moving image, or of the fixed image with `inverse`.
    inverse : bool
        Return the displacements of the inverse map at the pixels of the fixed image.
    spacing : int or "auto", optional
        The spacing of a coarse grid, as in `warp`.

    Returns
    -------
    array, shape (h, w, 2)
        (dx, dy) in pixels.
    """
    default = (registration.fixed_grid if inverse else registration.grid).shape
    height, width = (int(length) for length in tuple(default if shape is None else shape)[:2])
    function = registration.map_points_inverse if inverse else registration.map_points
    singular = registration.pairs.fixed if inverse else registration.pairs.moving
    return displacements(map_grid(function, (height, width), singular, spacing))


def displacements(positions: Positions) -> Array:
    """Return the vectors from pixels to their positions, shape (h, w, 2)."""
    return np.asarray(positions.places - pixel_grid(positions.places.shape).reshape(positions.places.shape))


def write_field(path: Path | str, field: Array, direction: str = "") -> None:
    """Write a displacement field in the format of its suffix.

    Parameters
    ----------
    path : Path or str
        The name ends in .npz, .nii, .nii.gz, .mha, .mhd or .nrrd.
    field : array, shape (h, w, 2)
        The displacements (dx, dy) in pixels.
    direction : str
        A note in the file.

    Raises
    ------
    ArgumentError
        For another suffix.
    ImageError
        If the array has another shape.
    ExtraError
        If the library is missing: nibabel for NIfTI, SimpleITK for MetaImage and NRRD.
    FileError
        If the file cannot be written.
    """
    path, values = Path(path), np.asarray(field, dtype=np.float64)
    if values.ndim != 3 or values.shape[2] != 2:
        raise ImageError(f"the displacement field has shape {values.shape}", "give (height, width, 2)")
    kind = next((kind for kind in reversed(FIELD_KINDS) if path.name.endswith(kind)), None)
    if kind is None:
        raise ArgumentError(f"{path}: unknown kind of displacement field", f"let it end in {', '.join(FIELD_KINDS)}")
    with replacing_volume(path) as temporary:
        if kind == ".npz":
            np.savez_compressed(temporary, displacement=values, direction=np.array(direction))
        elif kind in (".nii", ".nii.gz"):
            # Axes x, y, z, t, component; x and y of NIfTI are opposite to x and y of ITK.
            data = np.ascontiguousarray(values.transpose(1, 0, 2)[:, :, None, None, :])
            nifti = library("nibabel", _FIELDS).Nifti1Image(data, np.diag([-1.0, -1.0, 1.0, 1.0]))
            nifti.header.set_intent(_NIFTI_VECTOR)
            nifti.header["descrip"] = f"displacement {direction}".strip().encode()[:79]
            content = nifti.to_bytes()
            temporary.write_bytes(gzip.compress(content, 6) if temporary.suffix.lower() == ".gz" else content)
        else:
            itk = library("SimpleITK", _FIELDS)
            image = itk.GetImageFromArray(np.ascontiguousarray(values), isVector=True)
            if direction:
                image.SetMetaData("Comment", f"displacement {direction}")
            itk.WriteImage(image, str(temporary), useCompression=written_with(temporary) is None)


def written_with(path: Path) -> Path | None:
    """Return the file of samples that is written with the header `path`; None for formats with a single file."""
    return path.with_suffix(_META_SAMPLES) if path.suffix.lower() == _META_HEADER else None


def read_with(path: Path) -> Path | None:
    """Return the file of samples that the header `path` names; None without such a name, or if it is unreadable."""
    separator, keys = _SAMPLE_KEYS.get(path.suffix.lower(), ("", ()))
    if not keys:
        return None
    try:
        with path.open("rb") as file:
            lines = file.read(_MOST_HEADER).decode("latin-1").splitlines()
    except OSError:
        return None  # reading the volume reports the error
    parts = (line.partition(separator) for line in lines)
    names = [value.strip() for key, _, value in parts if key.strip() in keys]
    return path.parent / names[-1] if names and names[-1] not in ("", "LOCAL", "LIST") else None


@contextmanager
def replacing_volume(path: Path) -> Iterator[Path]:
    """Yield a path whose content replaces a volume as in `codegen.files.replacing`, a header after its samples."""
    samples = written_with(path)
    if samples is None:
        with replacing(path) as temporary:
            yield temporary
        return
    with replacing(path) as header, replacing(samples) as temporary:
        made = header.with_suffix(_META_SAMPLES)
        try:
            yield header
            made.replace(temporary)
            text = header.read_text(encoding="latin-1")
            line = f"{_META_KEY} = {made.name}"
            header.write_text(text.replace(line, f"{_META_KEY} = {samples.name}"), encoding="latin-1")
        finally:
            made.unlink(missing_ok=True)


def map_grid(
    function: Map, shape: Sequence[int], singular: PointArray, spacing: Spacing = None, bound: float = BOUND
) -> Positions:
    """Map every pixel of an image of shape (height, width, ...) by a function of points, shape (n, 2).

    `singular` are the points, shape (n, 2), at which the function is not smooth. If `spacing` is None, all pixels are
    mapped exactly. "auto" halves the spacing while that reduces the number of evaluations. `bound` is the largest
    error in pixels. Raise ArgumentError for a spacing other than "auto" and the powers of two from 2 to 32.
    """
    height, width = int(shape[0]), int(shape[1])
    largest = LARGEST
    while largest > SMALLEST and 6 * largest > min(height, width):
        largest //= 2
    if spacing is None or 6 * largest > min(height, width):
        places = np.empty((height * width, 2))
        for part, pixels in grid_of((height, width)).portions(PORTION):
            places[part] = function(pixels)
        return Positions(places.reshape(height, width, 2))
    if spacing == "auto":
        # Halve the spacing while the pixels to be mapped exactly are more than the nodes that halving would add.
        grid = _Grid.of(function, (height, width), largest)
        while grid.spacing > SMALLEST:
            doubtful = grid.doubtful(cell_errors((grid.y, grid.x), grid.shifts), singular, bound)
            if doubtful.sum() * grid.spacing**2 <= 3 * grid.shifts[..., 0].size:
                break
            grid = _Grid.of(function, grid.shape, grid.spacing // 2, grid)
        return grid.completed(function, singular, bound)
    if spacing not in (2, 4, 8, 16, 32):
        raise ArgumentError(f"the spacing is {spacing!r}", "give 2, 4, 8, 16, 32 or auto")
    return _Grid.of(function, (height, width), min(spacing, largest)).completed(function, singular, bound)


@dataclass(frozen=True, eq=False)
class _Grid:
    """Exactly mapped nodes, `spacing` pixels apart, from pixel 0 to beyond the last pixel, with even numbers of cells.

    `shifts`, shape (rows, columns, 2), are the displacements of the nodes; splines keep zero displacements exactly.
    """

    shape: tuple[int, int]
    spacing: int
    x: Array
    y: Array
    shifts: Array

    @classmethod
    def of(cls, function: Map, shape: tuple[int, int], spacing: int, coarser: _Grid | None = None) -> _Grid:
        """Map all nodes; displacements of nodes of a `coarser` grid, with twice the spacing, are copied."""
        y, x = (spacing * np.arange(2 * -(-length // (2 * spacing)) + 1.0) for length in shape)
        shifts = np.full((y.size, x.size, 2), np.nan)
        if coarser is not None:
            rows, columns = min(coarser.y.size, (y.size + 1) // 2), min(coarser.x.size, (x.size + 1) // 2)
            shifts[: 2 * rows : 2, : 2 * columns : 2] = coarser.shifts[:rows, :columns]
        new = np.isnan(shifts[..., 0])
        nodes = np.stack(np.meshgrid(x, y), axis=-1)
        shifts[new] = function(nodes[new]) - nodes[new]
        return cls(shape, spacing, x, y, shifts)

    def doubtful(self, errors: Array, singular: PointArray, bound: float) -> NDArray[np.bool_]:
        """Mark cells with errors above `bound`, cells with a singular point and moderate errors, and all neighbours."""
        large = ~(errors <= bound)
        columns, rows = np.floor(singular / self.spacing).astype(int).T
        inside = (rows >= 0) & (rows < large.shape[0]) & (columns >= 0) & (columns < large.shape[1])
        rows, columns = rows[inside], columns[inside]
        large[rows, columns] |= ~(maximum_filter(errors, 3)[rows, columns] <= bound / SINGULAR)
        return np.asarray(binary_dilation(large, np.ones((3, 3))))

    def completed(self, function: Map, singular: PointArray, bound: float) -> Positions:
        """Return the positions of all pixels, interpolated or, in doubtful cells, mapped exactly."""
        height, width = self.shape
        lines = self.y, self.x
        errors, coefficients = cell_errors(lines, self.shifts), spline_coefficients(lines, self.shifts)
        doubtful = self.doubtful(errors, singular, bound)
        places = spline_on_grid(lines, coefficients, (np.arange(float(height)), np.arange(float(width))))
        places[..., 0] += np.arange(width)
        places[..., 1] += np.arange(height)[:, None]
        pixels = np.repeat(np.repeat(doubtful, self.spacing, axis=0), self.spacing, axis=1)[:height, :width]
        rows, columns = np.nonzero(pixels)
        if rows.size:
            places[rows, columns] = function(np.stack([columns, rows], axis=1).astype(float))
        exact = rows.size / (height * width)
        # The largest error of the spline at the centres of the cells with the largest errors.
        remaining, checked = np.where(doubtful, 0.0, errors), 0.0
        worst = np.argsort(remaining, axis=None)[-CHECKED:]
        worst = worst[remaining.ravel()[worst] > 0.0]
        if worst.size:
            rows, columns = np.unravel_index(worst, remaining.shape)
            centres = np.asarray((np.stack([columns, rows], axis=1) + 0.5) * self.spacing, dtype=float)
            interpolated = spline_at(lines, coefficients, centres[:, ::-1])
            checked = float(np.linalg.norm(interpolated - (function(centres) - centres), axis=1).max())
        return Positions(places, self.spacing, exact, max(float(remaining.max()), checked))


def cell_errors(lines: Sequence[Array], shifts: Array) -> Array:
    """Estimate the error of the spline through `shifts` (*lengths of lines, c) in each cell, the largest at corners.

    The estimate at a node is the error of the spline through every second node, divided by HALVING.
    """
    coarse = shifts[tuple(slice(None, None, 2) for _ in lines)]
    for axis, line in enumerate(lines):
        coarse = np.asarray(make_interp_spline(line[::2], coarse, k=3, axis=axis)(line))
    errors = maximum_filter(np.linalg.norm(coarse - shifts, axis=-1) / HALVING, size=2, origin=-1)
    return np.asarray(errors[tuple(slice(-1) for _ in lines)])


def spline_coefficients(lines: Sequence[Array], values: Array) -> Array:
    """Return coefficients of the cubic spline ("not a knot") through values on a grid, shape (*lengths of lines, c)."""
    for axis, line in enumerate(lines):
        values = np.moveaxis(make_interp_spline(line, np.moveaxis(values, axis, 0), k=3).c, 0, axis)
    return values


def spline_on_grid(lines: Sequence[Array], coefficients: Array, points: Sequence[Array]) -> Array:
    """Evaluate the spline with nodes `lines` on another grid, whose coordinates along each axis are `points`."""
    bases = [basis(line, at) for line, at in zip(lines, points, strict=True)]
    out = np.empty((*map(len, points), coefficients.shape[-1]))
    for component in range(out.shape[-1]):
        values = coefficients[..., component]
        for axis, matrix in enumerate(bases):
            first = np.moveaxis(values, axis, 0)
            values = np.moveaxis((matrix @ first.reshape(len(first), -1)).reshape(-1, *first.shape[1:]), 0, axis)
        out[..., component] = values
    return out


def spline_at(lines: Sequence[Array], coefficients: Array, points: Array) -> Array:
    """Evaluate the spline with nodes `lines` at points, shape (n, d), whose coordinates have the order of `lines`."""
    (line, *others), (at, *rest) = lines, points.T
    values = (basis(line, at) @ coefficients.reshape(len(line), -1)).reshape(len(points), *coefficients.shape[1:])
    for line, at in zip(others, rest, strict=True):
        values = np.einsum("nk...,nk->n...", values, basis(line, at).toarray())
    return np.asarray(values)


def basis(nodes: Array, at: Array) -> csr_array:
    """Return the values of the cubic B-splines of nodes (columns) at the points `at` (rows), a sparse matrix."""
    knots = np.concatenate([[nodes[0]] * 4, nodes[2:-2], [nodes[-1]] * 4])
    return BSpline.design_matrix(at, knots, 3).tocsr()


def spline_of(layer: Pixels, order: int) -> Pixels:
    """Return the image for `order` below 2, or else coefficients of the spline through the padded image."""
    if order < 2:
        return layer
    wide = np.pad(layer.astype(np.float64), SPLINE_PADDING, mode="edge")
    return np.asarray(scipy.ndimage.spline_filter(wide, order, mode="nearest"))


def sample_band(
    layers: Sequence[Pixels], sources: Array, shape: Sequence[int], order: int, fill: float, warped: Pixels
) -> int:
    """Fill the rows `warped` of the result with values of the image at `sources`, and count pixels from outside.

    `layers` are channels from `spline_of`, `shape` the shape of the image and `sources` positions (x, y, ...). A pixel
    reaches half a pixel from its centre; beyond the outermost centres the image has the value at the edge.
    """
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
        warped[(..., *channel)] = _as_type(values, warped.dtype)
    if outside.any():
        warped[outside] = _as_type(np.array(fill, dtype=float), warped.dtype)
    return int(outside.sum())


def _as_type(values: Pixels, dtype: SampleType) -> Pixels:
    """Convert values: for integers round to nearest and clip to the range of the type."""
    if values.dtype == dtype or not np.issubdtype(dtype, np.integer):
        return values.astype(dtype, copy=False)
    limits = np.iinfo(dtype)
    return np.clip(np.rint(values), limits.min, limits.max).astype(dtype)
