"""Pictures of one registration of volumes: three orthogonal slices of everything that is compared, and of det J."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from codegen.registration.grid import Grid, mesh
from codegen.registration.pair_report import Picture, as_png, determinant_scale, style_bar
from codegen.registration.pairs import PointArray
from codegen.registration.volumes.warp import VolumeResult
from codegen.show.figures.picture import BLUE, RED

LONGEST = 240
"""Voxels of the longer side of a slice that are shown."""
COARSE = 72
"""Points along the longer side of a slice at which det J is evaluated."""
NEAR = 3.0
"""Voxels from a slice within which landmarks are marked on it."""
NAMES = ("sagittal", "coronal", "axial")
DPI = 110


@dataclass(frozen=True)
class Plane:
    """A slice of a grid: the axis that it is across, 0 to 2 for columns, rows and slices, and its index on it."""

    grid: Grid
    axis: int
    index: int

    @property
    def axes(self) -> tuple[int, int]:
        """The axes across and up the picture."""
        across, up = (axis for axis in range(3) if axis != self.axis)
        return across, up

    @property
    def name(self) -> str:
        """What a slice is called: by the axis of the patient that it is nearly across, and by its number."""
        across = np.abs(np.array(self.grid.direction)[:, self.axis])
        return f"{NAMES[int(across.argmax())]}, {('column', 'row', 'slice')[self.axis]} {self.index}"

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """The edges of the picture in units of length from the first voxel's edge: left, right, bottom, top."""
        across, up = self.axes
        width, height = (self.grid.size[axis] * self.grid.spacing[axis] for axis in (across, up))
        # Rows run to the back of the patient, as axial slices are looked at; slices run up.
        return (0.0, width, height, 0.0) if self.axis == 2 else (0.0, width, 0.0, height)

    def lines(self, most: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The indices that are shown along both axes, no more than so many."""
        across, up = (np.arange(0.0, self.grid.size[a], max(1, -(-self.grid.size[a] // most))) for a in self.axes)
        return across, up

    def places(self, most: int) -> tuple[PointArray, tuple[int, int]]:
        """The places that are shown, and the shape of a picture of them."""
        across, up = self.lines(most)
        lines: list[Any] = [np.array([float(self.index)])] * 3
        lines[self.axes[0]], lines[self.axes[1]] = across, up
        return self.grid.to_places(mesh(lines)), (len(up), len(across))

    def shown(self, samples: NDArray[Any]) -> NDArray[np.float64]:
        """The slice of an array of samples, shape (up, across)."""
        across, up = (line.astype(int) for line in self.lines(LONGEST))
        cut = np.take(samples, self.index, axis=2 - self.axis)
        return np.asarray(cut[np.ix_(up, across)], dtype=float)

    def near(self, points: PointArray) -> PointArray:
        """Where landmarks that are near the slice lie in the picture, shape (n, 2)."""
        indices = self.grid.to_indices(points)
        close = np.abs(indices[:, self.axis] - self.index) <= NEAR
        axes = list(self.axes)
        return np.asarray((indices[close][:, axes] + 0.5) * np.array(self.grid.spacing)[axes])


def of(result: VolumeResult) -> list[Picture]:
    """All pictures that a result allows: the volumes alone where no map was found."""
    grid = (result.moving if result.inverse or result.fixed is None else result.fixed).grid
    marks = result.pairs.moving if result.inverse else result.pairs.fixed
    planes = _planes(grid, marks)
    target, found = result.target, []
    source, frame = ("fixed", "moving") if result.inverse else ("moving", "fixed")
    before = [_before(plane, result) for plane in planes]
    kept = None if target is None else [plane.shown(target.samples) for plane in planes]
    if kept is not None:
        found.append(
            _grey(frame.capitalize(), "In its own frame, with the landmarks near each slice.", planes, kept, marks)
        )
    found.append(
        _grey("Before", f"The {source} volume at the same places, before registration.", planes, before, marks)
    )
    if result.warped is None:
        return found
    after = [_after(plane, result, result.warped.samples) for plane in planes]
    found.append(_grey("Warped", f"The {source} volume in the frame of the {frame} one.", planes, after, marks))
    if kept is not None:
        for title, values in (("Difference before", before), ("Difference after", after)):
            caption = f"{title.split()[1].capitalize()} registration, minus {frame}, as shares of the range of grey."
            found.append(_difference(title, caption, planes, values, kept))
    return [*found, _determinants(result, planes)]


def _planes(grid: Grid, points: PointArray) -> list[Plane]:
    """Axial, coronal and sagittal slices through the median landmark."""
    middle = np.median(grid.to_indices(points), axis=0)
    return [Plane(grid, a, int(np.clip(round(middle[a]), 0, grid.size[a] - 1))) for a in (2, 1, 0)]


def _before(plane: Plane, result: VolumeResult) -> NDArray[np.float64]:
    """The source at the places of a slice, by linear interpolation; NaN outside."""
    places, shape = plane.places(LONGEST)
    source = result.source
    indices = source.grid.to_indices(places)[:, ::-1].T
    values = map_coordinates(source.samples, indices, order=1, output=np.float64, mode="nearest")
    return np.where(source.grid.contains(places), values, np.nan).reshape(shape)


def _after(plane: Plane, result: VolumeResult, samples: NDArray[Any]) -> NDArray[np.float64]:
    """The result in a slice; NaN where it comes from outside the source."""
    assert result.registration is not None
    places, shape = plane.places(LONGEST)
    carry = result.registration.map_points if result.inverse else result.registration.map_points_inverse
    return np.where(result.source.grid.contains(carry(places)).reshape(shape), plane.shown(samples), np.nan)


def _range(images: Sequence[NDArray[np.float64]]) -> tuple[float, float]:
    """Between which values of all slices grey is shown: without the rarest at both ends."""
    values = np.concatenate([image[np.isfinite(image)] for image in images])
    low, high = np.percentile(values, (0.5, 99.5)) if values.size else (0.0, 1.0)
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1.0)


def _grey(title: str, caption: str, planes: list[Plane], images: list[Any], marks: PointArray) -> Picture:
    low, high = _range(images)

    def paint(axes: Any, plane: Plane, image: Any) -> None:
        axes.imshow(image, extent=plane.extent, origin=_origin(plane), cmap="gray", vmin=low, vmax=high)
        near = plane.near(marks)
        axes.scatter(*near.T, s=12, c=RED if title == "Before" else BLUE, edgecolors="white", linewidths=0.6)

    return _three(title, caption, planes, images, paint)


def _difference(title: str, caption: str, planes: list[Plane], images: list[Any], kept: list[Any]) -> Picture:
    ranges = _range(images), _range(kept)

    def paint(axes: Any, plane: Plane, both: Any) -> Any:
        one, two = ((image - low) / (high - low) for image, (low, high) in zip(both, ranges, strict=True))
        return axes.imshow(one - two, extent=plane.extent, origin=_origin(plane), cmap="RdBu_r", vmin=-1.0, vmax=1.0)

    return _three(title, caption, planes, list(zip(images, kept, strict=True)), paint, "difference")


def _determinants(result: VolumeResult, planes: list[Plane]) -> Picture:
    """The factor by which volumes have grown, in the frame of the result."""
    registration = result.registration
    assert registration is not None
    images = []
    for plane in planes:
        places, shape = plane.places(COARSE)
        images.append((registration.leaving if result.inverse else registration.arriving)(places)[1].reshape(shape))
    scale = determinant_scale(np.concatenate([image.ravel() for image in images]))

    def paint(axes: Any, plane: Plane, image: Any) -> Any:
        masked = np.ma.masked_less_equal(image, 0.0)
        return axes.imshow(masked, extent=plane.extent, origin=_origin(plane), interpolation="bilinear", **scale)

    caption = "Where volumes have shrunk (blue) and grown (red) towards the fixed volume."
    return _three("Map of det J", caption, planes, images, paint, "det J")


def _origin(plane: Plane) -> Any:
    return "upper" if plane.axis == 2 else "lower"


def _three(title: str, caption: str, planes: list[Plane], images: list[Any], paint: Any, bar: str = "") -> Picture:
    """Three slices one above the other, as a PNG."""
    heights = [abs(plane.extent[3] - plane.extent[2]) / plane.extent[1] for plane in planes]
    figure = Figure(figsize=(4.6 if bar else 4.0, min(15.0, 4.0 * sum(heights) + 0.9)), dpi=DPI, layout="constrained")
    FigureCanvasAgg(figure)
    shown: Any = None
    rows = figure.subplots(3, 1, gridspec_kw={"height_ratios": heights})
    for axes, plane, image in zip(rows, planes, images, strict=True):
        axes.set_axis_off()
        shown = paint(axes, plane, image)
        axes.set_xlim(plane.extent[:2])
        axes.set_ylim(plane.extent[2:])
        axes.set_aspect("equal")
        axes.set_title(plane.name, fontsize=8)
    if bar:
        made = figure.colorbar(shown, ax=list(rows), fraction=0.045, pad=0.02, format="%.3g")
        style_bar(made, bar)
    return as_png(title, caption, figure)
