"""Computations for the page: registration, pictures of the warped image, the certificate, and downloads."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy.ndimage import map_coordinates

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.app.session import Picture, Side, Task
from codegen.registration.certificate import certify_with_positions
from codegen.registration.formats import FORMATS, landmark_texts
from codegen.registration.formats.base import Frames
from codegen.registration.grid import coarse_grid
from codegen.registration.images import write_image
from codegen.registration.maps import FIRST_STEPS, Registration, in_pixels, in_squares, square_grid
from codegen.registration.noise import SigmaEstimate, estimate_sigma, outliers_of
from codegen.registration.register import LeaveOneOut, leave_one_out, out_of_place, register
from codegen.registration.warp import Positions, displacements, warp, write_field

COARSE = 8.0
"""Distance, in pixels of the screen, of the points at which the map is evaluated; the others are interpolated."""
HASTY_BLOCK = 2  # side, in pixels of the screen, of the blocks of one colour that are drawn while a point is dragged
CHART = 33  # number of points along each side of an image whose positions in the other image are sent to the page
HASTY_STEPS, HASTY_STEPS_OF_FIRST_ORDER = (FIRST_STEPS, 2 * FIRST_STEPS), (4 * FIRST_STEPS, 8 * FIRST_STEPS)
"""Numbers of time steps that are tried in turn during a drag: for schemes of higher order, and of first order."""
MOST_LEFT_OUT = 60  # largest number of landmarks for leave-one-out errors, because the visitor waits
MOST_JUDGED = 1000  # largest number of landmarks for the search for outliers, because the visitor waits
PORTIONS, PAUSE = 20, 0.01
"""Number of portions of the certificate, and the pauses between them, in seconds, for drawing dragged points."""
GRID_LINES = 16  # number of squares of the drawn grid along the longer side
LINE_POINTS, HASTY_LINE_POINTS = 49, 17
FRAMES, FRAME_MILLISECONDS = 21, 70
PAPER = (255, 255, 255, 255)

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Window:
    """A rectangle of an image: edges in pixels from its corner (-0.5, -0.5), width and height in pixels on screen."""

    left: float
    top: float
    right: float
    bottom: float
    width: int
    height: int


@dataclass(frozen=True)
class Look:
    """The view of a tab: a window of the fixed image, a time from 0 (not warped) to 1, with or without a grid."""

    window: Window | None = None
    time: float = 1.0
    grid: bool = False


@dataclass(frozen=True)
class Wanted:
    """A request to register and draw a task: while a point is dragged, `hasty`, with nearest pixels and few steps.

    `waiting` is True while the solver is not ready; images are then drawn without registration.
    """

    task: Task
    hasty: bool = False
    waiting: bool = False


@dataclass(frozen=True, eq=False)
class Seen:
    """A picture for a tab: `image` is RGBA, shape (h, w, 4), and the lines of the grid have shape (points, 2) each.

    `carried` (n, 2) has the moving landmarks at the time of the view, and is empty at time 1.
    """

    look: Look
    image: NDArray[np.uint8]
    grid: list[Array]
    carried: Array


@dataclass(frozen=True, eq=False)
class Shown:
    """The pictures of all tabs; `registration` is None without pairs or solver.

    `chart` maps a coarse grid on each image to the other image, shape (CHART, CHART, 2); None while a point is dragged.
    """

    wanted: Wanted
    registration: Registration | None
    seen: dict[str, Seen]
    chart: dict[Side, Array] | None


@dataclass(frozen=True, eq=False)
class Certified:
    """Results of longer computations: leave-one-out errors, outliers, and det J, the growth of areas by the map.

    `areas` is det J on a coarse grid over the fixed image, and `extreme` the largest |log2 det J| there, at least 0.1.
    `folded` counts the pixels where det J is not positive.
    """

    revision: int
    areas: Array
    extreme: float
    det_min: float
    det_max: float
    folded: int
    round_trip: float
    left_out: LeaveOneOut | None
    outliers: tuple[int, ...] = ()


@dataclass(frozen=True)
class Download:
    """A file for the visitor; `kind` is its MIME type."""

    name: str
    kind: str
    data: bytes


def arguments(task: Task) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return two dicts of arguments of `register`: landmarks and grids of square pixels, and the method."""
    settings = task.work.settings
    grids = [square_grid(picture.shape, picture.spacing) for picture in (task.moving, task.fixed)]
    landmarks = {"pairs": in_squares(task.work.landmarks(), *grids), "shape": grids[0], "fixed_shape": grids[1]}
    return landmarks, {"align": settings.align, "sigma": settings.sigma, "scheme": settings.scheme}


def found(wanted: Wanted, previous: Registration | None) -> Registration | None:
    """Return the registration of a task, with `previous` as warm start; None without active pairs or solver.

    Raises the errors of `register`.
    """
    if not wanted.task.work.active or wanted.waiting:
        return None
    landmarks, method = arguments(wanted.task)
    if wanted.hasty and previous is not None:
        if method["align"] == "auto":  # a change of the alignment during a drag would make the whole image jump
            method["align"] = previous.matching.align
        is_first_order = previous.flow.module.metadata.order == 1
        for steps in HASTY_STEPS_OF_FIRST_ORDER if is_first_order else HASTY_STEPS:
            with suppress(RegistrationError):
                return in_pixels(register(**landmarks, **method, steps=steps, start=previous, quick=True))
    return in_pixels(register(**landmarks, **method, start=previous))


def shown(
    wanted: Wanted, looks: Mapping[str, Look], previous: Registration | None, known: Registration | None = None
) -> Shown:
    """Return the pictures of all tabs; register first unless the registration is `known`."""
    registration = known if known is not None else found(wanted, previous)
    seen = {}
    for tab, look in looks.items():
        image, lines, carried = np.zeros((1, 1, 4), np.uint8), list[Array](), np.empty((0, 2))
        if look.window is not None:
            image = frame(wanted.task, registration, look.time, look.window, smooth=not wanted.hasty)
        if look.grid:
            points = HASTY_LINE_POINTS if wanted.hasty else LINE_POINTS
            lines = grid(wanted.task.moving, registration, look.time, points)
        if registration is not None and look.time < 1.0:
            carried = registration.positions(look.time, registration.pairs.moving)
        seen[tab] = Seen(look, image, lines, carried)
    chart: dict[Side, Array] | None = None
    if not wanted.hasty and registration is not None:
        to_fixed = registration.map_points(coarse_grid(registration.grid, CHART))
        to_moving = registration.map_points_inverse(coarse_grid(registration.fixed_grid, CHART))
        chart = {"moving": to_fixed.reshape(CHART, CHART, 2), "fixed": to_moving.reshape(CHART, CHART, 2)}
    return Shown(wanted, registration, seen, chart)


def frame(
    task: Task, registration: Registration | None, time: float, window: Window, smooth: bool = True
) -> NDArray[np.uint8]:
    """Return the moving image, warped up to a time from 0 to 1, in a window, as RGBA; transparent outside."""
    x, y = sources(window, registration, time, 1 if smooth else HASTY_BLOCK)
    return sampled(task.moving, x, y, smooth)


def sources(window: Window, registration: Registration | None, time: float, block: int = 1) -> tuple[Array, Array]:
    """Return x and y in the moving image, shape (h, w) each, of the centres of blocks of `block`² screen pixels."""
    fine_x = _places(window.left, window.right, window.width, block)
    fine_y = _places(window.top, window.bottom, window.height, block)
    coarse_x, coarse_y = (np.linspace(v[0], v[-1], max(2, round(len(v) / COARSE) + 1)) for v in (fine_x, fine_y))
    places = np.stack(np.meshgrid(coarse_x, coarse_y), axis=-1)
    if registration is not None:
        flat = registration.positions(time, places.reshape(-1, 2), inverse=True)
        places = flat.reshape(places.shape)
    along, down = _weights(coarse_x, fine_x), _weights(coarse_y, fine_y)
    return down @ places[..., 0] @ along.T, down @ places[..., 1] @ along.T


def _places(start: float, stop: float, count: int, block: int) -> Array:
    """Return the centres, in pixels of the image, of blocks that divide `count` pixels of the screen."""
    centres = np.minimum(np.arange(-(-count // block)) * block + block / 2, count - 0.5)
    return np.asarray(start - 0.5 + centres * (stop - start) / count)


def _weights(coarse: Array, fine: Array) -> Array:
    """Return the matrix, shape (fine, coarse), of linear interpolation from coarse to fine points in their range."""
    return np.array([np.interp(fine, coarse, unit) for unit in np.eye(len(coarse))]).T


def sampled(picture: Picture, x: Array, y: Array, smooth: bool) -> NDArray[np.uint8]:
    """Return the colours of a picture at points in its pixels, as RGBA; transparent outside.

    Samples are taken from the smallest reduced copy with pixels no farther apart than the points. `smooth` selects
    linear interpolation, instead of the nearest pixel.
    """
    apart = [np.hypot(np.diff(x, axis=k), np.diff(y, axis=k)) for k in (0, 1)]
    typical = [float(np.median(distances)) for distances in apart if distances.size]
    level = min(int(np.log2(max(min(typical, default=1.0), 1.0))), len(picture.levels) - 1)
    source = picture.levels[level]
    height, width = source.shape[:2]
    u, v = (x + 0.5) / 2**level - 0.5, (y + 0.5) / 2**level - 0.5
    inside = (np.abs(u - (width - 1) / 2) <= width / 2) & (np.abs(v - (height - 1) / 2) <= height / 2)
    result = np.zeros((*x.shape, 4), np.uint8)
    if not inside.any():
        return result
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    left, top = int(u[inside].min()), int(v[inside].min())
    stored = source[top : int(v[inside].max()) + 2, left : int(u[inside].max()) + 2]
    part = np.full((*stored.shape[:2], 4), 255, np.uint8)
    part[..., : stored.shape[2] if stored.ndim == 3 else 3] = stored if stored.ndim == 3 else stored[..., None]
    u, v = np.clip(u - left, 0, part.shape[1] - 1), np.clip(v - top, 0, part.shape[0] - 1)
    if smooth:
        places = np.stack([v, u])
        for channel in range(4):
            values = map_coordinates(part[..., channel].astype(np.float32), places, order=1, mode="nearest")
            result[..., channel] = np.rint(values)
    else:
        result[:] = part[np.rint(v).astype(np.intp), np.rint(u).astype(np.intp)]
    result[~inside] = 0
    return result


def grid(picture: Picture, registration: Registration | None, time: float, points: int = LINE_POINTS) -> list[Array]:
    """Return lines, shape (points, 2) each, of a square grid on the moving image, warped up to a time from 0 to 1."""
    height, width = picture.shape
    size = max(height, width) / GRID_LINES
    columns, rows = max(1, round(width / size)), max(1, round(height / size))
    u, v = np.linspace(-0.5, width - 0.5, columns + 1), np.linspace(-0.5, height - 0.5, rows + 1)
    along, down = np.linspace(-0.5, width - 0.5, points), np.linspace(-0.5, height - 0.5, points)
    lines = [np.column_stack([np.full(points, at), down]) for at in u]
    lines += [np.column_stack([along, np.full(points, at)]) for at in v]
    if registration is not None:
        lines = np.split(registration.positions(time, np.vstack(lines)), len(lines))
    return lines


def certified(wanted: Wanted, registration: Registration, stale: Callable[[], bool]) -> Certified | None:
    """Return extremes and a map of det J, leave-one-out errors and outliers; None as soon as `stale()` is True."""
    fixed, landmarks = wanted.task.fixed, registration.pairs
    x, y = fixed.preview_places(COARSE)
    areas = registration.arriving(_points(x, y))[1].reshape(len(y), len(x))
    x, y = fixed.preview_places()
    parts = []
    for points in np.array_split(_points(x, y), PORTIONS):
        sleep(PAUSE)
        if stale():
            return None
        parts.append(registration.arriving(points)[1])
    determinants, left_out = np.concatenate(parts), None
    if 3 <= len(landmarks) <= MOST_LEFT_OUT:
        given, method = arguments(wanted.task)
        left_out = leave_one_out(**given, **method, start=registration)
    outliers = None if len(landmarks) > MOST_JUDGED else outliers_of(registration.matching)
    return Certified(
        wanted.task.revision, areas, max(0.1, float(np.abs(np.log2(np.clip(areas, 1e-6, 1e6))).max())),
        float(determinants.min()), float(determinants.max()), int((~(determinants > 0.0)).sum()),
        registration.round_trip, left_out, out_of_place(outliers, left_out),
    )  # fmt: skip


def _points(x: Array, y: Array) -> Array:
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def estimated_sigma(task: Task) -> SigmaEstimate:
    """Return the estimated standard deviation of the landmark errors, in pixels."""
    landmarks, method = arguments(task)
    method.pop("sigma")
    return estimate_sigma(**landmarks, **method)


def certified_task(task: Task) -> tuple[Registration, Positions]:
    """Return a certified registration without warm start, for downloads, and the positions of all pixels.

    Raises LandmarkError without pairs, and RegistrationError if the map folds or its round trip is inaccurate.
    """
    if not task.work.active:
        raise LandmarkError("there are no landmarks", "add a pair, or activate one")
    landmarks, method = arguments(task)
    registration = in_pixels(register(**landmarks, **method))
    certificate, positions = certify_with_positions(registration)
    if not certificate.passed:
        raise RegistrationError(certificate.message, "look for landmarks out of place, or let them miss by some pixels")
    return registration, positions


def warped_image(task: Task) -> Download:
    """Return a file of the moving image, warped to the fixed image with exact positions; samples keep their type."""
    registration, positions = certified_task(task)
    interpolation: Any = task.work.settings.interpolation
    pixels = warp(task.moving.pixels, registration, interpolation=interpolation, positions=positions)
    suffix, kind = (".png", "image/png") if task.moving.kind in ("PNG", "JPEG") else (".tif", "image/tiff")
    data = _written(suffix, lambda path: write_image(path, pixels, task.moving.profile))
    return Download(f"{task.moving.stem}_warped{suffix}", kind, data)


def field(task: Task) -> Download:
    """Return an .npz file of the displacements from fixed to moving at every pixel of the fixed image."""
    values = displacements(certified_task(task)[1])
    data = _written(".npz", lambda path: write_field(path, values, "fixed to moving"))
    return Download(f"{task.moving.stem}_displacement_fixed_to_moving.npz", "application/octet-stream", data)


def landmarks(task: Task, form: str) -> tuple[Download, ...]:
    """Return the landmarks in a format of FORMATS: one file, or a moving and a fixed file."""
    frames = Frames(task.moving.shape, task.fixed.shape)
    texts = landmark_texts(task.work.landmarks(), form, frames)
    suffix = FORMATS[form].suffixes[0]
    parts = ("",) if len(texts) == 1 else ("_moving", "_fixed")
    return tuple(
        Download(f"{task.moving.stem}_landmarks{part}{suffix}", "text/plain", text.encode())
        for part, text in zip(parts, texts, strict=True)
    )


def animation(task: Task, with_grid: bool = False) -> Download:
    """Return a repeating GIF of the reduced moving image on its way to the warped image and back."""
    registration, _ = certified_task(task)
    (height, width), side = task.fixed.preview.shape[:2], task.fixed.reduction
    window, frames = Window(0.0, 0.0, width * side, height * side, width, height), []
    for time in np.linspace(0.0, 1.0, FRAMES):
        pixels = frame(task, registration, time, window)
        picture = Image.new("RGBA", (pixels.shape[1], pixels.shape[0]), PAPER)
        picture.alpha_composite(Image.fromarray(pixels))
        if with_grid:
            pen = ImageDraw.Draw(picture)
            for line in grid(task.moving, registration, time):
                places = (line + 0.5) / task.fixed.reduction - 0.5
                pen.line([(float(a), float(b)) for a, b in places], fill=(60, 60, 60, 255))
        frames.append(picture.convert("RGB"))
    palette = frames[-1].quantize(255)
    drawn = [image.quantize(255, palette=palette, dither=Image.Dither.NONE) for image in frames + frames[-2:0:-1]]
    durations = [FRAME_MILLISECONDS] * len(drawn)
    durations[0] = durations[FRAMES - 1] = 10 * FRAME_MILLISECONDS
    out = io.BytesIO()
    drawn[0].save(out, "GIF", save_all=True, append_images=drawn[1:], duration=durations, loop=0)
    return Download(f"{task.moving.stem}_flow.gif", "image/gif", out.getvalue())


def _written(suffix: str, write: Callable[[Path], None]) -> bytes:
    """Return the bytes that `write` writes to a temporary file with this suffix."""
    with tempfile.TemporaryDirectory(prefix="codegen-") as folder:
        path = Path(folder) / f"file{suffix}"
        write(path)
        return path.read_bytes()
