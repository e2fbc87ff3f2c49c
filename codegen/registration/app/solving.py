"""What is computed for the screen: the registration, the warped image in a window, and what certifies them."""

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
from codegen.registration.app.session import Picture, Task, rgba
from codegen.registration.certificate import certify_with_positions
from codegen.registration.formats import FORMATS, landmark_texts
from codegen.registration.formats.base import Frames
from codegen.registration.grid import coarse_grid
from codegen.registration.images import write_image
from codegen.registration.maps import FIRST_STEPS, Registration, in_pixels, in_squares, square_grid
from codegen.registration.noise import Outliers, SigmaEstimate, estimate_sigma, outliers_of
from codegen.registration.register import LeaveOneOut, leave_one_out, out_of_place, register
from codegen.registration.warp import Positions, displacements, warp, write_field

COARSE = 8.0
"""The screen's map is evaluated exactly at every so-many-th pixel of a window, and interpolated in between."""
HASTY_BLOCK = 2
"""Pixels of a window are so much larger while a point is dragged."""
CHART = 33
"""Places along each side of an image at which the page is told where they are in the other one."""
HASTY_STEPS, HASTY_STEPS_OF_FIRST_ORDER = (FIRST_STEPS, 2 * FIRST_STEPS), (4 * FIRST_STEPS, 8 * FIRST_STEPS)
"""While a point is dragged, the first of these numbers of steps with which there is a solution is taken."""
MOST_LEFT_OUT = 60
"""With more landmarks, leaving out each in turn takes longer than anyone waits."""
MOST_JUDGED = 1000
"""With more landmarks, finding those out of place takes longer than anyone waits."""
PORTIONS, PAUSE = 20, 0.01
"""The certificate is computed in portions with pauses of so many seconds, which a dragged point may use."""
GRID_LINES = 16
"""Squares of the drawn grid along the longer side."""
LINE_POINTS, HASTY_LINE_POINTS = 49, 17

Array = NDArray[np.float64]
Lines = tuple[list[Array], list[Array]]


@dataclass(frozen=True)
class Window:
    """A rectangle of an image, in pixels from its outer edges' corner (-0.5, -0.5), and the screen's pixels for it."""

    left: float
    top: float
    right: float
    bottom: float
    width: int
    height: int


@dataclass(frozen=True)
class Look:
    """What one tab shows: a window of the fixed image, at a time along the flow, with or without a grid."""

    window: Window | None = None
    time: float = 1.0
    grid: bool = False


@dataclass(frozen=True)
class Wanted:
    """A task, and how it is to be solved."""

    task: Task
    hasty: bool = False  # while dragging: nearest pixels, and no search for the number of steps
    waiting: bool = False  # the solver is not ready: nothing is moved


@dataclass(frozen=True, eq=False)
class Seen:
    """What a tab is shown: `image` is RGBA, (h, w, 4); `carried` where landmarks are before time 1, (n, 2)."""

    look: Look
    image: NDArray[np.uint8]
    grid: Lines
    carried: Array


@dataclass(frozen=True, eq=False)
class Chart:
    """Where places of each image are in the other one, shape (CHART, CHART, 2) each, rows from the top."""

    moving: Array
    fixed: Array


@dataclass(frozen=True, eq=False)
class Shown:
    """The answer: `registration` is None without pairs or solver, `chart` while a point is dragged."""

    wanted: Wanted
    registration: Registration | None
    seen: dict[str, Seen]
    chart: Chart | None


@dataclass(frozen=True, eq=False)
class Certified:
    """What takes longer: factors of area on a coarse grid over the fixed image, and how well landmarks predict."""

    revision: int
    areas: Array
    det_min: float
    det_max: float
    folded: int
    round_trip: float
    left_out: LeaveOneOut | None
    outliers: tuple[int, ...] = ()


def found(wanted: Wanted, previous: Registration | None) -> Registration | None:
    """The registration of a task, from that of a moment ago; None without pairs or solver. As `register` it raises."""
    work = wanted.task.work
    if not work.active or wanted.waiting:
        return None
    given, method = arguments(wanted.task)
    if wanted.hasty and previous is not None:
        if method["align"] == "auto":  # another alignment in the middle of a drag would move everything else
            method["align"] = previous.matching.align
        rough = previous.flow.module.metadata.order == 1
        for steps in HASTY_STEPS_OF_FIRST_ORDER if rough else HASTY_STEPS:
            with suppress(RegistrationError):
                return in_pixels(register(**given, **method, steps=steps, start=previous, quick=True))
    return in_pixels(register(**given, **method, start=previous))


def shown(
    wanted: Wanted, looks: Mapping[str, Look], previous: Registration | None, known: Registration | None = None
) -> Shown:
    """Register, unless the registration is known, and draw it for every tab."""
    registration = known if known is not None else found(wanted, previous)
    seen = {tab: seen_by(wanted, registration, look) for tab, look in looks.items()}
    charted = None if wanted.hasty or registration is None else chart(registration)
    return Shown(wanted, registration, seen, charted)


def seen_by(wanted: Wanted, registration: Registration | None, look: Look) -> Seen:
    """What one tab shows of a registration."""
    image = np.zeros((1, 1, 4), np.uint8)
    if look.window is not None:
        image = frame(wanted.task, registration, look.time, look.window, smooth=not wanted.hasty)
    points = HASTY_LINE_POINTS if wanted.hasty else LINE_POINTS
    lines = grid(wanted.task.moving, registration, look.time, points) if look.grid else ([], [])
    carried = np.empty((0, 2))
    if registration is not None and look.time < 1.0:
        carried = registration.positions(look.time, registration.pairs.moving)
    return Seen(look, image, lines, carried)


def chart(registration: Registration) -> Chart:
    """Where a coarse grid of each image is in the other one."""
    there = registration.map_points(coarse_grid(registration.shape, CHART))
    back = registration.map_points_inverse(coarse_grid(registration.fixed_shape, CHART))
    return Chart(there.reshape(CHART, CHART, 2), back.reshape(CHART, CHART, 2))


def whole(picture: Picture) -> Window:
    """The window of a picture's preview."""
    height, width = picture.preview.shape[:2]
    return Window(0.0, 0.0, width * picture.reduction, height * picture.reduction, width, height)


def frame(
    task: Task, registration: Registration | None, time: float, window: Window, smooth: bool = True
) -> NDArray[np.uint8]:
    """The moving image at a time along the flow, in a window of the fixed image, as RGBA; transparent outside."""
    x, y = sources(window, registration, time, 1 if smooth else HASTY_BLOCK)
    return sampled(task.moving, x, y, smooth)


def sources(window: Window, registration: Registration | None, time: float, block: int = 1) -> tuple[Array, Array]:
    """Where blocks of pixels of a window come from: x and y in pixels of the moving image, shape (h, w) each."""
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
    """The centres of blocks of the screen's pixels, in pixels of the image."""
    centres = np.minimum(np.arange(-(-count // block)) * block + block / 2, count - 0.5)
    return np.asarray(start - 0.5 + centres * (stop - start) / count)


def _weights(coarse: Array, fine: Array) -> Array:
    """The matrix of linear interpolation from some places to others in their range."""
    if coarse[0] == coarse[-1]:
        return np.full((len(fine), len(coarse)), 1.0 / len(coarse))
    k = np.clip(np.searchsorted(coarse, fine, side="right") - 1, 0, len(coarse) - 2)
    share = (fine - coarse[k]) / (coarse[k + 1] - coarse[k])
    weights = np.zeros((len(fine), len(coarse)))
    rows = np.arange(len(fine))
    weights[rows, k], weights[rows, k + 1] = 1.0 - share, share
    return weights


def sampled(picture: Picture, x: Array, y: Array, smooth: bool) -> NDArray[np.uint8]:
    """A picture at places in pixels of its image, as RGBA; nothing where they are outside.

    It is taken from the copy whose pixels are as far apart as the places, or a little closer.
    """
    # The copy of a picture for places that far apart.
    apart = [np.hypot(np.diff(x, axis=k), np.diff(y, axis=k)) for k in (0, 1)]
    typical = [float(np.median(distances)) for distances in apart if distances.size]
    found = int(np.log2(max(min(typical, default=1.0), 1.0)))
    level = min(found, len(picture.levels) - 1)
    source = picture.levels[level]
    height, width = source.shape[:2]
    u, v = (x + 0.5) / 2**level - 0.5, (y + 0.5) / 2**level - 0.5
    inside = (np.abs(u - (width - 1) / 2) <= width / 2) & (np.abs(v - (height - 1) / 2) <= height / 2)
    result = np.zeros((*x.shape, 4), np.uint8)
    if not inside.any():
        return result
    u, v = np.clip(u, 0, width - 1), np.clip(v, 0, height - 1)
    left, top = int(u[inside].min()), int(v[inside].min())
    part = rgba(source[top : int(v[inside].max()) + 2, left : int(u[inside].max()) + 2])
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


def grid(picture: Picture, registration: Registration | None, time: float, points: int = LINE_POINTS) -> Lines:
    """Lines of a square grid on the moving image, carried by the flow up to a time: lists of x and of y."""
    height, width = picture.shape
    size = max(height, width) / GRID_LINES
    columns, rows = max(1, round(width / size)), max(1, round(height / size))
    u, v = np.linspace(-0.5, width - 0.5, columns + 1), np.linspace(-0.5, height - 0.5, rows + 1)
    along, down = np.linspace(-0.5, width - 0.5, points), np.linspace(-0.5, height - 0.5, points)
    lines = [np.column_stack([np.full(points, at), down]) for at in u]
    lines += [np.column_stack([along, np.full(points, at)]) for at in v]
    if registration is not None:
        carried = registration.positions(time, np.vstack(lines))
        lines = np.split(carried, len(lines))
    return [line[:, 0] for line in lines], [line[:, 1] for line in lines]


def certified(wanted: Wanted, registration: Registration, stale: Callable[[], bool]) -> Certified | None:
    """The extremes of det J on the fixed preview's pixels, areas for the map, and leave-one-out errors.

    None as soon as it is `stale`, because something else is wanted by now.
    """
    areas = area_map(wanted.task.fixed, registration)
    x, y = wanted.task.fixed.preview_places()
    parts = []
    for points in np.array_split(_points(x, y), PORTIONS):
        sleep(PAUSE)
        if stale():
            return None
        parts.append(registration.arriving_determinant(points))
    determinants = np.concatenate(parts)
    without = left_out(wanted, registration)
    return Certified(
        wanted.task.revision,
        areas,
        float(determinants.min()),
        float(determinants.max()),
        int((~(determinants > 0.0)).sum()),
        registration.round_trip,
        without,
        out_of_place(judged(registration), without),
    )


def area_map(picture: Picture, registration: Registration) -> Array:
    """How much larger things have become where they arrive: det J of moving to fixed, on every eighth preview pixel."""
    x, y = picture.preview_places(COARSE)
    return registration.arriving_determinant(_points(x, y)).reshape(len(y), len(x))


def _points(x: Array, y: Array) -> Array:
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def left_out(wanted: Wanted, registration: Registration) -> LeaveOneOut | None:
    """How far off each landmark is by the registration of all others; None for few pairs, and for very many."""
    if not 3 <= len(registration.pairs) <= MOST_LEFT_OUT:
        return None
    given, method = arguments(wanted.task)
    return leave_one_out(**given, **method, start=registration)


def judged(registration: Registration) -> Outliers | None:
    """Landmarks out of place, as `codegen warp` names them; None of very many."""
    return None if len(registration.pairs) > MOST_JUDGED else outliers_of(registration.matching)


def estimated_sigma(task: Task) -> SigmaEstimate:
    """How large the errors of the landmarks are, in pixels, and what makes that doubtful."""
    given, method = arguments(task)
    method.pop("sigma")
    return estimate_sigma(**given, **method)


def arguments(task: Task) -> tuple[dict[str, Any], dict[str, Any]]:
    """What `register` is given: landmarks and grids, whose pixels are squares, and how to go about it."""
    settings = task.work.settings
    grids = [square_grid(picture.shape, picture.spacing) for picture in (task.moving, task.fixed)]
    given = {"pairs": in_squares(task.work.landmarks(), *grids), "shape": grids[0], "fixed_shape": grids[1]}
    return given, {"align": settings.align, "sigma": settings.sigma, "scheme": settings.scheme}


FRAMES, FRAME_MILLISECONDS = 21, 70
PAPER = (255, 255, 255, 255)


@dataclass(frozen=True)
class Download:
    """A file for the visitor."""

    name: str
    kind: str  # MIME type
    data: bytes


def registered(task: Task) -> Registration:
    """The registration from the landmarks alone, whatever was found while dragging; LandmarkError without pairs."""
    if not task.work.active:
        raise LandmarkError("there are no landmarks", "add a pair, or activate one")
    given, method = arguments(task)
    return in_pixels(register(**given, **method))


def certified_task(task: Task) -> tuple[Registration, Positions]:
    """The registration, and where all pixels come from.

    RegistrationError where the map folds or is not inverted well: nobody should take what it makes home.
    """
    registration = registered(task)
    certificate, positions = certify_with_positions(registration)
    if not certificate.passed:
        raise RegistrationError(certificate.message, "look for landmarks out of place, or let them miss by some pixels")
    return registration, positions


def warped_image(task: Task) -> Download:
    """The moving image in the frame of the fixed one, all pixels exact, with the type of its samples."""
    registration, positions = certified_task(task)
    interpolation: Any = task.work.settings.interpolation
    pixels = warp(task.moving.pixels, registration, interpolation=interpolation, positions=positions)
    suffix, kind = (".png", "image/png") if task.moving.kind in ("PNG", "JPEG") else (".tif", "image/tiff")
    data = _written(suffix, lambda path: write_image(path, pixels, task.moving.profile))
    return Download(f"{task.moving.stem}_warped{suffix}", kind, data)


def field(task: Task) -> Download:
    """The displacements from fixed to moving at every pixel of the fixed image, .npz."""
    values = displacements(certified_task(task)[1])
    data = _written(".npz", lambda path: write_field(path, values, "fixed to moving"))
    return Download(f"{task.moving.stem}_displacement_fixed_to_moving.npz", "application/octet-stream", data)


def landmarks(task: Task, form: str) -> tuple[Download, ...]:
    """The pairs in a format of FORMATS: one file, or a moving and a fixed one."""
    frames = Frames(task.moving.shape, task.fixed.shape)
    texts = landmark_texts(task.work.landmarks(), form, frames)
    suffix = FORMATS[form].suffixes[0]
    parts = ("",) if len(texts) == 1 else ("_moving", "_fixed")
    return tuple(
        Download(f"{task.moving.stem}_landmarks{part}{suffix}", "text/plain", text.encode())
        for part, text in zip(parts, texts, strict=True)
    )


def animation(task: Task, with_grid: bool = False) -> Download:
    """The flow of the preview from the moving image to the warped one and back, as a GIF that repeats."""
    registration, _ = certified_task(task)
    frames = [_painted(task, registration, time, with_grid) for time in np.linspace(0.0, 1.0, FRAMES)]
    palette = frames[-1].quantize(255)
    drawn = [image.quantize(255, palette=palette, dither=Image.Dither.NONE) for image in frames + frames[-2:0:-1]]
    durations = [FRAME_MILLISECONDS] * len(drawn)
    durations[0] = durations[FRAMES - 1] = 10 * FRAME_MILLISECONDS
    out = io.BytesIO()
    drawn[0].save(out, "GIF", save_all=True, append_images=drawn[1:], duration=durations, loop=0)
    return Download(f"{task.moving.stem}_flow.gif", "image/gif", out.getvalue())


def _painted(task: Task, registration: Registration, time: float, with_grid: bool) -> Image.Image:
    pixels = frame(task, registration, time, whole(task.fixed))
    picture = Image.new("RGBA", (pixels.shape[1], pixels.shape[0]), PAPER)
    picture.alpha_composite(Image.fromarray(pixels))
    if with_grid:
        pen = ImageDraw.Draw(picture)
        for x, y in zip(*grid(task.moving, registration, time), strict=True):
            places = (np.column_stack([x, y]) + 0.5) / task.fixed.reduction - 0.5
            pen.line([(float(a), float(b)) for a, b in places], fill=(60, 60, 60, 255))
    return picture.convert("RGB")


def _written(suffix: str, write: Callable[[Path], None]) -> bytes:
    """What a function writes into a file of its own, which is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="codegen-") as folder:
        path = Path(folder) / f"file{suffix}"
        write(path)
        return path.read_bytes()
