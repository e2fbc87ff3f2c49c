"""The outcome of one registration, and its report: an HTML page with pictures, certificate and landmarks."""

from __future__ import annotations

import base64
import io
import math
import platform
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np
import scipy.ndimage
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy.typing import NDArray

from codegen import __version__
from codegen.files import rendered, write_text
from codegen.registration.certificate import Certificate
from codegen.registration.grid import short
from codegen.registration.images import Image
from codegen.registration.maps import Registration
from codegen.registration.noise import Outliers
from codegen.registration.pairs import LandmarkPairs, PointArray
from codegen.registration.register import MOST_LEFT_OUT, LeaveOneOut, out_of_place
from codegen.show.figures.picture import AMBER, BLUE, CRIMSON, RED

LONGEST = 560
"""Pixels of the longer side of a picture on the page; larger images are thinned."""
INCHES, DPI = 4.6, 125
CELLS, FIELDS = 24, 8
"""Cells of the deformed grid along the longer side, and of the checkerboard."""
LINE_POINTS = 241
"""Points of a line of the deformed grid."""
COARSE = 80
"""Points along each side of the coarse grid by which pixels from outside the image are masked."""
MOST_NAMES = 60
"""Landmarks whose names are shown in a picture."""
MOST_ROWS = 2_000
"""Landmarks in the table; its last row counts the others."""
RESIDUALS = (
    "Residual: how far a moving landmark arrives from the fixed one. Left out: how far it would arrive if the other "
    "landmarks alone made the map."
)
NOTE = f"Places and errors are in pixels, x to the right and y down from the centre of the top-left pixel. {RESIDUALS}"

Shape: TypeAlias = tuple[int, ...]
Painter: TypeAlias = Callable[[Any], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class Outcome:
    """The outcome of a job, of pictures or of volumes.

    `record` is the JSON record. The map and its certificate are None if no map exists.
    """

    record: dict[str, Any]
    pairs: LandmarkPairs
    registration: Registration | None = None
    certificate: Certificate | None = None
    left_out: LeaveOneOut | None = None
    outliers: Outliers | None = None

    @property
    def out_of_place(self) -> tuple[int, ...]:
        """The numbers of the outliers among the landmarks, counted from zero."""
        return out_of_place(self.outliers, self.left_out)

    @property
    def passed(self) -> bool:
        """True if the image was warped by a map that does not fold."""
        return bool(self.record["status"] == "solved")


@dataclass(frozen=True, eq=False, kw_only=True)
class Result(Outcome):
    """The outcome of a job of pictures, with the images of its report."""

    moving: Image
    fixed: Image | None
    warped: Any = None


@dataclass(frozen=True)
class Picture:
    """A picture for the page: PNG in base64."""

    title: str
    caption: str
    data: str


@dataclass(frozen=True)
class Row:
    """The cells of a landmark; `outlier` highlights the row."""

    cells: tuple[str, ...]
    outlier: bool


def write_report(path: Path, result: Result) -> None:
    """Write the page of a pair of pictures; FileError if the file system refuses."""
    write_page(path, result, _pictures(result), NOTE)


def write_page(path: Path, result: Outcome, pictures: list[Picture], note: str) -> None:
    """Write a page with pictures and a note about its numbers; FileError if the file system refuses."""
    record, pairs = result.record, result.pairs
    summary, outliers = record["summary"], set(result.out_of_place)
    # Names of files without folders: a page may be sent to others.
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
        table.append(Row(cells, k in outliers))
    if len(pairs) > MOST_ROWS:
        table.append(Row((f"and {len(pairs) - MOST_ROWS} more", *[""] * (len(table[0].cells) - 1)), False))
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


def facts(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Names and values of the findings; distances in pixels, and in the unit of a picture if its file has one."""
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
    """Format a number in few characters; a dash if it is missing."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


def as_png(title: str, caption: str, figure: Figure) -> Picture:
    """Draw a figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return Picture(title, caption, base64.b64encode(file.getvalue()).decode("ascii"))


def determinant_scale(values: NDArray[np.float64]) -> dict[str, Any]:
    """Colours of determinants by their logarithms; values that are not positive have their own colour."""
    positive = values[values > 0.0]
    reach = max(1.05, float(np.exp(np.abs(np.log(positive)).max()))) if positive.size else 2.0
    colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad=AMBER)
    return {"cmap": colours, "norm": LogNorm(1.0 / reach, reach)}


def style_bar(bar: Any, name: str) -> None:
    """Label a colour bar, in small letters and without minor ticks."""
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=8, length=2)
    bar.set_label(name, fontsize=9)


def _median(errors: list[float | None]) -> str:
    finite = [error for error in errors if error is not None]
    return number(statistics.median(finite)) if finite else "–"


def _pictures(result: Result) -> list[Picture]:
    """All pictures of a result: the images alone if no map exists."""
    pairs, registration = result.pairs, result.registration
    pictures = [_input("Moving", result.moving.pixels, pairs.moving, pairs.names, RED)]
    if result.fixed is not None:
        pictures.append(_input("Fixed", result.fixed.pixels, pairs.fixed, pairs.names, BLUE))
    if registration is None:
        return pictures
    if result.warped is not None:
        pictures += _comparison(result, registration, result.warped)
    return [*pictures, _deformed_grid(result, registration), _determinants(result, registration)]


def _input(title: str, pixels: Any, points: PointArray, names: tuple[str, ...], colour: str) -> Picture:
    def paint(axes: Any) -> None:
        _show(axes, pixels)
        _mark(axes, points, colour)
        for (x, y), name in zip(points[:MOST_NAMES], names):
            axes.annotate(name[:12], (x, y), (3, 3), textcoords="offset points", fontsize=7, color=colour, zorder=3)

    return _picture(title, f"With its {len(points)} landmarks.", pixels.shape, paint)


def _comparison(result: Result, registration: Registration, warped: Any) -> list[Picture]:
    """The warped image and, with the image of the same frame, a checkerboard and the difference."""
    inverse = result.record["direction"] == "fixed to moving"
    landmarks = result.pairs.moving if inverse else result.pairs.fixed
    source, frame = ("fixed", "moving") if inverse else ("moving", "fixed")
    other = result.moving if inverse else result.fixed

    def paint(axes: Any) -> None:
        _show(axes, warped)
        _mark(axes, landmarks, RED if inverse else BLUE)

    caption = f"The {source} image in the frame of the {frame} one, with the landmarks of the latter."
    pictures = [_picture("Warped", caption, warped.shape, paint)]
    if other is None:
        return pictures
    one, two = (_shown(_thinned(pixels)) for pixels in (warped, other.pixels))
    if one.ndim != two.ndim:
        one, two = _grey(one), _grey(two)
    y, x = np.indices(one.shape[:2])
    cell = max(one.shape) / FIELDS
    is_first = (x // cell + y // cell) % 2 == 0
    # Pixels from inside the source image, by interpolation of their sources on a coarse grid.
    rows, columns = (np.linspace(0.0, length - 1.0, COARSE) for length in warped.shape[:2])
    nodes = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    carry = registration.map_points if inverse else registration.map_points_inverse
    sources = carry(nodes).reshape(COARSE, COARSE, 2)
    fine = np.meshgrid(*(np.linspace(0.0, COARSE - 1.0, length) for length in one.shape[:2]), indexing="ij")
    u, v = (scipy.ndimage.map_coordinates(sources[..., k], fine, order=1) for k in (0, 1))
    height, width = registration.fixed_shape if inverse else registration.shape
    inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)

    def checkered(axes: Any) -> None:
        _show(axes, np.where(is_first if one.ndim == 2 else is_first[..., None], one, two), warped.shape)

    def difference(axes: Any) -> None:
        values = np.where(inside, _grey(one) - _grey(two), np.nan)
        shown = axes.imshow(values, extent=_extent(warped.shape), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
        _bar(axes, shown, f"warped − {frame}", (-1.0, -0.5, 0.0, 0.5, 1.0))

    caption = f"Fields of the warped and of the {frame} image in turn."
    pictures.append(_picture("Checkerboard", caption, warped.shape, checkered))
    caption = f"Warped minus {frame}, as shares of the range of grey."
    return [*pictures, _picture("Difference", caption, warped.shape, difference, True)]


def _deformed_grid(result: Result, registration: Registration) -> Picture:
    """Lines of equal x and y of the source image, carried by the map."""
    inverse = result.record["direction"] == "fixed to moving"
    source, target = registration.shape, registration.fixed_shape
    if inverse:
        source, target = target, source
    height, width = source
    cell = max(height, width) / CELLS
    across, down = np.linspace(0.0, width - 1.0, LINE_POINTS), np.linspace(0.0, height - 1.0, LINE_POINTS)
    lines = [np.column_stack([np.full(LINE_POINTS, x), down]) for x in np.arange(0, width, cell)]
    lines += [np.column_stack([across, np.full(LINE_POINTS, y)]) for y in np.arange(0, height, cell)]
    carry = registration.map_points_inverse if inverse else registration.map_points
    carried = carry(np.vstack(lines)).reshape(len(lines), LINE_POINTS, 2)

    def paint(axes: Any) -> None:
        if result.warped is not None:
            _show(axes, 0.5 + 0.5 * _grey(_shown(_thinned(result.warped))), target)
        axes.add_collection(matplotlib.collections.LineCollection(list(carried), colors=CRIMSON, linewidths=0.6))
        _frame(axes, target)

    caption = f"A square grid of {cell:.3g} px on the {'fixed' if inverse else 'moving'} image, carried by the map."
    return _picture("Deformed grid", caption, target, paint)


def _determinants(result: Result, registration: Registration) -> Picture:
    """The growth of areas on the fixed image; a colour of its own where det J is not positive."""
    height, width = registration.fixed_shape
    step = max(1.0, max(height, width) / 220.0)
    y, x = np.mgrid[
        0 : height - 1 : complex(0, max(2, round(height / step))),
        0 : width - 1 : complex(0, max(2, round(width / step))),
    ]
    values = registration.arriving_determinant(np.column_stack([x.ravel(), y.ravel()])).reshape(x.shape)
    assert result.certificate is not None
    scale, least = determinant_scale(values), result.certificate.det_min_at

    def paint(axes: Any) -> None:
        masked, extent = np.ma.masked_less_equal(values, 0.0), _extent(registration.fixed_shape)
        shown = axes.imshow(masked, extent=extent, interpolation="bilinear", **scale)
        _mark(axes, result.pairs.fixed, "#303030")
        axes.plot(*least, marker="x", color=AMBER, markersize=7, markeredgewidth=2)
        _bar(axes, shown, "det J", [scale["norm"].vmax ** share for share in (-1.0, -0.5, 0.0, 0.5, 1.0)])

    place = f"({least[0]:g}, {least[1]:g})"
    caption = f"Where areas have shrunk (blue) and grown (red) towards the fixed image; least at {place}, the cross."
    return _picture("Map of det J", caption, registration.fixed_shape, paint, True)


def _picture(title: str, caption: str, shape: Shape, paint: Painter, bar: bool = False) -> Picture:
    """Draw a picture by `paint` on axes in pixels of an image."""
    height, width = shape[:2]
    share = min(2.5, max(0.3, height / width))
    size = (INCHES, INCHES * share) if share <= 1.3 else (INCHES * 1.3 / share, INCHES * 1.3)
    figure = Figure(figsize=(size[0] * (1.16 if bar else 1.0), size[1]), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.set_axis_off()
    paint(axes)
    _frame(axes, shape)
    return as_png(title, caption, figure)


def _frame(axes: Any, shape: Shape) -> None:
    left, right, bottom, top = _extent(shape)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")


def _extent(shape: Shape) -> tuple[float, float, float, float]:
    return -0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5


def _show(axes: Any, pixels: Any, shape: Shape | None = None) -> None:
    """Show an image in its own pixels, or in the pixels of an image of another shape."""
    thin = pixels if pixels.dtype == float and pixels.max(initial=0.0) <= 1.0 else _shown(_thinned(pixels))
    axes.imshow(
        thin, extent=_extent(shape or pixels.shape), cmap="gray", vmin=0.0, vmax=1.0, interpolation="antialiased"
    )


def _mark(axes: Any, points: PointArray, colour: str) -> None:
    size = 14 if len(points) <= MOST_NAMES else 4
    axes.scatter(*points.T, s=size, c=colour, edgecolors="white", linewidths=0.6, zorder=2)


def _bar(axes: Any, shown: Any, name: str, ticks: Sequence[float]) -> None:
    bar = axes.figure.colorbar(shown, ax=axes, fraction=0.045, pad=0.02, ticks=ticks, format="%.3g")
    style_bar(bar, name)
    bar.outline.set_visible(False)


def _thinned(pixels: NDArray[Any]) -> NDArray[Any]:
    """Take every n-th pixel of an image that is larger than a picture."""
    stride = max(1, -(-max(pixels.shape[:2]) // LONGEST))
    return pixels[::stride, ::stride]


def _shown(pixels: NDArray[Any]) -> NDArray[np.float64]:
    """Scale samples to 0 to 1, as grey or RGB over white; samples of more than 8 bits by their range."""
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


def _grey(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values @ np.array([0.299, 0.587, 0.114]) if values.ndim == 3 else values
