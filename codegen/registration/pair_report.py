"""One page about one pair: pictures, certificate and landmarks, in an HTML file that needs no other."""

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
from codegen.registration.grid import short
from codegen.registration.jobs import MOST_LEFT_OUT, Outcome, Result
from codegen.registration.maps import Registration
from codegen.registration.pairs import PointArray
from codegen.show.figures.picture import AMBER, BLUE, CRIMSON, RED

LONGEST = 560
"""Pixels of the longer side of a picture on the page; larger images are thinned."""
INCHES, DPI = 4.6, 125
CELLS, FIELDS = 24, 8
"""Cells of the deformed grid along the longer side, and of the checkerboard."""
COARSE = 80
"""Points along each side at which it is looked up what lies outside, for pictures only."""
MOST_NAMES = 60

Shape: TypeAlias = tuple[int, ...]
Painter: TypeAlias = Callable[[Any], None]


@dataclass(frozen=True)
class Picture:
    """A picture for the page: PNG in base64."""

    title: str
    caption: str
    data: str


def of(result: Result) -> list[Picture]:
    """All pictures that a result allows: the images alone where no map was found."""
    found = [_input("Moving", result.moving.pixels, result.pairs.moving, result.pairs.names, RED)]
    if result.fixed is not None:
        found.append(_input("Fixed", result.fixed.pixels, result.pairs.fixed, result.pairs.names, BLUE))
    if result.registration is None:
        return found
    if result.warped is not None:
        found += _compared(result, result.warped)
    return [*found, _grid(result, result.registration), _determinants(result, result.registration)]


def _input(title: str, pixels: Any, points: PointArray, names: tuple[str, ...], colour: str) -> Picture:
    def paint(axes: Any) -> None:
        _show(axes, pixels)
        _mark(axes, points, colour)
        for (x, y), name in zip(points[:MOST_NAMES], names):
            axes.annotate(name[:12], (x, y), (3, 3), textcoords="offset points", fontsize=7, color=colour, zorder=3)

    return _picture(title, f"With its {len(points)} landmarks.", pixels.shape, paint)


def _compared(result: Result, warped: Any) -> list[Picture]:
    """The result, and beside the image in whose frame it is: their difference, and both in a checkerboard."""
    inverse = result.record["direction"] == "fixed to moving"
    target = result.pairs.moving if inverse else result.pairs.fixed
    source, frame = ("fixed", "moving") if inverse else ("moving", "fixed")
    other = result.moving if inverse else result.fixed

    def paint(axes: Any) -> None:
        _show(axes, warped)
        _mark(axes, target, RED if inverse else BLUE)

    caption = f"The {source} image in the frame of the {frame} one, with the landmarks of the latter."
    found = [_picture("Warped", caption, warped.shape, paint)]
    if other is None:
        return found
    one, two = (_shown(_thinned(pixels)) for pixels in (warped, other.pixels))
    if one.ndim != two.ndim:
        one, two = _grey(one), _grey(two)
    y, x = np.indices(one.shape[:2])
    cell = max(one.shape) / FIELDS
    first = (x // cell + y // cell) % 2 == 0
    assert result.registration is not None
    inside = _inside(result.registration, inverse, warped.shape, one.shape)

    def checkered(axes: Any) -> None:
        _show(axes, np.where(first if one.ndim == 2 else first[..., None], one, two), warped.shape)

    def difference(axes: Any) -> None:
        values = np.where(inside, _grey(one) - _grey(two), np.nan)
        shown = axes.imshow(values, extent=_extent(warped.shape), cmap="RdBu_r", vmin=-1.0, vmax=1.0)
        _bar(axes, shown, f"warped − {frame}", (-1.0, -0.5, 0.0, 0.5, 1.0))

    return [
        *found,
        _picture("Checkerboard", f"Fields of the warped and of the {frame} image in turn.", warped.shape, checkered),
        _picture(
            "Difference", f"Warped minus {frame}, as shares of the range of grey.", warped.shape, difference, True
        ),
    ]


def _inside(registration: Registration, inverse: bool, shape: Shape, thin: Shape) -> NDArray[np.bool_]:
    """Which pixels of a thinned picture of the result come from inside the source image: by a coarse grid."""
    rows, columns = (np.linspace(0.0, length - 1.0, COARSE) for length in shape[:2])
    places = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    carry = registration.map_points if inverse else registration.map_points_inverse
    coarse = carry(places).reshape(COARSE, COARSE, 2)
    fine = np.meshgrid(*(np.linspace(0.0, COARSE - 1.0, length) for length in thin[:2]), indexing="ij")
    x, y = (scipy.ndimage.map_coordinates(coarse[..., k], fine, order=1) for k in (0, 1))
    height, width = registration.fixed_shape if inverse else registration.shape
    return np.asarray((x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5))


def _grid(result: Result, registration: Registration) -> Picture:
    """Lines of equal x and y of the source image, where the map takes them."""
    inverse = result.record["direction"] == "fixed to moving"
    source, target = registration.shape, registration.fixed_shape
    if inverse:
        source, target = target, source
    height, width = source
    cell = max(height, width) / CELLS
    fine = 241
    lines = [
        np.column_stack([np.full(fine, x), np.linspace(0.0, height - 1.0, fine)]) for x in np.arange(0, width, cell)
    ]
    lines += [
        np.column_stack([np.linspace(0.0, width - 1.0, fine), np.full(fine, y)]) for y in np.arange(0, height, cell)
    ]
    carry = registration.map_points_inverse if inverse else registration.map_points
    carried = carry(np.vstack(lines)).reshape(len(lines), fine, 2)

    def paint(axes: Any) -> None:
        if result.warped is not None:
            _show(axes, 0.5 + 0.5 * _grey(_shown(_thinned(result.warped))), target)
        axes.add_collection(matplotlib.collections.LineCollection(list(carried), colors=CRIMSON, linewidths=0.6))
        _frame(axes, target)

    caption = f"A square grid of {cell:.3g} px on the {'fixed' if inverse else 'moving'} image, carried by the map."
    return _picture("Deformed grid", caption, target, paint)


def _determinants(result: Result, registration: Registration) -> Picture:
    """The factor by which areas have grown, on the fixed image; a colour of its own where it is not positive."""
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
    """What `paint` draws on axes in pixels of an image, as a PNG."""
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


def as_png(title: str, caption: str, figure: Figure) -> Picture:
    """The picture of a figure."""
    file = io.BytesIO()
    figure.savefig(file, format="png", metadata={"Software": None})
    return Picture(title, caption, base64.b64encode(file.getvalue()).decode("ascii"))


def determinant_scale(values: NDArray[np.float64]) -> dict[str, Any]:
    """Colours of determinants by their logarithms; those that are not positive have a colour of their own."""
    positive = values[values > 0.0]
    reach = max(1.05, float(np.exp(np.abs(np.log(positive)).max()))) if positive.size else 2.0
    colours = matplotlib.colormaps["RdBu_r"].with_extremes(bad=AMBER)
    return {"cmap": colours, "norm": LogNorm(1.0 / reach, reach)}


def style_bar(bar: Any, name: str) -> None:
    """Name a colour bar, in small letters and without minor ticks."""
    bar.ax.minorticks_off()
    bar.ax.tick_params(labelsize=8, length=2)
    bar.set_label(name, fontsize=9)


def _frame(axes: Any, shape: Shape) -> None:
    left, right, bottom, top = _extent(shape)
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")


def _extent(shape: Shape) -> tuple[float, float, float, float]:
    return -0.5, shape[1] - 0.5, shape[0] - 0.5, -0.5


def _show(axes: Any, pixels: Any, shape: Shape | None = None) -> None:
    """An image in pixels of its own, or of the image that it stands for."""
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
    """Every so-many-th pixel of an image that is larger than a picture."""
    stride = max(1, -(-max(pixels.shape[:2]) // LONGEST))
    return pixels[::stride, ::stride]


def _shown(pixels: NDArray[Any]) -> NDArray[np.float64]:
    """Samples from 0 to 1, as grey or RGB with opacity over white: 8 bits as they are, others by their range."""
    values = pixels.astype(float)
    low, high = (0.0, 255.0) if pixels.dtype == np.uint8 else _range(values)
    values = np.clip(np.nan_to_num((values - low) / (high - low)), 0.0, 1.0)
    if values.ndim == 3 and values.shape[2] in (2, 4):
        values = 1.0 - values[..., -1:] * (1.0 - values[..., :-1])
    return values[..., 0] if values.ndim == 3 and values.shape[2] == 1 else values


def _range(values: NDArray[np.float64]) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 1.0)
    return (low, high) if high > low else (low, low + 1.0)


def _grey(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values @ np.array([0.299, 0.587, 0.114]) if values.ndim == 3 else values


def rows(record: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What was found, in words and numbers; distances in pixels, and in the unit that a picture carries."""
    seen = record["summary"]
    found = [("landmarks", str(seen["landmarks"]))]
    if "det_min" not in seen:
        return found
    unit = short(seen.get("unit", "pixels"))
    sigma = f", sigma {record['sigma']:.3g} {unit}" if record["sigma"] or seen["sigma_chosen"] else ""
    sigma += " by likelihood" if seen["sigma_chosen"] else ""
    found += [
        (name, seen[key]) for name, key in (("alignment", "alignment_choice"), ("sigma", "sigma_message"))
        if seen.get(key)
    ]  # fmt: skip
    place = ", ".join(f"{x:g}" for x in seen["det_min_at"])
    found += [
        ("method", f"{record['align']} alignment, {record['scheme']}, {record['steps']} steps{sigma}"),
        ("residual", _residual(record, unit)),
        ("det J", f"{number(seen['det_min'])} at ({place}) to {number(seen['det_max'])}"),
        (
            "folded",
            "nowhere, which is proved"
            if seen["proved"]
            else f"{seen['folded']} {'pixels' if len(seen['det_min_at']) == 2 else 'voxels'}",
        ),
        ("round trip", f"{number(seen['round_trip'])} {unit}"),
    ]
    if seen["scheme_error"] is not None:
        found.append(("error of the scheme", f"{number(seen['scheme_error'])} {unit}"))
    if seen.get("leave_one_out"):
        text = f"{_median(seen['leave_one_out'])} {unit} (median)"
        if "length_unit" in seen:
            text += f", {_median(seen['leave_one_out_lengths'])} {seen['length_unit']}"
        found.append(("leave one out", text))
    elif seen["landmarks"] > MOST_LEFT_OUT:
        found.append(("leave one out", f"not done for more than {MOST_LEFT_OUT} landmarks"))
    found.append(("outliers", ", ".join(seen["outliers"]) or "none"))
    if seen.get("spacing", 1) != 1:
        text = f"every {seen['spacing']} pixels, error below {number(seen['spacing_bound'])} {unit}"
        if not isinstance(seen["spacing"], int):
            steps = " x ".join(map(str, seen["spacing"]))
            exact = f"{seen['exact']:.0%} of the voxels exactly"
            text = f"every {steps} voxels, error below {number(seen['spacing_bound'])} {unit}; {exact}"
        found.append(("grid", text))
    return found


def _residual(record: Mapping[str, Any], unit: str) -> str:
    seen = record["summary"]
    text = f"{number(record['residual'])} {unit} at most, standard deviation {number(seen['deviation'])} {unit}"
    if "length_unit" not in seen:
        return text
    largest, deviation = number(max(seen["residual_lengths"])), number(seen["deviation_length"])
    return f"{text} ({largest} and {deviation} {seen['length_unit']})"


def _median(errors: list[float | None]) -> str:
    finite = [error for error in errors if error is not None]
    return number(statistics.median(finite)) if finite else "–"


def number(value: float | None) -> str:
    """A number in few characters."""
    return "–" if value is None or not math.isfinite(value) else f"{value:.4g}"


RESIDUALS = (
    "Residual: how far a moving landmark arrives from the fixed one. Left out: how far it would arrive if the other "
    "landmarks alone made the map."
)
NOTE = f"Places and errors are in pixels, x to the right and y down from the centre of the top-left pixel. {RESIDUALS}"
MOST_ROWS = 2_000
"""Landmarks beyond are left out of the table, which says so."""


@dataclass(frozen=True)
class Row:
    """The cells of a landmark, and whether it stands out."""

    cells: tuple[str, ...]
    outlier: bool


def write_report(path: Path, result: Result) -> None:
    """Write the page; FileError where the file system refuses."""
    write_page(path, result, of(result), NOTE)


def write_page(path: Path, result: Outcome, shown: list[Picture], note: str) -> None:
    """Write a page with pictures, and a note about its numbers; FileError where the file system refuses."""
    write_text(path, render(result, shown, note))


def render(result: Outcome, shown: list[Picture], note: str) -> str:
    """The text of the page, of a registration that succeeded or failed."""
    template = Path(__file__).parent / "templates/pair.html.j2"
    record = result.record
    # The files, by their names alone: a page may travel.
    names = [f"moving: {Path(record['moving']).name}"]
    names += [f"fixed: {Path(record['fixed']).name}"] if record["fixed"] else []
    names.append("landmarks: " + " and ".join(Path(name).name for name in record["landmarks"]))
    if record["status"] == "solved":
        names.append(f"written to: {Path(record['out']).name}")
    pairs = result.pairs
    residuals = result.registration.residuals if result.registration is not None else np.full(len(pairs), np.nan)
    left_out = result.left_out.errors if result.left_out is not None else np.full(len(pairs), np.nan)
    errors = [residuals, left_out]
    seen, outliers = result.record["summary"], set(result.out_of_place)
    if "length_unit" in seen:
        unknown = [None] * len(pairs)
        errors += [seen["residual_lengths"], seen.get("leave_one_out_lengths", unknown)]
    made = []
    for k in range(min(len(pairs), MOST_ROWS)):
        places = [f"{value:.2f}" for value in (*pairs.moving[k], *pairs.fixed[k])]
        cells = (pairs.names[k], *places, *(number(of[k]) for of in errors), "outlier" if k in outliers else "")
        made.append(Row(cells, k in outliers))
    if len(pairs) > MOST_ROWS:
        made.append(Row((f"and {len(pairs) - MOST_ROWS} more", *[""] * (len(made[0].cells) - 1)), False))
    return rendered(
        template, title=f"{Path(record['moving']).name}, {record['direction']}", subtitle=", ".join(names),
        passed=result.passed, status=record["status"], message=_sentence(record["message"]), facts=rows(record),
        pictures=shown, columns=columns(result.pairs.dimension, record["summary"].get("length_unit", "")),
        rows=made, note=note,
        environment=_environment(record),
    )  # fmt: skip


def columns(dimension: int, unit: str = "") -> tuple[str, ...]:
    """The headings of the table of landmarks; errors have more columns in the unit that a picture carries."""
    places = [f"{image} {axis}" for image in ("moving", "fixed") for axis in "xyz"[:dimension]]
    lengths = (f"residual, {unit}", f"left out, {unit}") if unit else ()
    return ("landmark", *places, "residual", "left out", *lengths, "")


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:] + "." if text else ""


def _environment(record: dict[str, Any]) -> str:
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("numpy", "scipy", "numba"))
    seconds = ", ".join(f"{name} {value:.3g} s" for name, value in record["seconds"].items())
    return f"codegen {__version__}, Python {platform.python_version()}, {versions}. {seconds}."
