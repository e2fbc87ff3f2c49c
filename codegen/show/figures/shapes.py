"""Scenes drawn by matplotlib: at an instant, as a motion in one picture, and as films."""

from __future__ import annotations

import math
import shutil
import subprocess
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np
from matplotlib import patches
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray
from PIL import Image

from codegen.drawing import Arrow, Box, Circle, Ground, Item, Mark, Mass, Rod, Scene, Trail
from codegen.errors import ArgumentError
from codegen.show.figures.picture import (
    BLUE,
    CRIMSON,
    DARK,
    GREY,
    SKY,
    STYLE,
    Colour,
    Look,
    body_colours,
    letter_size,
    present_style,
)

SHOTS, MANY_SHOTS = 9, 7  # number of instants in a picture of one body, and of arrows in a picture of several bodies

_FAINT = 0.18
_PALE, _SHADOW = "#DCE6EE", "#A8A8A8"
Extent = tuple[float, float, float, float]


def bodies_of(scene: Scene) -> int:
    """Return the number of bodies of a scene."""
    return max(len(array) for item in scene.items for _, array in item.expressions())


def is_moving(item: Item) -> bool:
    """Return True if an item changes with time."""
    return any(array.shape[1] > 1 for _, array in item.expressions())


def extent(scenes: Sequence[Scene]) -> Extent:
    """Return the left, right, bottom and top limits of the finite points of all scenes, with a margin."""
    xs, ys = [np.zeros(0)], [np.zeros(0)]
    for item in (item for scene in scenes for item in scene.items):
        for x, y in _corners(item):
            finite = np.isfinite(x) & np.isfinite(y)
            xs.append(x[finite])
            ys.append(y[finite])
    x, y = np.concatenate(xs), np.concatenate(ys)
    if x.size == 0:
        return -1.0, 1.0, -1.0, 1.0
    left, right, bottom, top = float(x.min()), float(x.max()), float(y.min()), float(y.max())
    longest = max(right - left, top - bottom) or 1.0
    # A straight path also needs a margin.
    wide, high = (max(0.05 * longest, (0.25 * longest - side) / 2) for side in (right - left, top - bottom))
    return left - wide, right + wide, bottom - high, top + high


def prepare(axes: Axes, room: Extent) -> None:
    """Set the limits `room` and equal scales on both axes."""
    axes.set_xlim(room[0], room[1])
    axes.set_ylim(room[2], room[3])
    axes.set_aspect("equal", anchor="N")
    axes.tick_params(length=0, labelsize=letter_size(8), colors=GREY)
    for spine in axes.spines.values():
        spine.set_visible(False)


def instant(scene: Scene, index: int, room: Extent, *, moving: bool, alpha: float = 1.0) -> Iterator[Artist]:
    """Yield the artists of moving items, or of fixed items, at the time `index` of a scene; trails end at this time."""
    for item in scene.items:
        if is_moving(item) is moving:
            for body, colour in enumerate(_colours(scene, item)):
                yield from _artists(item, body, index, room, colour, alpha)


def course(axes: Axes, scene: Scene, room: Extent, instants: int = SHOTS) -> None:
    """Draw a motion in one picture: trails, and a few instants with the last in full colour.

    If a scene has several bodies, only arrows are repeated, and black squares mark the ends of trails.
    """
    prepare(axes, room)
    count, last = bodies_of(scene), scene.t.size - 1
    shots = np.unique(np.linspace(0, last, instants if count == 1 else MANY_SHOTS).round().astype(int))
    for artist in instant(scene, last, room, moving=False):
        axes.add_artist(artist)
    for item in filter(is_moving, scene.items):
        if isinstance(item, Trail):
            own = shots[-1:]
        elif count > 1 and isinstance(item, Mass):
            own = shots[:0]  # the ends of its trail are marked
        elif count > 1 and not isinstance(item, Arrow):
            own = shots[[0, -1]]
        else:
            own = shots
        for body, colour in enumerate(_colours(scene, item)):
            for shot in own.tolist():
                alpha = 1.0 if shot == last or count > 1 else _FAINT + 0.3 * shot / last
                for artist in _artists(item, body, shot, room, colour, alpha):
                    axes.add_artist(artist)
        if isinstance(item, Trail) and count > 1:
            x, y = item.point
            axes.plot(x[:, 0], y[:, 0], "o", color=DARK, markersize=4, markerfacecolor="white", zorder=4)
            axes.plot(x[:, -1], y[:, -1], "s", color="black", markersize=5, zorder=4)
    legend(axes, scene, ends=True)


def _colours(scene: Scene, item: Item) -> list[Colour]:
    """Return a colour for each body of an item; with a single body, the first trail differs from other trails."""
    count = bodies_of(scene)
    if not is_moving(item):
        single = GREY
    elif isinstance(item, Trail):
        single = SKY if item is next(other for other in scene.items if isinstance(other, Trail)) else _SHADOW
    else:
        single = BLUE
    return body_colours(count, single)[: max(len(array) for _, array in item.expressions())]


def legend(axes: Axes, scene: Scene, *, ends: bool) -> None:
    """Add a legend of labelled items below the axes; with `ends`, include the marks at the ends of trails."""
    handles: dict[str, Artist] = {}
    for item in scene.items:
        if item.label:
            handles.setdefault(item.label, _handle(item, _colours(scene, item)[0]))
    if ends and bodies_of(scene) > 1 and any(isinstance(item, Trail) for item in scene.items):
        handles["start"] = Line2D([], [], color=DARK, marker="o", markersize=4, markerfacecolor="white", linestyle="")
        handles["end"] = Line2D([], [], color="black", marker="s", markersize=5, linestyle="")
    if handles:
        columns = 3 if present_style().is_slide else 5  # a slide gives less than half of its width to the drawing
        location: Look = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.06), "ncols": columns, "columnspacing": 1.4}
        axes.legend(list(handles.values()), list(handles), fontsize=letter_size(8.5), **location)


def _handle(item: Item, colour: Colour) -> Artist:
    if isinstance(item, Arrow):
        return Line2D([], [], color=CRIMSON, marker=r"$\rightarrow$", markersize=11, linestyle="")
    if isinstance(item, Circle):
        return Line2D([], [], color=DARK, linestyle=(0, (5, 3)), linewidth=1.0)
    if isinstance(item, Trail):
        return Line2D([], [], color=colour, linewidth=1.6)
    if isinstance(item, Mass):
        return Line2D([], [], color=colour, marker="o", markersize=7, linestyle="")
    if isinstance(item, Mark):
        return Line2D([], [], color="black", marker="*", markersize=8, linestyle="")
    return patches.Patch(facecolor=_PALE, edgecolor=DARK)


def _artists(item: Item, body: int, index: int, room: Extent, colour: Colour, alpha: float) -> Iterator[Artist]:
    """Yield the artists of an item for one body at the time `index`; none if a number is not finite."""

    def at(array: np.ndarray) -> float:
        return float(array[min(body, len(array) - 1), min(index, array.shape[1] - 1)])

    style: Look
    if isinstance(item, Trail):
        x, y = (array[min(body, len(array) - 1), : index + 1] for array in item.point)
        yield Line2D(x, y, color=colour, linewidth=1.5, zorder=2)
        return
    item = item.mapped(at)
    if not all(np.isfinite(number) for _, number in item.expressions()):
        return
    if isinstance(item, Rod):
        x, y = zip(item.start, item.end, strict=True)
        yield Line2D(x, y, color=DARK, linewidth=2.4, alpha=alpha, solid_capstyle="round", zorder=3)
    elif isinstance(item, Mass):
        style = {"facecolor": colour, "edgecolor": "white", "linewidth": 0.8}
        yield patches.Circle(item.centre, item.radius, alpha=alpha, zorder=3.6, **style)
    elif isinstance(item, Box):
        style = {"facecolor": _PALE, "edgecolor": DARK, "linewidth": 1.2}
        corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * (item.width / 2, item.height / 2)
        c, s = np.cos(item.angle), np.sin(item.angle)
        corners = np.asarray(corners @ np.array([[c, s], [-s, c]]) + item.centre)
        yield patches.Polygon(corners, closed=True, alpha=alpha, zorder=2.8, **style)
    elif isinstance(item, Arrow):
        if np.hypot(*item.vector) > 4e-3 * max(room[1] - room[0], room[3] - room[2]):
            tip = item.start[0] + item.vector[0], item.start[1] + item.vector[1]
            style = {"arrowstyle": "-|>", "mutation_scale": 8.0, "shrinkA": 0.0, "shrinkB": 0.0, "linewidth": 1.3}
            yield patches.FancyArrowPatch(item.start, tip, color=CRIMSON, alpha=max(alpha, 0.45), zorder=3.8, **style)
    elif isinstance(item, Circle):
        style = {"fill": False, "edgecolor": DARK, "linestyle": (0, (5, 3)), "linewidth": 1.0}
        yield patches.Circle(item.centre, item.radius, alpha=alpha, zorder=1.6, **style)
    elif isinstance(item, Mark):
        yield Line2D([item.place[0]], [item.place[1]], color="black", marker="*", markersize=8, alpha=alpha, zorder=3.9)
    elif isinstance(item, Ground):  # a line with a hatched band to its right
        start, end = np.array(item.start), np.array(item.end)
        length = float(np.hypot(*(end - start))) or 1.0
        right = np.array([end[1] - start[1], start[0] - end[0]]) / length
        depth = 0.025 * max(room[1] - room[0], room[3] - room[2])
        band = [start, end, end + depth * right, start + depth * right]
        style = {"fill": False, "hatch": "//////", "edgecolor": "#b0b0b0", "linewidth": 0.0}
        yield patches.Polygon(band, closed=True, zorder=1.0, **style)
        yield Line2D([start[0], end[0]], [start[1], end[1]], color=DARK, linewidth=1.4, zorder=1.1)


def _corners(item: Item) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield the extreme points of an item, as pairs of arrays x and y."""
    if isinstance(item, Rod | Ground):
        yield item.start
        yield item.end
    elif isinstance(item, Arrow):
        yield item.start
        yield item.start[0] + item.vector[0], item.start[1] + item.vector[1]
    elif isinstance(item, Trail):
        yield item.point
    elif isinstance(item, Mark):
        yield item.place
    elif isinstance(item, Mass | Circle):
        for sign in (-1.0, 1.0):
            yield item.centre[0] + sign * item.radius, item.centre[1] + sign * item.radius
    elif isinstance(item, Box):
        for sign in (-1.0, 1.0):
            c, s = np.abs(np.cos(item.angle)), np.abs(np.sin(item.angle))
            wide, high = (c * item.width + s * item.height) / 2, (s * item.width + c * item.height) / 2
            yield item.centre[0] + sign * wide, item.centre[1] + sign * high


RATE = 25  # frames per second; GIF stores hundredths of a second, so this rate is exact
SHORTEST, LONGEST, PAUSE = 2.0, 8.0, 1.0
"""Shortest and longest duration of a film, and the pause at its end, in seconds."""
FINE = 6  # number of steps of trails between two frames
Frame: TypeAlias = NDArray[np.uint8]  # an image (height, width, 3)

Progress: TypeAlias = Callable[[Iterable[Frame], int], Iterable[Frame]]
"""A function that returns the given frames and may show progress; its second argument is their number."""

_DPI = 100
_COLOURS = 128


def scene_times(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the times of the scene that `save` needs: evenly spaced from the first to the last node time in `t`.

    A frame is drawn at every `FINE`-th time; the times between make trails smooth.
    """
    length = min(max(float(t[-1] - t[0]), SHORTEST), LONGEST)
    return np.linspace(t[0], t[-1], FINE * round(RATE * length) + 1)


def save(scene: Scene, title: str, path: Path, progress: Progress = lambda frames, count: frames) -> None:
    """Write a film of a scene, which has the times of `scene_times`, to a file .gif or .mp4.

    Raises ArgumentError if ffmpeg is missing or fails.
    """
    write = _write_mp4 if path.suffix.lower() == ".mp4" else _write_gif
    count = len(scene.t[::FINE])
    with matplotlib.rc_context(STYLE):
        write(progress(frames(scene, title), count), count, path)


def frames(scene: Scene, title: str) -> Iterator[Frame]:
    """Yield a frame for every `FINE`-th time of a scene; fixed items are drawn once."""
    room = extent([scene])
    ratio = (room[3] - room[2]) / (room[1] - room[0])
    longest = 8.0 if ratio < 0.6 else 6.4
    width = longest if ratio <= 1.0 else max(longest / ratio, 0.6 * longest)
    height = min(longest, max(0.25 * longest, ratio * width)) + 1.0  # with title and legend
    # Encoders of films need even numbers of pixels.
    width, height = (2 * round(side * _DPI / 2) / _DPI for side in (width, height))
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    canvas: Any = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    prepare(axes, room)
    for artist in instant(scene, 0, room, moving=False):
        axes.add_artist(artist)
    legend(axes, scene, ends=False)
    figure.suptitle("\n".join(textwrap.wrap(title.rstrip("."), int(12 * width))), fontsize=9.5)
    # The clock has as many decimals as the time needs between frames.
    decimals = max(0, 2 - math.floor(math.log10(float(scene.t[-1] - scene.t[0]) or 1.0)))
    clock = axes.set_title(f"t = {float(scene.t[-1]):.{decimals}f}", loc="left", fontsize=9.5)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    clock.set_animated(True)
    canvas.draw()
    background = canvas.copy_from_bbox(figure.bbox)
    for frame in range(0, scene.t.size, FINE):
        canvas.restore_region(background)
        moving = [axes.add_artist(artist) for artist in instant(scene, frame, room, moving=True)]
        for artist in sorted(moving, key=lambda artist: artist.get_zorder()):
            axes.draw_artist(artist)
            artist.remove()
        clock.set_text(f"t = {scene.t[frame]:.{decimals}f}")
        axes.draw_artist(clock)
        yield np.array(canvas.buffer_rgba())[:, :, :3]


def _write_gif(pictures: Iterable[Frame], count: int, path: Path) -> None:
    images = [Image.fromarray(picture) for picture in pictures]
    # A common palette prevents flicker; the first and the last frame together have all colours.
    sample = Image.new("RGB", (images[0].width, 2 * images[0].height))
    sample.paste(images[0], (0, 0))
    sample.paste(images[-1], (0, images[0].height))
    palette = sample.quantize(_COLOURS)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[(colours > 242).all(axis=1)] = 255  # the background stays white
    palette.putpalette(colours.ravel().tolist())
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    durations = [1000 // RATE] * (count - 1) + [round(1000 * PAUSE)]
    first.save(path, format="GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)


def _write_mp4(pictures: Iterable[Frame], count: int, path: Path) -> None:
    program, remaining = shutil.which("ffmpeg"), iter(pictures)
    if program is None:
        raise ArgumentError(f"{path} needs the program ffmpeg", "install ffmpeg, or let the file end in .gif")
    picture = next(remaining)
    height, width, _ = picture.shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(RATE), "-i", "-"]
    target = ["-an", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]  # all players read yuv420p
    command = [program, "-loglevel", "error", "-y", *source, *target]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, **pipes) as process:  # type: ignore[call-overload]
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # the error of ffmpeg is raised below
            process.stdin.write(picture.tobytes())
            for picture in remaining:
                process.stdin.write(picture.tobytes())
            for _ in range(round(RATE * PAUSE)):
                process.stdin.write(picture.tobytes())
        _, errors = process.communicate()
    if process.returncode:
        lines = errors.decode(errors="replace").strip().splitlines() or [f"exit status {process.returncode}"]
        raise ArgumentError(f"ffmpeg could not write the film ({lines[-1]})", "let the file end in .gif")
