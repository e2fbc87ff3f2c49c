"""Images that visitors open, images on the command line, and the bundled example."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path, PurePath
from typing import TypeAlias

from codegen.errors import ArgumentError, ImageError, PointsError
from codegen.registration.app.picture import NAME_LENGTH, Picture
from codegen.registration.app.session import Session
from codegen.registration.app.slices import ending_of, read_slice
from codegen.registration.app.state import Work, pairs_of
from codegen.registration.formats import FORMATS, parse_landmarks
from codegen.registration.images import Limits, read_image

LIMITS = Limits(bytes=32 << 20, pixels=1 << 25)
"""The largest file and the largest image that the page takes; codegen warp takes more."""
MOST_LANDMARK_BYTES = 8 << 20
"""The largest landmark file that the page takes."""
_WORDS = {"moving": ("moving", "source"), "fixed": ("fixed", "target")}
"""Words in names of landmark files, and the image whose points these hold."""
Files: TypeAlias = list[tuple[str, bytes]]
_EXAMPLE = files("codegen.registration.app") / "example"


def picture_from(data: bytes, name: str) -> Picture:
    """Decode an image within LIMITS. Only the last part of its name is kept, to be shown; raises ImageError."""
    shown = PurePath(name.replace("\\", "/")).name[-NAME_LENGTH:] or "image"
    if len(data) <= LIMITS.bytes and (ending := ending_of(data)) is not None:
        found = read_slice(data, ending, LIMITS, shown)
        return Picture(found.pixels, shown, data, found.kind, None, found.spacing, found.edges)
    image = read_image(data, LIMITS, shown)
    return Picture(image.pixels, shown, data, image.kind, image.profile, image.spacing)


def picture_at(path: Path) -> Picture:
    """The image in a file; raises ImageError."""
    try:
        with path.open("rb") as file:
            data = file.read(LIMITS.bytes + 1)
    except (OSError, ValueError) as error:
        raise ImageError(f"{path} cannot be read ({getattr(error, 'strerror', error)})", "give an image") from error
    return picture_from(data, path.name)


def in_order(files: Files) -> tuple[Files, list[str]]:
    """Landmark files with the moving one first, and what the visitor should know of that; nothing for a single file.

    Names tell them apart where one of them has a word for its image; otherwise they are taken as they were chosen.
    PointsError where a file came without its partner.
    """
    if len(files) == 1 and _is_half(*files[0]):
        remedy = "choose the moving and the fixed file together, holding Ctrl (or Cmd) while clicking the second"
        raise PointsError(f"{files[0][0]} has the points of one image only", remedy)
    if len(files) != 2:
        return files, []
    first, second = (_side(name) for name, _ in files)
    named = first != second
    turned = named and (first == "fixed" or second == "moving")
    ordered = files[::-1] if turned else files
    moving, fixed = (name for name, _ in ordered)
    why = "as their names say" if named else "in the order in which they came; rename them to contain moving and fixed"
    return ordered, [f"{moving} was taken for the moving image and {fixed} for the fixed one, {why}"]


def _side(name: str) -> str:
    """The image that a file's name tells of, if it tells of one."""
    found = [side for side, words in _WORDS.items() if any(word in name.lower() for word in words)]
    return found[0] if len(found) == 1 else ""


def _is_half(name: str, data: bytes) -> bool:
    """Whether a file looks like one of a pair."""
    begin = data[:2000].decode("utf-8-sig", errors="replace")
    fitting = [form for form in FORMATS.values() if name.lower().endswith(form.suffixes) and form.recognises(begin)]
    return bool(fitting) and all(form.files == 2 for form in fitting)


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
