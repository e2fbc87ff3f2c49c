"""One visitor's work: two images, pairs of points, undo and redo; every operation of the page, without the page.

What a session works on: numbered pairs of points, and how they are registered; values that never change.
"""

from __future__ import annotations

import hashlib
import io
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import PurePath
from typing import Any, Generic, Literal, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from codegen.errors import LandmarkError
from codegen.registration.images import Spacing
from codegen.registration.maps import Registration
from codegen.registration.pairs import LandmarkPairs
from codegen.registration.solver import DEFAULT_SCHEME

Side: TypeAlias = Literal["moving", "fixed"]
Place: TypeAlias = tuple[float, float]

MOST_PAIRS = 5000
"""More pairs than anyone clicks; a file with more is for the command line."""
MOST_NAME = 200
"""Characters of a landmark's name that are kept."""


def other(side: Side) -> Side:
    """The other image."""
    return "fixed" if side == "moving" else "moving"


@dataclass(frozen=True)
class Pair:
    """One feature in both images, in pixels; `identity` stays when pairs before it are deleted.

    `guessed` names the image in which its place is only what the present map says: nobody has put it there. A pair that
    is not `active` is kept and shown, and no part of the registration.
    """

    identity: int
    moving: Place
    fixed: Place
    name: str = ""
    guessed: Side | None = None
    active: bool = True

    def at(self, side: Side) -> Place:
        """Its place in one of the images."""
        return self.moving if side == "moving" else self.fixed

    def put(self, side: Side, place: Place, guessed: Side | None = None) -> Pair:
        """The same pair at another place in one image."""
        if side == "moving":
            return replace(self, moving=place, guessed=guessed)
        return replace(self, fixed=place, guessed=guessed)


@dataclass(frozen=True)
class Settings:
    """How pairs are registered: arguments of `register` and `warp`, distances in pixels."""

    align: str = "auto"
    sigma: float = 0.0
    scheme: str = DEFAULT_SCHEME
    interpolation: str = "linear"


@dataclass(frozen=True)
class Work:
    """Everything that undo and redo go through: the pairs in their order, and the settings."""

    pairs: tuple[Pair, ...] = ()
    settings: Settings = Settings()

    def find(self, identity: int) -> Pair | None:
        """The pair of that identity, if there still is one."""
        return next((pair for pair in self.pairs if pair.identity == identity), None)

    def with_pair(self, changed: Pair) -> Work:
        """The same work with one pair in another state, or with one more."""
        if self.find(changed.identity) is None:
            return replace(self, pairs=(*self.pairs, changed))
        return replace(self, pairs=tuple(changed if p.identity == changed.identity else p for p in self.pairs))

    def without(self, identities: Iterable[int]) -> Work:
        """The same work without some pairs."""
        gone = set(identities)
        return replace(self, pairs=tuple(pair for pair in self.pairs if pair.identity not in gone))

    @property
    def active(self) -> tuple[Pair, ...]:
        """The pairs that are registered, in their order."""
        return tuple(pair for pair in self.pairs if pair.active)

    def landmarks(self) -> LandmarkPairs:
        """The active pairs as `register` takes them; LandmarkError where two points are at one place, or none is given.

        A pair without a name is called by its number among all pairs.
        """
        named = [(pair, pair.name or str(k + 1)) for k, pair in enumerate(self.pairs) if pair.active]
        return LandmarkPairs(
            np.array([pair.moving for pair, _ in named], dtype=np.float64).reshape(-1, 2),
            np.array([pair.fixed for pair, _ in named], dtype=np.float64).reshape(-1, 2),
            tuple(name for _, name in named),
        )


def pairs_of(landmarks: LandmarkPairs, first_identity: int) -> tuple[Pair, ...]:
    """Pairs from a file; LandmarkError when there are more than the page can handle."""
    if len(landmarks) > MOST_PAIRS:
        finding = f"the file has {len(landmarks)} pairs, and the page handles {MOST_PAIRS}"
        raise LandmarkError(finding, "use codegen warp for so many")
    return tuple(
        Pair(first_identity + k, (float(m[0]), float(m[1])), (float(f[0]), float(f[1])), name)
        for k, (m, f, name) in enumerate(zip(landmarks.moving, landmarks.fixed, landmarks.names, strict=True))
    )


def as_record(work: Work) -> dict[str, Any]:
    """Plain values for JSON."""
    return {
        "pairs": [
            [pair.identity, *pair.moving, *pair.fixed, pair.name, pair.guessed, pair.active] for pair in work.pairs
        ],
        "settings": dict(vars(work.settings)),
    }


def from_record(record: Mapping[str, Any]) -> Work:
    """What `as_record` made; LandmarkError when the record has been damaged."""
    try:
        pairs = tuple(map(_pair, record["pairs"][:MOST_PAIRS]))
        given = record["settings"]
        settings = Settings(
            str(given["align"]), float(given["sigma"]), str(given["scheme"]), str(given["interpolation"])
        )
        if len({pair.identity for pair in pairs}) < len(pairs):
            raise ValueError("two pairs are the same")
    except (KeyError, TypeError, ValueError) as error:
        raise LandmarkError("the saved work cannot be read", "start again, or load a landmark file") from error
    return Work(pairs, settings)


def _pair(row: Sequence[Any]) -> Pair:
    identity, a, b, c, d, name, guessed, active = row
    if guessed not in ("moving", "fixed", None):
        raise ValueError(f"{guessed!r} is no image")
    return Pair(int(identity), (float(a), float(b)), (float(c), float(d)), str(name)[:MOST_NAME], guessed, bool(active))


PREVIEW = 512
"""Longest side, in pixels, of the copy on which areas are certified and that animations show."""
SMALLEST = 256
"""No copies are made of what is smaller on its longest side."""
NAME_LENGTH = 60
SATURATED = 0.1
"""Percentage of samples that may be beyond either end of the screen's range, where samples have more than 8 bits."""
SAMPLED = 1 << 20
"""About so many samples say what that range is."""
ROWS = 256
"""Rows that are converted together, so that no second copy of a large image is made."""


@dataclass(frozen=True, eq=False)
class Picture:
    """Pixels of shape (h, w) or (h, w, channels), a name to show, and the bytes that they were read from.

    `kind` is the kind of that file, PNG, JPEG, TIFF, NIfTI, NRRD or MetaImage, `profile` its colour profile, `spacing`
    the size of its pixels, `edges` the sides of a patient towards which its left, right, upper and lower edge lie.
    """

    pixels: NDArray[Any]
    name: str = "image"
    source: bytes = field(default=b"", repr=False)
    kind: str = "PNG"
    profile: bytes | None = field(default=None, repr=False)
    spacing: Spacing | None = None
    edges: tuple[str, str, str, str] | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.pixels.shape[0], self.pixels.shape[1]

    @property
    def stem(self) -> str:
        """A name for files that are made from it: letters and digits only, whatever the visitor's file was called."""
        kept = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in PurePath(self.name).stem)
        return kept[:NAME_LENGTH] or "image"

    def contains(self, place: Place) -> bool:
        """Whether a point lies within the pixels."""
        height, width = self.shape
        return -0.5 <= place[0] <= width - 0.5 and -0.5 <= place[1] <= height - 0.5

    @cached_property
    def digest(self) -> str:
        """A hash of the content."""
        return hashlib.sha256(self.source or self.pixels.tobytes()).hexdigest()

    @cached_property
    def reduction(self) -> int:
        """Preview pixels are averages of so many pixels by so many."""
        return max(1, -(-max(self.shape) // PREVIEW))

    @cached_property
    def levels(self) -> tuple[NDArray[np.uint8], ...]:
        """Copies of 8 bits, (h, w) or (h, w, 3 or 4): the first of full size, each next one half as wide and high.

        Samples of 8 bits stay as they are; others are stretched between the smallest and the largest but a few.
        """
        found = [_eight_bits(_bands(self.pixels))]
        while max(found[-1].shape[:2]) > SMALLEST:
            found.append(np.asarray(Image.fromarray(found[-1]).reduce(2)))
        return tuple(found)

    @cached_property
    def preview(self) -> NDArray[np.uint8]:
        """The small copy, 8 bits, (h, w) or (h, w, 3 or 4)."""
        pixels = self.levels[0]
        return pixels if self.reduction == 1 else np.asarray(Image.fromarray(pixels).reduce(self.reduction))

    def preview_places(self, step: float = 1.0) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """X and y, in pixels of the image, of every `step`-th pixel of the preview; the last lies at its far edge."""
        height, width = self.preview.shape[:2]
        return _centres(width, step, self.reduction), _centres(height, step, self.reduction)


def rgba(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """An image of 8 bits with four channels."""
    if image.ndim == 3 and image.shape[2] == 4:
        return image
    result = np.full((*image.shape[:2], 4), 255, np.uint8)
    result[..., :3] = image if image.ndim == 3 else image[..., None]
    return result


def _centres(count: int, step: float, reduction: int) -> NDArray[np.float64]:
    places = np.linspace(0.0, count - 1.0, max(2, round((count - 1) / step) + 1)) if count > 1 else np.zeros(1)
    return (places + 0.5) * reduction - 0.5


def _bands(pixels: NDArray[Any]) -> NDArray[Any]:
    """Grey, RGB or RGBA: without the opacity of grey, and without more bands than a screen shows."""
    if pixels.ndim == 3 and pixels.shape[2] not in (3, 4):
        return pixels[..., 0] if pixels.shape[2] < 3 else pixels[..., :3]
    return pixels


def _eight_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    low, high = _range(pixels)
    scale = 255.0 / (high - low) if high > low else 0.0
    result = np.empty(pixels.shape, np.uint8)
    for k in range(0, len(pixels), ROWS):
        values = np.nan_to_num(pixels[k : k + ROWS].astype(np.float64), nan=low, posinf=high, neginf=low)
        result[k : k + ROWS] = np.rint(np.clip((values - low) * scale, 0.0, 255.0))
    return result


def _range(pixels: NDArray[Any]) -> tuple[float, float]:
    """The samples that are to be black and white."""
    stride = max(1, int(np.sqrt(pixels.size / SAMPLED)))
    values = pixels[::stride, ::stride].astype(np.float64)
    values = values[np.isfinite(values)]
    if not values.size:
        return 0.0, 0.0
    low, high = np.percentile(values, [SATURATED, 100.0 - SATURATED])
    return (float(low), float(high)) if high > low else (float(values.min()), float(values.max()))


SIDE = 512
"""Pixels along each side of a tile; those at the right and at the lower edge have what is left."""


def tile(picture: Picture, level: int, column: int, row: int) -> bytes | None:
    """A tile of one of the picture's levels, counted from the top left; None where there is none."""
    if not 0 <= level < len(picture.levels) or min(column, row) < 0:
        return None
    top, left = row * SIDE, column * SIDE
    part = picture.levels[level][top : top + SIDE, left : left + SIDE]
    if not part.size:
        return None
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(part)).save(out, "PNG", compress_level=1)
    return out.getvalue()


State = TypeVar("State")

MOST = 200
"""So many steps can be undone."""


class History(Generic[State]):
    """A present state with those before and after it.

    Changes that carry the same `gesture` replace one another until `settle` is called: a drag is one step.
    """

    def __init__(self, present: State) -> None:
        self.present = present
        self._past: list[State] = []
        self._future: list[State] = []
        self._gesture: Hashable = None

    def change(self, state: State, gesture: Hashable = None) -> None:
        """Make a state the present one."""
        if state == self.present:
            return
        if gesture is None or gesture != self._gesture:
            self._past = [*self._past[-MOST + 1 :], self.present]
        self._gesture = gesture
        self._future.clear()
        self.present = state

    def settle(self) -> None:
        """End the gesture: the next change is a step of its own."""
        self._gesture = None

    @property
    def can_undo(self) -> bool:
        """Whether there is a state before this one."""
        return bool(self._past)

    @property
    def can_redo(self) -> bool:
        """Whether there is a state that was undone."""
        return bool(self._future)

    def undo(self) -> bool:
        """Go back one step; whether there was one."""
        return self._go(self._past, self._future)

    def redo(self) -> bool:
        """Go forward to what was undone; whether there was anything."""
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
    """What is to be registered, taken from a session at one moment, so that it can be worked on elsewhere."""

    work: Work
    moving: Picture
    fixed: Picture
    revision: int


class Session:
    """Images, pairs and their history. `fixed` is None where one image alone is bent by dragging its points.

    `revision` grows with every change of what is to be registered; `registration` is the last that was found, and
    tells where the partner of a new point is to be expected.
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
        """The image of one side; the same for both where there is only one."""
        return self.moving if side == "moving" or self.fixed is None else self.fixed

    def task(self) -> Task:
        """The present work, to be registered."""
        return Task(self.work, self.moving, self.picture("fixed"), self.revision)

    def number(self, identity: int) -> int:
        """The number of a pair as it is shown, counted from 1; 0 where there is none."""
        return next((k + 1 for k, pair in enumerate(self.work.pairs) if pair.identity == identity), 0)

    # --- images -----------------------------------------------------------------------------------------------------

    def open(self, side: Side, picture: Picture) -> None:
        """Show another image. Points that lie outside it go, and nothing before this can be undone."""
        if side == "moving":
            self.moving = picture
        else:
            self.fixed = picture
        sides: tuple[Side, Side] = ("moving", "fixed")
        gone = [p.identity for p in self.work.pairs if not all(self.picture(s).contains(p.at(s)) for s in sides)]
        self._restart(self.work.without(gone))

    def open_alone(self, picture: Picture) -> None:
        """Show one image, whose points are dragged."""
        self.moving, self.fixed = picture, None
        self._restart(Work(settings=self.work.settings))

    def replace(self, moving: Picture, fixed: Picture | None, work: Work) -> None:
        """Start again with other images and pairs."""
        self.moving, self.fixed = moving, fixed
        self._restart(work)

    def _restart(self, work: Work) -> None:
        self.history = History(work)
        self._last_identity = max((pair.identity for pair in work.pairs), default=self._last_identity)
        self.registration = None
        self.revision += 1

    # --- pairs ------------------------------------------------------------------------------------------------------

    def add(self, side: Side, place: Place, awaiting: int | None = None) -> Pair:
        """Put a point at an empty place: a new pair, or the partner of the pair `awaiting` one in this image.

        The partner of a new point is put where it is `expected`. LandmarkError when there are too many pairs.
        """
        place = self._inside(side, place)
        waiting = self.work.find(awaiting) if awaiting is not None else None
        if waiting is not None and waiting.guessed == side:
            pair = waiting.put(side, place)
        else:
            if len(self.work.pairs) >= MOST_PAIRS:
                raise LandmarkError(f"there are {MOST_PAIRS} pairs already", "delete some, or use codegen warp")
            self._last_identity += 1
            away = other(side)
            guess = self._inside(away, self.expected(side, place))
            pair = Pair(self._last_identity, place, place).put(away, guess, guessed=away)
        self._change(self.work.with_pair(pair))
        return pair

    def move(self, identity: int, side: Side, place: Place, settled: bool = True) -> None:
        """Put a point elsewhere; until it is `settled` all moves of a drag are one step of the history."""
        pair = self.work.find(identity)
        if pair is None:
            return
        place = self._inside(side, place)
        guessed = None if pair.guessed in (side, None) else pair.guessed
        self._change(self.work.with_pair(pair.put(side, place, guessed)), ("move", identity, side))
        if settled:
            self.history.settle()

    def rename(self, identity: int, name: str) -> None:
        """Call a pair otherwise; without a name it is called by its number."""
        pair = self.work.find(identity)
        if pair is not None:
            self._change(self.work.with_pair(replace(pair, name=" ".join(name.split())[:MOST_NAME])))

    def activate(self, identities: Collection[int], active: bool) -> None:
        """Let pairs take part in the registration, or leave them out of it."""
        changed = set(identities)
        pairs = tuple(replace(p, active=active) if p.identity in changed else p for p in self.work.pairs)
        self._change(replace(self.work, pairs=pairs))

    def remove(self, *identities: int) -> None:
        """Delete pairs."""
        self._change(self.work.without(identities))

    def clear(self) -> None:
        """Delete all pairs."""
        self.remove(*(pair.identity for pair in self.work.pairs))

    def load(self, landmarks: LandmarkPairs) -> None:
        """Take all pairs from a landmark file instead; it can be undone. LandmarkError when there are too many."""
        pairs = pairs_of(landmarks, self._last_identity + 1)
        self._last_identity += len(pairs)
        self._change(replace(self.work, pairs=pairs))

    def set(self, settings: Settings) -> None:
        """Register in another way."""
        if not 0.0 <= settings.sigma < np.inf:
            raise LandmarkError(f"sigma is {settings.sigma!r}", "give a distance in pixels that is not negative")
        self._change(replace(self.work, settings=settings), "settings")

    # --- history ----------------------------------------------------------------------------------------------------

    def undo(self) -> bool:
        """Take the last step back; whether there was one."""
        return self._went(self.history.undo())

    def redo(self) -> bool:
        """Do again what was undone; whether there was anything."""
        return self._went(self.history.redo())

    def settle(self) -> None:
        """The mouse button was released: the next drag is a step of its own."""
        self.history.settle()

    def _went(self, there_was_one: bool) -> bool:
        if there_was_one:
            self.revision += 1
        return there_was_one

    def _change(self, work: Work, gesture: object = None) -> None:
        if work != self.work:
            self.history.change(work, gesture)
            self.revision += 1

    def _inside(self, side: Side, place: Place) -> Place:
        """A place within the image's pixels."""
        height, width = self.picture(side).shape
        x, y = place
        if not (np.isfinite(x) and np.isfinite(y)):
            raise LandmarkError(f"a point is at ({x}, {y})", "give finite numbers")
        return min(max(float(x), -0.5), width - 0.5), min(max(float(y), -0.5), height - 0.5)

    def expected(self, side: Side, place: Place) -> Place:
        """Where the partner of a point is, by the last registration; at the same share of the image without one."""
        if self.registration is not None:
            points = np.array([place])
            known = self.registration
            found = known.map_points(points) if side == "moving" else known.map_points_inverse(points)
            return float(found[0, 0]), float(found[0, 1])
        here, there = self.picture(side).shape, self.picture(other(side)).shape
        x, y = ((v + 0.5) * t / h - 0.5 for v, t, h in zip(place, there[::-1], here[::-1], strict=True))
        return x, y
