"""Images that visitors open, images on the command line, and the bundled example."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path, PurePath

from codegen.errors import ArgumentError, ImageError
from codegen.registration.app.picture import NAME_LENGTH, Picture
from codegen.registration.app.session import Session
from codegen.registration.app.state import Work, pairs_of
from codegen.registration.formats import parse_landmarks
from codegen.registration.images import Limits, read_image

LIMITS = Limits(bytes=32 << 20, pixels=1 << 25)
"""The largest file and the largest image that the page takes; codegen warp takes more."""
_EXAMPLE = files("codegen.registration.app") / "example"


def picture_from(data: bytes, name: str) -> Picture:
    """Decode an image within LIMITS. Only the last part of its name is kept, to be shown; raises ImageError."""
    shown = PurePath(name.replace("\\", "/")).name[-NAME_LENGTH:] or "image"
    image = read_image(data, LIMITS, shown)
    return Picture(image.pixels, shown, data, image.kind, image.profile)


def picture_at(path: Path) -> Picture:
    """The image in a file; raises ImageError."""
    try:
        with path.open("rb") as file:
            data = file.read(LIMITS.bytes + 1)
    except (OSError, ValueError) as error:
        raise ImageError(f"{path} cannot be read ({getattr(error, 'strerror', error)})", "give an image") from error
    return picture_from(data, path.name)


def example() -> Session:
    """Two drawn fishes with their landmarks, of which the sunfish is the porcupine fish in bent coordinates."""
    moving = picture_from((_EXAMPLE / "moving.png").read_bytes(), "porcupine fish.png")
    fixed = picture_from((_EXAMPLE / "fixed.png").read_bytes(), "sunfish.png")
    landmarks = parse_landmarks([("landmarks.csv", (_EXAMPLE / "landmarks.csv").read_bytes())])
    return Session(moving, fixed, Work(pairs_of(landmarks, 1)))


def session_of(images: Sequence[Path]) -> Session:
    """A session on no image (the example), one, or a moving and a fixed one; ArgumentError for more."""
    if not images:
        return example()
    if len(images) > 2:
        raise ArgumentError(f"{len(images)} images were given", "give one, or a moving and a fixed one")
    moving, *fixed = map(picture_at, images)
    return Session(moving, fixed[0] if fixed else None)
