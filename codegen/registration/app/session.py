"""The work of one visitor, without the web page: two images, pairs of points, settings, undo and redo.

Pairs, settings and pictures are immutable. A session holds the present values and the history of pairs and settings.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Collection, Hashable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import PurePath
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from codegen.errors import LandmarkError
from codegen.registration.images import Pixels, Spacing
from codegen.registration.maps import Registration
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.solver import DEFAULT_SCHEME

Side: TypeAlias = Literal["moving", "fixed"]
Place: TypeAlias = tuple[float, float]
Edges: TypeAlias = tuple[str, str, str, str]
State = TypeVar("State")

MOST_PAIRS = 5000  # largest number of pairs on the page; files with more pairs need the command line
MOST_NAME = 200  # largest number of characters of a landmark name
MOST_UNDONE = 200  # largest number of steps that can be undone
PREVIEW = 512
"""Longest side, in pixels, of the preview: a reduced image for the certificate of areas and for animations."""
SMALLEST = 256  # longest side, in pixels, of the smallest reduced copy in `Picture.levels`
NAME_LENGTH = 60  # largest number of characters of an image name
SATURATED = 0.1  # percentage of samples of more than 8 bits that are shown as black, and percentage shown as white
SAMPLED = 1 << 20  # approximate number of samples that determine the grey range
ROWS = 256  # number of rows that are converted together, to avoid a second copy of a large image
SIDE = 512  # number of pixels along each side of a tile; tiles at the right and lower edges may be smaller


@dataclass(frozen=True)
class Pair:
    """The points (x, y), in pixels, of one feature in both images; `identity` is a unique and constant number.

    `guessed` names the image in which the point is only a prediction, or is None if the visitor set both points. A pair
    that is not `active` is shown, but not used in the registration.
    """

    identity: int
    moving: Place
    fixed: Place
    name: str = ""
    guessed: Side | None = None
    active: bool = True

    def at(self, side: Side) -> Place:
        """Return the point in one of the images."""
        return self.moving if side == "moving" else self.fixed

    def put(self, side: Side, place: Place, guessed: Side | None = None) -> Pair:
        """Return the pair with another point in one image, and with a new value of `guessed`."""
        if side == "moving":
            return replace(self, moving=place, guessed=guessed)
        return replace(self, fixed=place, guessed=guessed)

    @property
    def row(self) -> list[object]:
        """The pair as a list for JSON: identity, moving x and y, fixed x and y, name, guessed, active."""
        return [self.identity, *self.moving, *self.fixed, self.name, self.guessed, self.active]


@dataclass(frozen=True)
class Settings:
    """Arguments of `register` and `warp`; `sigma` is in pixels."""

    align: str = "auto"
    sigma: float = 0.0
    scheme: str = DEFAULT_SCHEME
    interpolation: str = "linear"


@dataclass(frozen=True)
class Work:
    """The pairs in their order and the settings: the values that undo and redo change."""

    pairs: tuple[Pair, ...] = ()
    settings: Settings = Settings()

    def find(self, identity: int) -> Pair | None:
        """Return the pair with this identity; None if the pair was deleted."""
        return next((pair for pair in self.pairs if pair.identity == identity), None)

    def with_pair(self, changed: Pair) -> Work:
        """Return the work with `changed`, which replaces the pair of the same identity or is added at the end."""
        if self.find(changed.identity) is None:
            return replace(self, pairs=(*self.pairs, changed))
        return replace(self, pairs=tuple(changed if p.identity == changed.identity else p for p in self.pairs))

    def without(self, identities: Iterable[int]) -> Work:
        """Return the work without the pairs with these identities."""
        removed = set(identities)
        return replace(self, pairs=tuple(pair for pair in self.pairs if pair.identity not in removed))

    @property
    def active(self) -> tuple[Pair, ...]:
        """The pairs that are used in the registration, in their order."""
        return tuple(pair for pair in self.pairs if pair.active)

    def landmarks(self) -> LandmarkPairs:
        """Return the active pairs, unnamed pairs named by number; LandmarkError if empty, or if two points coincide."""
        named = [(pair, pair.name or str(k + 1)) for k, pair in enumerate(self.pairs) if pair.active]
        return LandmarkPairs(
            np.array([pair.moving for pair, _ in named], dtype=np.float64).reshape(-1, 2),
            np.array([pair.fixed for pair, _ in named], dtype=np.float64).reshape(-1, 2),
            tuple(name for _, name in named),
        )


def pairs_of(landmarks: LandmarkPairs, first_identity: int) -> tuple[Pair, ...]:
    """Return the pairs of a file, numbered from `first_identity`; LandmarkError for more than MOST_PAIRS."""
    if len(landmarks) > MOST_PAIRS:
        finding = f"the file has {len(landmarks)} pairs, and the page handles {MOST_PAIRS}"
        raise LandmarkError(finding, "use codegen warp for so many")
    return tuple(
        Pair(first_identity + k, (float(m[0]), float(m[1])), (float(f[0]), float(f[1])), name)
        for k, (m, f, name) in enumerate(zip(landmarks.moving, landmarks.fixed, landmarks.names, strict=True))
    )


def as_record(work: Work) -> dict[str, object]:
    """Return a work as a dict for JSON."""
    return {"pairs": [pair.row for pair in work.pairs], "settings": dict(vars(work.settings))}


def from_record(record: Mapping[str, Any]) -> Work:
    """Return the work from a dict of `as_record`; LandmarkError if the dict is damaged."""
    pairs: list[Pair] = []
    try:
        for identity, a, b, c, d, name, guessed, active in record["pairs"][:MOST_PAIRS]:
            if guessed not in ("moving", "fixed", None):
                raise ValueError(f"{guessed!r} is no image")
            moving, fixed = (float(a), float(b)), (float(c), float(d))
            pairs.append(Pair(int(identity), moving, fixed, str(name)[:MOST_NAME], guessed, bool(active)))
        values = record["settings"]
        settings = Settings(
            str(values["align"]), float(values["sigma"]), str(values["scheme"]), str(values["interpolation"])
        )
        if len({pair.identity for pair in pairs}) < len(pairs):
            raise ValueError("two pairs are the same")
    except (KeyError, TypeError, ValueError) as error:
        raise LandmarkError("the saved work cannot be read", "start again, or load a landmark file") from error
    return Work(tuple(pairs), settings)


@dataclass(frozen=True, eq=False)
class Picture:
    """An image: pixels of shape (h, w) or (h, w, channels), a name, and `source`, the bytes of the file.

    `kind` is the format, PNG, JPEG, TIFF, NIfTI, NRRD or MetaImage, `profile` the colour profile, and `spacing` the
    size of a pixel. `edges` are letters for the sides of a patient at the left, right, upper and lower edge.
    """

    pixels: Pixels
    name: str = "image"
    source: bytes = field(default=b"", repr=False)
    kind: str = "PNG"
    profile: bytes | None = field(default=None, repr=False)
    spacing: Spacing | None = None
    edges: Edges | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def stem(self) -> str:
        """A safe name, without suffix, for files that are made from the picture."""
        letters = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in PurePath(self.name).stem)
        return letters[:NAME_LENGTH] or "image"

    def contains(self, place: Place) -> bool:
        """Return True if a point (x, y) lies within the image."""
        height, width = self.shape
        return -0.5 <= place[0] <= width - 0.5 and -0.5 <= place[1] <= height - 0.5

    @cached_property
    def digest(self) -> str:
        """A hash of the file, or of the pixels without a file."""
        return hashlib.sha256(self.source or self.pixels.tobytes()).hexdigest()

    @cached_property
    def reduction(self) -> int:
        """The number of pixels of the image along the side of a pixel of the preview."""
        return max(1, -(-max(self.shape) // PREVIEW))

    @cached_property
    def levels(self) -> tuple[NDArray[np.uint8], ...]:
        """Copies of 8 bits, (h, w) or (h, w, 3 or 4): the first in full size, each next copy half as large.

        8-bit samples are unchanged. Other samples are scaled to 8 bits, and the most extreme samples are clipped.
        """
        pixels = self.pixels
        if pixels.ndim == 3 and pixels.shape[2] not in (3, 4):  # grey with opacity, or more channels than a screen has
            pixels = pixels[..., 0] if pixels.shape[2] < 3 else pixels[..., :3]
        levels = [_eight_bits(pixels)]
        while max(levels[-1].shape[:2]) > SMALLEST:
            levels.append(np.asarray(Image.fromarray(levels[-1]).reduce(2)))
        return tuple(levels)

    @cached_property
    def preview(self) -> NDArray[np.uint8]:
        """The image, 8 bits, reduced to sides of at most PREVIEW pixels, (h, w) or (h, w, 3 or 4)."""
        pixels = self.levels[0]
        return pixels if self.reduction == 1 else np.asarray(Image.fromarray(pixels).reduce(self.reduction))

    def preview_places(self, step: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y, in pixels of the image, of every `step`-th column and row of the preview, and of the last."""
        height, width = self.preview.shape[:2]
        x, y = (
            np.linspace(0.0, n - 1.0, max(2, round((n - 1) / step) + 1)) if n > 1 else np.zeros(1)
            for n in (width, height)
        )
        return (x + 0.5) * self.reduction - 0.5, (y + 0.5) * self.reduction - 0.5


def _eight_bits(pixels: Pixels) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    stride = max(1, int(np.sqrt(pixels.size / SAMPLED)))
    samples = pixels[::stride, ::stride].astype(np.float64)
    samples = samples[np.isfinite(samples)]
    low = high = 0.0
    if samples.size:
        low, high = map(float, np.percentile(samples, [SATURATED, 100.0 - SATURATED]))
        if high <= low:
            low, high = float(samples.min()), float(samples.max())
    scale = 255.0 / (high - low) if high > low else 0.0
    result = np.empty(pixels.shape, np.uint8)
    for k in range(0, len(pixels), ROWS):
        values = np.nan_to_num(pixels[k : k + ROWS].astype(np.float64), nan=low, posinf=high, neginf=low)
        result[k : k + ROWS] = np.rint(np.clip((values - low) * scale, 0.0, 255.0))
    return result


def tile(picture: Picture, level: int, column: int, row: int) -> bytes | None:
    """Return a tile as PNG, by its column and row in a copy of a picture, `picture.levels[level]`; None outside."""
    if not 0 <= level < len(picture.levels) or min(column, row) < 0:
        return None
    top, left = row * SIDE, column * SIDE
    part = picture.levels[level][top : top + SIDE, left : left + SIDE]
    if not part.size:
        return None
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(part)).save(out, "PNG", compress_level=1)
    return out.getvalue()


class History(Generic[State]):
    """A present state, with earlier states for undo and later states for redo.

    Consecutive changes with the same `gesture`, such as a drag, are one step, until `settle` is called.
    """

    def __init__(self, present: State) -> None:
        self.present = present
        self._past: list[State] = []
        self._future: list[State] = []
        self._gesture: Hashable = None

    def change(self, state: State, gesture: Hashable = None) -> None:
        """Make `state` the present state; this ends redo."""
        if state == self.present:
            return
        if gesture is None or gesture != self._gesture:
            self._past = [*self._past[-MOST_UNDONE + 1 :], self.present]
        self._gesture = gesture
        self._future.clear()
        self.present = state

    def settle(self) -> None:
        """End the gesture, so that the next change is a new step."""
        self._gesture = None

    @property
    def can_undo(self) -> bool:
        """True if a step can be undone."""
        return bool(self._past)

    @property
    def can_redo(self) -> bool:
        """True if a step can be repeated."""
        return bool(self._future)

    def undo(self) -> bool:
        """Undo the last step; return False if no step can be undone."""
        return self._go(self._past, self._future)

    def redo(self) -> bool:
        """Repeat the step that was undone last; return False if no step was undone."""
        return self._go(self._future, self._past)

    def _go(self, source: list[State], target: list[State]) -> bool:
        self._gesture = None
        if not source:
            return False
        target.append(self.present)
        self.present = source.pop()
        return True


@dataclass(frozen=True)
class Task:
    """A snapshot of a session, which another thread can register; `revision` is the revision of the session."""

    work: Work
    moving: Picture
    fixed: Picture
    revision: int


class Session:
    """The images and pairs of a visitor, and their history. `fixed` is None for a single image, deformed by dragging.

    `revision` grows with every change of images, pairs or settings. `registration` is the last map, or None; the map
    predicts the position of a new point in the other image.
    """

    def __init__(self, moving: Picture, fixed: Picture | None = None, work: Work | None = None) -> None:
        self.moving = moving
        self.fixed = fixed
        self.history = History(work or Work())
        self.registration: Registration | None = None
        self.revision = 0
        self._last_identity = max((pair.identity for pair in self.work.pairs), default=0)

    @property
    def work(self) -> Work:
        """The present pairs and settings."""
        return self.history.present

    def picture(self, side: Side) -> Picture:
        """Return the moving or the fixed image; a single image is both."""
        return self.moving if side == "moving" or self.fixed is None else self.fixed

    def task(self) -> Task:
        """Return a snapshot of the session."""
        return Task(self.work, self.moving, self.picture("fixed"), self.revision)

    def open(self, side: Side, picture: Picture) -> None:
        """Replace one image, remove pairs with points outside their image, and clear the history."""
        if side == "moving":
            self.moving = picture
        else:
            self.fixed = picture
        sides: tuple[Side, Side] = ("moving", "fixed")
        outside = [p.identity for p in self.work.pairs if not all(self.picture(s).contains(p.at(s)) for s in sides)]
        self._restart(self.work.without(outside))

    def replace(self, moving: Picture, fixed: Picture | None, work: Work) -> None:
        """Replace images, pairs and settings, and clear the history."""
        self.moving, self.fixed = moving, fixed
        self._restart(work)

    def _restart(self, work: Work) -> None:
        self.history = History(work)
        self._last_identity = max((pair.identity for pair in work.pairs), default=self._last_identity)
        self.registration = None
        self.revision += 1

    def add(self, side: Side, place: Place, awaiting: int | None = None) -> Pair:
        """Add a point in one image and return its pair: a new pair, or the pair with the identity `awaiting`.

        `awaiting` names a pair whose point in this image is only a prediction. For a new pair, the last registration
        predicts the point in the other image; without a registration, its relative position is the same there.
        Raises LandmarkError if there are too many pairs.
        """
        place = self._inside(side, place)
        waiting = self.work.find(awaiting) if awaiting is not None else None
        if waiting is not None and waiting.guessed == side:
            pair = waiting.put(side, place)
        else:
            if len(self.work.pairs) >= MOST_PAIRS:
                raise LandmarkError(f"there are {MOST_PAIRS} pairs already", "delete some, or use codegen warp")
            self._last_identity += 1
            away: Side = "fixed" if side == "moving" else "moving"
            if self.registration is not None:
                registration, points = self.registration, np.array([place])
                carry = registration.map_points if side == "moving" else registration.map_points_inverse
                x, y = carry(points)[0]
            else:
                sizes = self.picture(side).shape[::-1], self.picture(away).shape[::-1]
                x, y = ((v + 0.5) * t / h - 0.5 for v, h, t in zip(place, *sizes, strict=True))
            guess = self._inside(away, (float(x), float(y)))
            pair = Pair(self._last_identity, place, place).put(away, guess, guessed=away)
        self._change(self.work.with_pair(pair))
        return pair

    def move(self, identity: int, side: Side, place: Place, settled: bool = True) -> None:
        """Move a point of a pair; all moves of a drag, until a move is `settled`, are one step of the history."""
        pair = self.work.find(identity)
        if pair is None:
            return
        place = self._inside(side, place)
        guessed = None if pair.guessed in (side, None) else pair.guessed
        self._change(self.work.with_pair(pair.put(side, place, guessed)), ("move", identity, side))
        if settled:
            self.history.settle()

    def rename(self, identity: int, name: str) -> None:
        """Rename a pair; a pair with an empty name is named after its number."""
        pair = self.work.find(identity)
        if pair is not None:
            self._change(self.work.with_pair(replace(pair, name=" ".join(name.split())[:MOST_NAME])))

    def activate(self, identities: Collection[int], active: bool) -> None:
        """Include pairs in the registration, or exclude them."""
        changed = set(identities)
        pairs = tuple(replace(p, active=active) if p.identity in changed else p for p in self.work.pairs)
        self._change(replace(self.work, pairs=pairs))

    def remove(self, *identities: int) -> None:
        """Delete the pairs with these identities."""
        self._change(self.work.without(identities))

    def load(self, landmarks: LandmarkPairs) -> None:
        """Replace all pairs by the pairs of a landmark file; LandmarkError if there are too many."""
        pairs = pairs_of(landmarks, self._last_identity + 1)
        self._last_identity += len(pairs)
        self._change(replace(self.work, pairs=pairs))

    def set(self, settings: Settings) -> None:
        """Change the settings; LandmarkError for an invalid sigma."""
        if not 0.0 <= settings.sigma < np.inf:
            raise LandmarkError(f"sigma is {settings.sigma!r}", "give a distance in pixels that is not negative")
        self._change(replace(self.work, settings=settings), "settings")

    def undo(self) -> bool:
        """Undo the last step; return False if no step can be undone."""
        changed = self.history.undo()
        self.revision += changed
        return changed

    def redo(self) -> bool:
        """Repeat the step that was undone last; return False if no step was undone."""
        changed = self.history.redo()
        self.revision += changed
        return changed

    def _change(self, work: Work, gesture: object = None) -> None:
        if work != self.work:
            self.history.change(work, gesture)
            self.revision += 1

    def _inside(self, side: Side, place: Place) -> Place:
        """Return the point of the image nearest to `place`; LandmarkError for NaN and infinity."""
        height, width = self.picture(side).shape
        x, y = place
        if not (np.isfinite(x) and np.isfinite(y)):
            raise LandmarkError(f"a point is at ({x}, {y})", "give finite numbers")
        return min(max(float(x), -0.5), width - 0.5), min(max(float(y), -0.5), height - 0.5)
