"""The outcome of one registration of volumes, and its pictures: orthogonal slices of the volumes and of det J."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from codegen.registration.grid import Grid, mesh
from codegen.registration.pair_report import Outcome, Picture, as_png, determinant_scale, style_bar
from codegen.registration.pairs import PointArray
from codegen.registration.volumes import Volume, Warped
from codegen.show.figures.picture import BLUE, RED

LONGEST = 240
"""Voxels of the longer side of a slice that are shown."""
COARSE = 72
"""Points along the longer side of a slice at which det J is evaluated."""
NEAR = 3.0
"""Voxels from a slice within which landmarks are marked on it."""
NAMES = ("sagittal", "coronal", "axial")
DPI = 110


@dataclass(frozen=True, eq=False, kw_only=True)
class VolumeResult(Outcome):
    """The outcome of a job of volumes, with the volumes of its report."""

    moving: Volume
    fixed: Volume | None
    inverse: bool = False
    warped: Warped | None = None

    @property
    def source(self) -> Volume:
        """The volume that is warped."""
        return self.fixed if self.inverse and self.fixed is not None else self.moving

    @property
    def target(self) -> Volume | None:
        """The volume that defines the frame of the result."""
        return self.moving if self.inverse else self.fixed


@dataclass(frozen=True)
class Plane:
    """A slice of a grid: the axis normal to it, 0 to 2 for columns, rows and slices, and its index on this axis."""

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
        """The patient's plane nearest to the slice, and the number of the slice."""
        across = np.abs(np.array(self.grid.direction)[:, self.axis])
        return f"{NAMES[int(across.argmax())]}, {('column', 'row', 'slice')[self.axis]} {self.index}"

    @property
    def origin(self) -> Any:
        """The side of the first row in the picture: axial slices have the back of the patient at the bottom."""
        return "upper" if self.axis == 2 else "lower"

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Left, right, bottom and top of the picture, in units of length from the edge of the first voxel."""
        width, height = (self.grid.size[axis] * self.grid.spacing[axis] for axis in self.axes)
        return (0.0, width, height, 0.0) if self.axis == 2 else (0.0, width, 0.0, height)

    def lines(self, most: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Indices along both axes of the picture, at most `most` of each."""
        across, up = (np.arange(0.0, self.grid.size[a], max(1, -(-self.grid.size[a] // most))) for a in self.axes)
        return across, up

    def places(self, most: int) -> tuple[PointArray, tuple[int, int]]:
        """Points of the picture, and its shape."""
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
        """Positions in the picture of the landmarks that are near the slice, shape (n, 2)."""
        indices = self.grid.to_indices(points)
        close = np.abs(indices[:, self.axis] - self.index) <= NEAR
        axes = list(self.axes)
        return np.asarray((indices[close][:, axes] + 0.5) * np.array(self.grid.spacing)[axes])


def volume_pictures(result: VolumeResult) -> list[Picture]:
    """All pictures of a result: the volumes alone if no map exists."""
    inverse, registration, source, target = result.inverse, result.registration, result.source, result.target
    source_name, frame = ("fixed", "moving") if inverse else ("moving", "fixed")
    grid = (result.moving if target is None else target).grid
    marks = result.pairs.moving if inverse else result.pairs.fixed
    # Axial, coronal and sagittal slices through the median landmark.
    middle = np.median(grid.to_indices(marks), axis=0)
    planes = [Plane(grid, a, int(np.clip(round(middle[a]), 0, grid.size[a] - 1))) for a in (2, 1, 0)]
    before, after = [], []
    for plane in planes:
        places, shape = plane.places(LONGEST)
        indices = source.grid.to_indices(places)[:, ::-1].T
        values = map_coordinates(source.samples, indices, order=1, output=np.float64, mode="nearest")
        before.append(np.where(source.grid.contains(places), values, np.nan).reshape(shape))
        if registration is not None and result.warped is not None:
            carried = (registration.map_points if inverse else registration.map_points_inverse)(places)
            inside = source.grid.contains(carried).reshape(shape)
            after.append(np.where(inside, plane.shown(result.warped.samples), np.nan))
    targets = [] if target is None else [plane.shown(target.samples) for plane in planes]
    pictures = []
    if targets:
        caption = "In its own frame, with the landmarks near each slice."
        pictures.append(_grey(frame.capitalize(), caption, planes, targets, marks))
    caption = f"The {source_name} volume at the same places, before registration."
    pictures.append(_grey("Before", caption, planes, before, marks))
    if not after:
        return pictures
    caption = f"The {source_name} volume in the frame of the {frame} one."
    pictures.append(_grey("Warped", caption, planes, after, marks))
    if targets:
        for title, images in (("Difference before", before), ("Difference after", after)):
            caption = f"{title.split()[1].capitalize()} registration, minus {frame}, as shares of the range of grey."
            pictures.append(_difference(title, caption, planes, images, targets))
    return [*pictures, _determinants(result, planes)]


def _grey(title: str, caption: str, planes: list[Plane], images: list[Any], marks: PointArray) -> Picture:
    low, high = _range(images)

    def paint(axes: Any, plane: Plane, image: Any) -> None:
        axes.imshow(image, extent=plane.extent, origin=plane.origin, cmap="gray", vmin=low, vmax=high)
        near = plane.near(marks)
        axes.scatter(*near.T, s=12, c=RED if title == "Before" else BLUE, edgecolors="white", linewidths=0.6)

    return _three(title, caption, planes, images, paint)


def _difference(title: str, caption: str, planes: list[Plane], images: list[Any], targets: list[Any]) -> Picture:
    ranges = _range(images), _range(targets)

    def paint(axes: Any, plane: Plane, both: Any) -> Any:
        one, two = ((image - low) / (high - low) for image, (low, high) in zip(both, ranges, strict=True))
        return axes.imshow(one - two, extent=plane.extent, origin=plane.origin, cmap="RdBu_r", vmin=-1.0, vmax=1.0)

    return _three(title, caption, planes, list(zip(images, targets, strict=True)), paint, "difference")


def _determinants(result: VolumeResult, planes: list[Plane]) -> Picture:
    """The growth of volumes, in the frame of the result."""
    registration = result.registration
    assert registration is not None
    images = []
    for plane in planes:
        places, shape = plane.places(COARSE)
        images.append((registration.leaving if result.inverse else registration.arriving)(places)[1].reshape(shape))
    scale = determinant_scale(np.concatenate([image.ravel() for image in images]))

    def paint(axes: Any, plane: Plane, image: Any) -> Any:
        masked = np.ma.masked_less_equal(image, 0.0)
        return axes.imshow(masked, extent=plane.extent, origin=plane.origin, interpolation="bilinear", **scale)

    caption = "Where volumes have shrunk (blue) and grown (red) towards the fixed volume."
    return _three("Map of det J", caption, planes, images, paint, "det J")


def _range(images: list[Any]) -> tuple[float, float]:
    """The range of grey of all slices, without the rarest values at both ends."""
    values = np.concatenate([image[np.isfinite(image)] for image in images])
    low, high = np.percentile(values, (0.5, 99.5)) if values.size else (0.0, 1.0)
    return (float(low), float(high)) if high > low else (float(low), float(low) + 1.0)


def _three(title: str, caption: str, planes: list[Plane], images: list[Any], paint: Any, bar: str = "") -> Picture:
    """Draw three slices one below the other."""
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
        style_bar(figure.colorbar(shown, ax=list(rows), fraction=0.045, pad=0.02, format="%.3g"), bar)
    return as_png(title, caption, figure)
