"""What can be downloaded: files as bytes, made exactly as `codegen warp` makes them."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from codegen.errors import LandmarkError, RegistrationError
from codegen.registration.app.session import Task
from codegen.registration.app.solving import arguments, frame, grid, whole
from codegen.registration.certificate import certify_with_positions
from codegen.registration.fields import displacements, write_field
from codegen.registration.formats import FORMATS, Frames, landmark_texts
from codegen.registration.images import write_image
from codegen.registration.maps import Registration
from codegen.registration.pixels import in_pixels
from codegen.registration.register import register
from codegen.registration.warp import Positions, warp

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


def certified(task: Task) -> tuple[Registration, Positions]:
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
    registration, positions = certified(task)
    interpolation: Any = task.work.settings.interpolation
    pixels = warp(task.moving.pixels, registration, interpolation=interpolation, positions=positions)
    suffix, kind = (".png", "image/png") if task.moving.kind in ("PNG", "JPEG") else (".tif", "image/tiff")
    data = _written(suffix, lambda path: write_image(path, pixels, task.moving.profile))
    return Download(f"{task.moving.stem}_warped{suffix}", kind, data)


def field(task: Task) -> Download:
    """The displacements from fixed to moving at every pixel of the fixed image, .npz."""
    values = displacements(certified(task)[1])
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
    registration, _ = certified(task)
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
