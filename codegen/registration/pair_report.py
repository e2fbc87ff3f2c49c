"""The outcome of one registration, and its report: an HTML page with pictures, certificate and landmarks.

The page of a pair of volumes shows orthogonal slices of the volumes and of det J, the determinant of the Jacobian.
"""

from __future__ import annotations

import base64
import io
import math
import platform
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, TypeAlias

import matplotlib
import numpy as np
import scipy.ndimage
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from codegen import __version__
from codegen.files import rendered, write_text
from codegen.registration.certificate import Certificate
from codegen.registration.grid import Grid, mesh, short
from codegen.registration.images import Image, Pixels
from codegen.registration.maps import Registration
from codegen.registration.noise import Outliers
from codegen.registration.pairs import LandmarkPairs, PointArray
from codegen.registration.register import MOST_LEFT_OUT, LeaveOneOut, out_of_place
from codegen.registration.volumes import Volume
from codegen.show.figures.picture import AMBER, BLUE, CRIMSON, RED

LONGEST = 560  # largest number of pixels of the longer side of an image on the page; larger images are subsampled
INCHES, DPI = 4.6, 125
CELLS, FIELDS = 24, 8  # number of cells along the longer side: of the deformed grid, and of the checkerboard
LINE_POINTS = 241  # number of points on a line of the deformed grid
COARSE = 80  # number of points along each side of the coarse grid that masks pixels from outside the source image
MOST_NAMES = 60  # largest number of landmarks whose names are shown in a picture
MOST_ROWS = 2_000  # largest number of landmarks in the table; an additional row counts the others
_RESIDUALS = (
    "Residual: how far a moving landmark arrives from the fixed one. Left out: how far it would arrive if the other "
    "landmarks alone made the map."
)
NOTE = f"Places and errors are in pixels, x to the right and y down from the centre of the top-left pixel. {_RESIDUALS}"
VOLUME_NOTE = (
    f"Places and errors are in the coordinates of the files, LPS as a rule, x to the left of the patient. {_RESIDUALS}"
)

Record: TypeAlias = dict[str, Any]
"""The record of a job for JSON: the options and the status; the dict `summary` has the results."""
Shape: TypeAlias = tuple[int, ...]
Array: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome:
    """The outcome of the registration of a pair of pictures or volumes.

    `registration`, the map, and its `certificate` are None if no map was found. `warped`, the samples of the warped
    image, is also None if the map folds or is inaccurate. `left_out` has the leave-one-out errors of the landmarks.
    """

    record: Record
    pairs: LandmarkPairs
    registration: Registration | None = None
    certificate: Certificate | None = None
    left_out: LeaveOneOut | None = None
    outliers: Outliers | None = None
    warped: Pixels | None = None

    @property
    def out_of_place(self) -> tuple[int, ...]:
        """The indices of the landmarks that are outliers."""
        return out_of_place(self.outliers, self.left_out)

    @property
    def passed(self) -> bool:
        """True if the image was warped by a map that does not fold."""
        return bool(self.record["status"] == "solved")

    @property
    def inverse(self) -> bool:
        """True if the fixed image is warped into the frame of the moving image, instead of the reverse."""
        return bool(self.record["direction"] == "fixed to moving")


@dataclass(frozen=True)
class Picture:
    """A picture for the page; `data` is a PNG file in base64."""

    title: str
    caption: str
    data: str


def write_page(path: Path, result: Outcome, pictures: list[Picture], note: str) -> None:
    """Write the report of a registration; `note` explains its units. FileError if the file system refuses."""
    record, pairs = result.record, result.pairs
    summary, outliers = record["summary"], set(result.out_of_place)
    # Names of files without folders, since a page may be sent to other people.
    files = [f"moving: {Path(record['moving']).name}"]
    files += [f"fixed: {Path(record['fixed']).name}"] if record["fixed"] else []
    files.append("landmarks: " + " and ".join(Path(name).name for name in record["landmarks"]))
    if record["status"] == "solved":
        files.append(f"written to: {Path(record['out']).name}")
    unknown = np.full(len(pairs), np.nan)
    residuals = result.registration.residuals if result.registration is not None else unknown
    errors = [residuals, result.left_out.errors if result.left_out is not None else unknown]
    unit = summary.get("length_unit", "")
    if unit:
        errors += [summary["residual_lengths"], summary.get("leave_one_out_lengths", [None] * len(pairs))]
    lengths = (f"residual, {unit}", f"left out, {unit}") if unit else ()
    axes = [f"{image} {axis}" for image in ("moving", "fixed") for axis in "xyz"[: pairs.dimension]]
    table = []
    for k in range(min(len(pairs), MOST_ROWS)):
        points = [f"{value:.2f}" for value in (*pairs.moving[k], *pairs.fixed[k])]
        cells = (pairs.names[k], *points, *(number(error[k]) for error in errors), "outlier" if k in outliers else "")
        table.append((cells, k in outliers))
    if len(pairs) > MOST_ROWS:
        table.append(((f"and {len(pairs) - MOST_ROWS} more", *[""] * (len(table[0][0]) - 1)), False))
    message = record["message"]
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("numpy", "scipy", "numba"))
    seconds = ", ".join(f"{name} {value:.3g} s" for name, value in record["seconds"].items())
    page = rendered(
        Path(__file__).parent / "templates/pair.html.j2", title=f"{Path(record['moving']).name}, {record['direction']}",
        subtitle=", ".join(files), passed=result.passed, status=record["status"],
        message=message[:1].upper() + message[1:] + "." if message else "", facts=facts(record), pictures=pictures,
        columns=("landmark", *axes, "residual", "left out", *lengths, ""), rows=table, note=note,
        environment=f"codegen {__version__}, Python {platform.python_version()}, {versions}. {seconds}.",
    )  # fmt: skip
    write_text(path, page)


def facts(record: Record) -> list[tuple[str, str]]:
    """Return the names of the results and their texts; distances in pixels, and in the unit of the file if known."""
    summary = record["summary"]
    found = [("landmarks", str(summary["landmarks"]))]
    if "det_min" not in summary:
        return found
    unit = short(summary.get("unit", "pixels"))
    sigma = f", sigma {record['sigma']:.3g} {unit}" if record["sigma"] or summary["sigma_chosen"] else ""
    sigma += " by likelihood" if summary["sigma_chosen"] else ""
    found += [
        (name, summary[key]) for name, key in (("alignment", "alignment_choice"), ("sigma", "sigma_message"))
        if summary.get(key)
    ]  # fmt: skip
    residual = f"{number(record['residual'])} {unit} at most, standard deviation {number(summary['deviation'])} {unit}"
    if "length_unit" in summary:
        largest, deviation = number(max(summary["residual_lengths"])), number(summary["deviation_length"])
        residual += f" ({largest} and {deviation} {summary['length_unit']})"
    place = ", ".join(f"{x:g}" for x in summary["det_min_at"])
    samples = "pixels" if len(summary["det_min_at"]) == 2 else "voxels"
    found += [
        ("method", f"{record['align']} alignment, {record['scheme']}, {record['steps']} steps{sigma}"),
        ("residual", residual),
        ("det J", f"{number(summary['det_min'])} at ({place}) to {number(summary['det_max'])}"),
        ("folded", "nowhere, which is proved" if summary["proved"] else f"{summary['folded']} {samples}"),
        ("round trip", f"{number(summary['round_trip'])} {unit}"),
    ]
    if summary["scheme_error"] is not None:
        found.append(("error of the scheme", f"{number(summary['scheme_error'])} {unit}"))
    if summary.get("leave_one_out"):
        text = f"{_median(summary['leave_one_out'])} {unit} (median)"
        if "length_unit" in summary:
            text += f", {_median(summary['leave_one_out_lengths'])} {summary['length_unit']}"
        found.append(("leave one out", text))
    elif summary["landmarks"] > MOST_LEFT_OUT:
        found.append(("leave one out", f"not done for more than {MOST_LEFT_OUT} landmarks"))
    found.append(("outliers", ", ".join(summary["outliers"]) or "none"))
    if summary.get("spacing", 1) != 1:
        text = f"every {summary['spacing']} pixels, error below {number(summary['spacing_bound'])} {unit}"
        if not isinstance(summary["spacing"], int):
            steps = " x ".join(map(str, summary["spacing"]))
            exact = f"{summary['exact']:.0%} of the voxels exactly"
            text = f"every {steps} voxels, error below {number(summary['spacing_bound'])} {unit}; {exact}"
        found.append(("grid", text))
    return found


def number(value: float | None) -> str:
    """Return the text of a number with four significant digits, or a dash if it is None or not finite."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def _median(errors: list[float | None]) -> str:
    finite = [error for error in errors if error is not None]
    return number(statistics.median(finite)) if finite else "–"


def pictures_of(result: Outcome, moving: Image, fixed: Image | None) -> list[Picture]:
    """Return the pictures for the report of a pair of pictures: only the two images if no map exists."""
    pairs, registration, pictures = result.pairs, result.registration, []
    for title, image, points, colour in (("Moving", moving, pairs.moving, RED), ("Fixed", fixed, pairs.fixed, BLUE)):
        if image is not None:
            axes = _axes(image.shape)
            _show(axes, image.pixels)
            _mark(axes, points, colour)
            for (x, y), name in zip(points[:MOST_NAMES], pairs.names):
                axes.annotate(name[:12], (x, y), (3, 3), textcoords="offset points", fontsize=7, color=colour, zorder=3)
            pictures.append(_picture(title, f"With its {len(points)} landmarks.", axes, image.shape))
    if registration is None or result.certificate is None:
        return pictures
    target = moving if result.inverse else fixed
    if result.warped is not None:
        pictures += _comparison(result, registration, result.warped, target)
    pictures.append(_deformed_grid(result, registration))
    # A map of det J, the growth of areas, on the fixed image, with a special colour where det J is not positive.
    shape, least = registration.fixed_grid.shape, result.certificate.det_min_at
    height, width = shape
    step = max(1.0, max(height, width) / 220.0)
    y, x = np.mgrid[
        0 : height - 1 : complex(0, max(2, round(height / step))),
        0 : width - 1 : complex(0, max(2, round(width / step))),
    ]
    values = registration.arriving(np.column_stack([x.ravel(), y.ravel()]))[1].reshape(x.shape)
    colours, reach = _determinant_scale(values)
    axes, masked = _axes(shape, bar=True), np.ma.masked_less_equal(values, 0.0)
    norm = LogNorm(1.0 / reach, reach)
    shown = axes.imshow(masked, extent=_extent(shape), interpolation="bilinear", cmap=colours, norm=norm)
    _mark(axes, pairs.fixed, "#303030")
    axes.plot(*least, marker="x", color=AMBER, markersize=7, markeredgewidth=2)
    _bar(axes, shown, "det J", [reach**share for share in (-1.0, -0.5, 0.0, 0.5, 1.0)])
    place = f"({least[0]:g}, {least[1]:g})"
    caption = f"Where areas have shrunk (blue) and grown (red) towards the fixed image; least at {place}, the cross."
    return [*pictures, _picture("Map of det J", caption, axes, shape)]


def _comparison(result: Outcome, registration: Registration, warped: Pixels, target: Image | None) -> list[Picture]:
    """Return pictures of the warped image and, if `target` is given, its checkerboard and difference with `target`."""
    inverse, shape = result.inverse, warped.shape
    source, frame = ("fixed", "moving") if inverse else ("moving", "fixed")
    axes = _axes(shape)
    _show(axes, warped)
    _mark(axes, result.pairs.moving if inverse else result.pairs.fixed, RED if inverse else BLUE)
    caption = f"The {source} image in the frame of the {frame} one, with the landmarks of the latter."
    pictures = [_picture("Warped", caption, axes, shape)]
    if target is None:
        return pictures
    one, two = (_shown(_thinned(pixels)) for pixels in (warped, target.pixels))
    if one.ndim != two.ndim:
        one, two = _grey(one), _grey(two)
    y, x = np.indices(one.shape[:2])
    cell = max(one.shape) / FIELDS
    is_first = (x // cell + y // cell) % 2 == 0
    axes = _axes(shape)
    _show(axes, np.where(is_first if one.ndim == 2 else is_first[..., None], one, two), shape)
    caption = f"Fields of the warped and of the {frame} image in turn."
    pictures.append(_picture("Checkerboard", caption, axes, shape))
    # `inside` marks the pixels that come from inside the source image, interpolated from a coarse grid.
    rows, columns = (np.linspace(0.0, length - 1.0, COARSE) for length in shape[:2])
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    carry = registration.map_points if inverse else registration.map_points_inverse
    sources = carry(nodes).reshape(COARSE, COARSE, 2)
    fine = np.meshgrid(*(np.linspace(0.0, COARSE - 1.0, length) for length in one.shape[:2]), indexing="ij")
    u, v = (scipy.ndimage.map_coordinates(sources[..., k], fine, order=1) for k in (0, 1))
    height, width = (registration.fixed_grid if inverse else registration.grid).shape
    inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    values = np.where(inside, _grey(one) - _grey(two), np.nan)
    axes = _axes(shape, bar=True)
    shown = axes.imshow(values, extent=_extent(shape), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
    _bar(axes, shown, f"warped − {frame}", (-1.0, -0.5, 0.0, 0.5, 1.0))
    caption = f"Warped minus {frame}, as shares of the range of grey."
    return [*pictures, _picture("Difference", caption, axes, shape)]


def _deformed_grid(result: Outcome, registration: Registration) -> Picture:
    """Return a picture of a square grid on the source image, deformed by the map."""
    inverse, source, target = result.inverse, registration.grid.shape, registration.fixed_grid.shape
    if inverse:
        source, target = target, source
    height, width = source
    cell = max(height, width) / CELLS
    across, down = np.linspace(0.0, width - 1.0, LINE_POINTS), np.linspace(0.0, height - 1.0, LINE_POINTS)
    lines = [np.column_stack([np.full(LINE_POINTS, x), down]) for x in np.arange(0, width, cell)]
    lines += [np.column_stack([across, np.full(LINE_POINTS, y)]) for y in np.arange(0, height, cell)]
    carry = registration.map_points_inverse if inverse else registration.map_points
    carried = carry(np.vstack(lines)).reshape(len(lines), LINE_POINTS, 2)
    axes = _axes(target)
    if result.warped is not None:
        _show(axes, 0.5 + 0.5 * _grey(_shown(_thinned(result.warped))), target)
    axes.add_collection(matplotlib.collections.LineCollection(list(carried), colors=CRIMSON, linewidths=0.6))
    caption = f"A square grid of {cell:.3g} px on the {'fixed' if inverse else 'moving'} image, carried by the map."
    return _picture("Deformed grid", caption, axes, target)


def _axes(shape: Shape, bar: bool = False) -> Axes:
    """Return axes for an image of shape (h, w) on a new figure, which is wider if it gets a colour `bar`."""
    height, width = shape[:2]
    share = min(2.5, max(0.3, height / width))
    size = (INCHES, INCHES * share) if share <= 1.3 else (INCHES * 1.3 / share, INCHES * 1.3)
    figure = Figure(figsize=(size[0] * (1.16 if bar else 1.0), size[1]), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_axis_off()
    return axes


def _picture(title: str, caption: str, axes: Axes, shape: Shape) -> Picture:
    """Return the picture of the figure of `axes`, cut to an image of shape (h, w)."""
    left, right, bottom, top = _extent(shape)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    return _as_png(title, caption, axes.get_figure(root=True))


def _as_png(title: str, caption: str, figure: Figure | None) -> Picture:
    assert figure is not None
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return Picture(title, caption, base64.b64encode(file.getvalue()).decode("ascii"))


def _determinant_scale(values: Array) -> tuple[Colormap, float]:
    """Return a colour map, with a special colour for masked values, and r: positive values lie between 1/r and r."""
    positive = values[values > 0.0]
    reach = max(1.05, float(np.exp(np.abs(np.log(positive)).max()))) if positive.size else 2.0
    return matplotlib.colormaps["RdBu_r"].with_extremes(bad=AMBER), reach


def _style_bar(bar: Colorbar, name: str) -> None:
    """Label a colour bar with `name`, in small letters and without minor ticks."""
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=8, length=2)
    bar.set_label(name, fontsize=9)


def _extent(shape: Shape) -> tuple[float, float, float, float]:
    return -0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5


def _show(axes: Axes, pixels: Pixels, shape: Shape | None = None) -> None:
    """Draw an image on `axes`, in its own pixels, or stretched over an image of another `shape` (h, w)."""
    thin = pixels if pixels.dtype == float and pixels.max(initial=0.0) <= 1.0 else _shown(_thinned(pixels))
    extent = _extent(shape or pixels.shape)
    axes.imshow(thin, extent=extent, cmap="gray", vmin=0.0, vmax=1.0, interpolation="antialiased")


def _mark(axes: Axes, points: PointArray, colour: str) -> None:
    size = 14 if len(points) <= MOST_NAMES else 4
    axes.scatter(points[:, 0], points[:, 1], s=size, c=colour, edgecolors="white", linewidths=0.6, zorder=2)


def _bar(axes: Axes, shown: AxesImage, name: str, ticks: Sequence[float]) -> None:
    bar = axes.figure.colorbar(shown, ax=axes, fraction=0.045, pad=0.02, ticks=ticks, format="%.3g")
    _style_bar(bar, name)
    bar.outline.set_visible(False)


def _thinned(pixels: Pixels) -> Pixels:
    """Return every n-th pixel, so that the longer side has at most LONGEST pixels."""
    stride = max(1, -(-max(pixels.shape[:2]) // LONGEST))
    return pixels[::stride, ::stride]


def _shown(pixels: Pixels) -> Array:
    """Return grey or RGB between 0 and 1, over white; samples of more than 8 bits are scaled by their range."""
    values = pixels.astype(float)
    low, high = 0.0, 255.0
    if pixels.dtype != np.uint8:
        finite = values[np.isfinite(values)]
        low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
        high = high if high > low else low + 1.0
    values = np.clip(np.nan_to_num((values - low) / (high - low)), 0.0, 1.0)
    if values.ndim == 3 and values.shape[2] in (2, 4):
        values = 1.0 - values[..., -1:] * (1.0 - values[..., :-1])
    return values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values


def _grey(values: Array) -> Array:
    return values @ np.array([0.299, 0.587, 0.114]) if values.ndim == 3 else values


SLICE_LONGEST = 240  # largest number of voxels shown along each side of a slice
SLICE_COARSE = 72  # largest number of points along each side of a slice at which det J is evaluated
NEAR = 3.0  # largest distance, in voxels, of the landmarks that are marked on a slice
NAMES = ("sagittal", "coronal", "axial")
SLICE_DPI = 110


@dataclass(frozen=True)
class Plane:
    """A slice of a grid: its normal axis, 0 to 2 for columns, rows and slices, and its index along this axis."""

    grid: Grid
    axis: int
    index: int

    @property
    def axes(self) -> tuple[int, int]:
        """The horizontal and the vertical axis of the picture."""
        across, up = (axis for axis in range(3) if axis != self.axis)
        return across, up

    @property
    def name(self) -> str:
        """The nearest anatomical plane, and the number of the slice, such as "axial, slice 12"."""
        across = np.abs(np.array(self.grid.direction)[:, self.axis])
        return f"{NAMES[int(across.argmax())]}, {('column', 'row', 'slice')[self.axis]} {self.index}"

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of the picture, in the unit of the grid, from the edge of the first voxel.

        Slices normal to axis 2 have their first row at the top: axial slices show the patient's back at the bottom.
        """
        width, height = (self.grid.size[axis] * self.grid.spacing[axis] for axis in self.axes)
        return (0.0, width, height, 0.0) if self.axis == 2 else (0.0, width, 0.0, height)

    def lines(self, most: int) -> tuple[Array, Array]:
        """Return the indices of the shown samples along both axes of the picture, at most `most` of each."""
        across, up = (np.arange(0.0, self.grid.size[a], max(1, -(-self.grid.size[a] // most))) for a in self.axes)
        return across, up

    def places(self, most: int) -> tuple[PointArray, tuple[int, int]]:
        """Return the positions of the shown samples in the grid, shape (n, 3), and the shape of the picture."""
        across, up = self.lines(most)
        lines = [np.array([float(self.index)])] * 3
        lines[self.axes[0]], lines[self.axes[1]] = across, up
        return self.grid.to_places(mesh(lines)), (len(up), len(across))

    def shown(self, samples: Pixels) -> Array:
        """Return the slice of the samples of a volume as a picture of shape (up, across)."""
        across, up = (line.astype(int) for line in self.lines(SLICE_LONGEST))
        cut = np.take(samples, self.index, axis=2 - self.axis)
        return np.asarray(cut[np.ix_(up, across)], dtype=float)


def volume_pictures(result: Outcome, moving: Volume, fixed: Volume | None) -> list[Picture]:
    """Return the pictures for the report of a pair of volumes: only the two volumes if no map exists."""
    inverse, registration = result.inverse, result.registration
    source, target = (fixed, moving) if inverse and fixed is not None else (moving, fixed)
    source_name, frame = ("fixed", "moving") if inverse else ("moving", "fixed")
    grid = (moving if target is None else target).grid
    marks = result.pairs.moving if inverse else result.pairs.fixed
    # Axial, coronal and sagittal slices through the median landmark.
    middle = np.median(grid.to_indices(marks), axis=0)
    planes = [Plane(grid, a, int(np.clip(round(middle[a]), 0, grid.size[a] - 1))) for a in (2, 1, 0)]
    before, after, growth = [], [], []
    for plane in planes:
        places, shape = plane.places(SLICE_LONGEST)
        indices = source.grid.to_indices(places)[:, ::-1].T
        values = scipy.ndimage.map_coordinates(source.samples, indices, order=1, output=np.float64, mode="nearest")
        before.append(np.where(source.grid.contains(places), values, np.nan).reshape(shape))
        if registration is not None and result.warped is not None:
            carried = (registration.map_points if inverse else registration.map_points_inverse)(places)
            inside = source.grid.contains(carried).reshape(shape)
            after.append(np.where(inside, plane.shown(result.warped), np.nan))
            places, shape = plane.places(SLICE_COARSE)
            growth.append((registration.leaving if inverse else registration.arriving)(places)[1].reshape(shape))
    targets = [] if target is None else [plane.shown(target.samples) for plane in planes]
    pictures = []
    shown = [(frame.capitalize(), "In its own frame, with the landmarks near each slice.", targets)]
    shown += [("Before", f"The {source_name} volume at the same places, before registration.", before)]
    shown += [("Warped", f"The {source_name} volume in the frame of the {frame} one.", after)]
    for title, caption, images in shown:
        if images:
            low, high = _range(images)
            pictures.append(_slices(title, caption, planes, images, marks, cmap="gray", vmin=low, vmax=high))
    if not after:
        return pictures
    if targets:
        for title, images in (("Difference before", before), ("Difference after", after)):
            caption = f"{title.split()[1].capitalize()} registration, minus {frame}, as shares of the range of grey."
            (low, high), (least, most) = _range(images), _range(targets)
            pairs = zip(images, targets, strict=True)
            differences = [(one - low) / (high - low) - (two - least) / (most - least) for one, two in pairs]
            picture = _slices(
                title, caption, planes, differences, None, "difference", cmap="RdBu_r", vmin=-1.0, vmax=1.0
            )
            pictures.append(picture)
    caption = "Where volumes have shrunk (blue) and grown (red) towards the fixed volume."
    colours, reach = _determinant_scale(np.concatenate([image.ravel() for image in growth]))
    masked = [np.ma.masked_less_equal(image, 0.0) for image in growth]
    picture = _slices(
        "Map of det J", caption, planes, masked, None, "det J",
        interpolation="bilinear", cmap=colours, norm=LogNorm(1.0 / reach, reach),
    )  # fmt: skip
    return [*pictures, picture]


def _range(images: Sequence[Array]) -> tuple[float, float]:
    """Return the range of the finite values of all slices, without the extreme 0.5 % at both ends."""
    values = np.concatenate([image[np.isfinite(image)] for image in images])
    low, high = np.percentile(values, (0.5, 99.5)) if values.size else (0.0, 1.0)
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1.0)


def _slices(
    title: str, caption: str, planes: list[Plane], images: Sequence[Array], marks: PointArray | None = None,
    bar: str = "", **style: Any,
) -> Picture:  # fmt: skip
    """Return a picture of three slices with the landmarks `marks` near them; `bar` is the label of a colour bar."""
    heights = [abs(plane.extent[3] - plane.extent[2]) / plane.extent[1] for plane in planes]
    size = 4.6 if bar else 4.0, min(15.0, 4.0 * sum(heights) + 0.9)
    figure = Figure(figsize=size, dpi=SLICE_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    rows = figure.subplots(3, 1, gridspec_kw={"height_ratios": heights})
    for axes, plane, image in zip(rows, planes, images, strict=True):
        axes.set_axis_off()
        origin: Literal["upper", "lower"] = "upper" if plane.axis == 2 else "lower"
        shown = axes.imshow(image, extent=plane.extent, origin=origin, **style)
        if marks is not None:
            indices = plane.grid.to_indices(marks)
            close, both = np.abs(indices[:, plane.axis] - plane.index) <= NEAR, list(plane.axes)
            near = (indices[close][:, both] + 0.5) * np.array(plane.grid.spacing)[both]
            axes.scatter(
                near[:, 0], near[:, 1], s=12, c=RED if title == "Before" else BLUE, edgecolors="white", linewidths=0.6
            )
        axes.set_xlim(plane.extent[:2])
        axes.set_ylim(plane.extent[2:])
        axes.set_aspect("equal")
        axes.set_title(plane.name, fontsize=8)
    if bar:
        _style_bar(figure.colorbar(shown, ax=list(rows), fraction=0.045, pad=0.02, format="%.3g"), bar)
    return _as_png(title, caption, figure)
