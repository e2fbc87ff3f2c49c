"""Moving pictures of a drawing: GIF by Pillow, MP4 by ffmpeg."""

from __future__ import annotations

import math
import shutil
import subprocess
import textwrap
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from itertools import chain, repeat
from pathlib import Path
from typing import Any, TypeAlias

import matplotlib
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from codegen.drawing import Scene
from codegen.errors import ArgumentError
from codegen.plots import shapes
from codegen.plots.purposes import STYLE

RATE = 25
"""Frames per second; a GIF counts hundredths of a second, and can keep this rate exactly."""
SHORTEST, LONGEST, PAUSE = 2.0, 8.0, 1.0
"""Seconds that a film lasts: as long as the motion within these limits, then a pause at the end."""
FINE = 6
"""Parts of the time between two frames, at which trails have points."""

Frame: TypeAlias = NDArray[np.uint8]
"""An image (height, width, 3)."""

Progress: TypeAlias = Callable[[Iterable[Frame], int], Iterable[Frame]]
"""Hands on as many frames as it is told, and may show how far they are."""

_DPI = 100
_COLOURS = 128


def scene_times(t: NDArray[np.float64]) -> NDArray[np.float64]:
    """The times at which `save` needs the scene of a motion with nodes t: evenly spaced, both ends included.

    A frame is drawn for every `FINE`-th of them; the others make trails smooth.
    """
    length = min(max(float(t[-1] - t[0]), SHORTEST), LONGEST)
    return np.linspace(t[0], t[-1], FINE * round(RATE * length) + 1)


def save(scene: Scene, title: str, path: Path, progress: Progress = lambda frames, count: frames) -> None:
    """Film a scene at the times `scene_times`; the ending of the path, .gif or .mp4, decides the kind of file.

    Raises ArgumentError when ffmpeg is missing or fails.
    """
    write = _write_mp4 if path.suffix.lower() == ".mp4" else _write_gif
    count = len(scene.t[::FINE])
    with matplotlib.rc_context(STYLE):
        write(progress(frames(scene, title), count), count, path)


def require_ffmpeg(path: Path) -> str:
    """The program that makes films of type .mp4; ArgumentError when there is none."""
    program = shutil.which("ffmpeg")
    if program is None:
        raise ArgumentError(f"{path} needs the program ffmpeg", "install ffmpeg, or let the file end in .gif")
    return program


def frames(scene: Scene, title: str) -> Iterator[Frame]:
    """Draw a frame for every `FINE`-th time of a scene: what stands still once, what moves every time."""
    room = shapes.extent([scene])
    figure, axes, clock = _stage(scene, title, room)
    canvas: Any = figure.canvas
    background = canvas.copy_from_bbox(figure.bbox)
    for frame in range(0, scene.t.size, FINE):
        canvas.restore_region(background)
        moving = [axes.add_artist(artist) for artist in shapes.instant(scene, frame, room, moving=True)]
        for artist in sorted(moving, key=lambda artist: artist.get_zorder()):
            axes.draw_artist(artist)
            artist.remove()
        clock.set_text(_clock(scene.t[frame], scene.t))
        axes.draw_artist(clock)
        yield np.array(canvas.buffer_rgba())[:, :, :3]


def _stage(scene: Scene, title: str, room: shapes.Extent) -> tuple[Figure, Any, Any]:
    """Figure, axes and clock, drawn without what moves."""
    width, height = _size(room)
    figure = Figure(figsize=(width, height), dpi=_DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    shapes.prepare(axes, room)
    for artist in shapes.instant(scene, 0, room, moving=False):
        axes.add_artist(artist)
    shapes.legend(axes, scene, ends=False)
    figure.suptitle("\n".join(textwrap.wrap(title.rstrip("."), int(12 * width))), fontsize=9.5)
    clock = axes.set_title(_clock(float(scene.t[-1]), scene.t), loc="left", fontsize=9.5)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    clock.set_animated(True)
    figure.canvas.draw()
    return figure, axes, clock


def _size(room: shapes.Extent) -> tuple[float, float]:
    """Width and height in inches that suit a scene, with room for title and legend."""
    ratio = (room[3] - room[2]) / (room[1] - room[0])
    longest = 8.0 if ratio < 0.6 else 6.4
    width = longest if ratio <= 1.0 else max(longest / ratio, 0.6 * longest)
    height = min(longest, max(0.25 * longest, ratio * width)) + 1.0
    # Encoders of films want even numbers of pixels.
    return 2 * round(width * _DPI / 2) / _DPI, 2 * round(height * _DPI / 2) / _DPI


def _clock(t: float, times: NDArray[np.float64]) -> str:
    """The time, with as many decimals as it changes by between frames."""
    duration = float(times[-1] - times[0]) or 1.0
    decimals = max(0, 2 - math.floor(math.log10(duration)))
    return f"t = {t:.{decimals}f}"


def _write_gif(pictures: Iterable[Frame], count: int, path: Path) -> None:
    images = [Image.fromarray(picture) for picture in pictures]
    # One palette for all, else still parts would flicker; the last frame has all colours, the first perhaps others.
    sample = Image.new("RGB", (images[0].width, 2 * images[0].height))
    sample.paste(images[0], (0, 0))
    sample.paste(images[-1], (0, images[0].height))
    palette = sample.quantize(_COLOURS)
    colours = np.array(palette.getpalette()).reshape(-1, 3)
    colours[(colours > 242).all(axis=1)] = 255  # paper stays white
    palette.putpalette(colours.ravel().tolist())
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images)
    durations = [1000 // RATE] * (count - 1) + [round(1000 * PAUSE)]
    first.save(path, format="GIF", save_all=True, append_images=others, duration=durations, loop=0, optimize=False)


def _write_mp4(pictures: Iterable[Frame], count: int, path: Path) -> None:
    program, paused = require_ffmpeg(path), _with_pause(pictures)
    first = next(paused)
    with _encoder(program, first.shape, path) as process:
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # what ffmpeg has to say to that follows
            for picture in chain([first], paused):
                process.stdin.write(picture.tobytes())
        _, errors = process.communicate()
    if process.returncode:
        lines = errors.decode(errors="replace").strip().splitlines() or [f"exit status {process.returncode}"]
        raise ArgumentError(f"ffmpeg could not write the film ({lines[-1]})", "let the file end in .gif")


def _with_pause(pictures: Iterable[Frame]) -> Iterator[Frame]:
    for picture in pictures:
        yield picture
    yield from repeat(picture, round(RATE * PAUSE))


def _encoder(program: str, shape: tuple[int, ...], path: Path) -> subprocess.Popen[bytes]:
    height, width, _ = shape
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(RATE), "-i", "-"]
    # Every player knows this pixel format.
    target = ["-an", "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(path)]
    words = [program, "-loglevel", "error", "-y", *source, *target]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
