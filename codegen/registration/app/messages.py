"""What a page is told, as values for JSON: images, changes of pairs, and the answers of the solver."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError
from codegen.registration.alignment import KINDS
from codegen.registration.app import solving
from codegen.registration.app.reading import LIMITS, MOST_LANDMARK_BYTES
from codegen.registration.app.session import MOST_PAIRS, SIDE, Pair, Picture, Place, Session, Settings, Side, Task, Work
from codegen.registration.app.solving import Certified, Look, Seen, Shown
from codegen.registration.formats import FORMATS

Message: TypeAlias = Mapping[str, Any]
SCHEMES = {"rk4": "fourth order", "midpoint": "second order", "explicit-euler": "first order"}
"""Schemes that the page offers, and what is said of them."""
ALIGNMENTS = ("auto", *KINDS)
INTERPOLATIONS = ("linear", "cubic", "nearest")
_REMEDY = "load the page again"


def operate(session: Session, message: Message) -> int | None:
    """Do what an edit says; the identity of the pair that was added or completed by it, if one was.

    LandmarkError for what is no edit, and what the session itself raises; nothing has then been changed.
    """
    act = _ACTS.get(str(message.get("do")))
    if act is None:
        raise LandmarkError(f"{str(message.get('do'))[:40]!r} is no edit", _REMEDY)
    try:
        return act(session, message)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LandmarkError(f"the edit {message['do']!r} cannot be read", _REMEDY) from error


def _add(session: Session, message: Message) -> int:
    awaiting = message.get("awaiting")
    pair = session.add(_side(message), _place(message["place"]), None if awaiting is None else int(awaiting))
    return pair.identity


def _move(session: Session, message: Message) -> None:
    session.move(int(message["id"]), _side(message), _place(message["place"]), bool(message["settled"]))


def _rename(session: Session, message: Message) -> None:
    session.rename(int(message["id"]), str(message["name"]))


def _activate(session: Session, message: Message) -> None:
    session.activate(_identities(message), bool(message["active"]))


def _remove(session: Session, message: Message) -> None:
    session.remove(*_identities(message))


def _set(session: Session, message: Message) -> None:
    given = message["settings"]
    settings = Settings(**{f.name: type(f.default)(given[f.name]) for f in fields(Settings)})  # type: ignore[misc]
    known = {"align": ALIGNMENTS, "scheme": SCHEMES, "interpolation": INTERPOLATIONS}
    for name, choices in known.items():
        if getattr(settings, name) not in choices:
            raise ValueError(name)
    session.set(settings)


def _undo(session: Session, message: Message) -> None:
    session.undo()


def _redo(session: Session, message: Message) -> None:
    session.redo()


def _settle(session: Session, message: Message) -> None:
    session.settle()


_ACTS: dict[str, Callable[[Session, Message], int | None]] = {
    "add": _add, "move": _move, "rename": _rename, "activate": _activate, "remove": _remove, "set": _set,
    "undo": _undo, "redo": _redo, "settle": _settle,
}  # fmt: skip


def _side(message: Message) -> Side:
    side: Any = message["side"]
    if side not in ("moving", "fixed"):
        raise ValueError("side")
    return "moving" if side == "moving" else "fixed"


def _place(values: Any) -> Place:
    x, y = values
    return float(x), float(y)


def _identities(message: Message) -> list[int]:
    return [int(identity) for identity in list(message["ids"])[:MOST_PAIRS]]


Values: TypeAlias = dict[str, Any]
ENDS = ((0, 90, 170), (247, 247, 247), (200, 85, 0))
"""Blue for smaller, white, orange for larger: the colour-blind tell them apart."""


def offers() -> Values:
    """What does not change: limits and choices."""
    return {
        "limits": {"image": LIMITS.bytes, "landmarks": MOST_LANDMARK_BYTES, "pairs": MOST_PAIRS},
        "tile": SIDE,
        "alignments": ALIGNMENTS,
        "schemes": SCHEMES,
        "interpolations": INTERPOLATIONS,
        "formats": {name: form.title for name, form in FORMATS.items()},
        "suffixes": sorted({suffix for form in FORMATS.values() for suffix in form.suffixes}),
    }


def images(session: Session) -> Values:
    """The images of a session; `alone` where there is one only."""
    pictures = {"moving": _image(session.moving), "fixed": _image(session.picture("fixed"))}
    return {"type": "images", "alone": session.fixed is None, **pictures}


def _image(picture: Picture) -> Values:
    height, width = picture.shape
    spacing = picture.spacing
    size = None if spacing is None else {"x": spacing.x, "y": spacing.y, "unit": spacing.unit}
    levels = [level.shape[1::-1] for level in picture.levels]
    return {
        "name": picture.name, "width": width, "height": height, "digest": picture.digest, "levels": levels,
        "spacing": size, "edges": picture.edges,
    }  # fmt: skip


def work(session: Session, before: Work | None) -> Values:
    """The pairs that changed since `before`, or all where that is None, in short rows, and what can be undone."""
    now = session.work
    known = {} if before is None else {pair.identity: pair for pair in before.pairs}
    changed = [_row(pair) for pair in now.pairs if known.get(pair.identity) != pair]
    order = [pair.identity for pair in now.pairs]
    same = before is not None and order == [pair.identity for pair in before.pairs]
    return {
        "type": "work", "revision": session.revision, "all": before is None, "changed": changed,
        "order": None if same else order, "settings": dict(vars(now.settings)),
        "undo": session.history.can_undo, "redo": session.history.can_redo,
    }  # fmt: skip


def _row(pair: Pair) -> list[Any]:
    return [pair.identity, *pair.moving, *pair.fixed, pair.name, pair.guessed, pair.active]


def solved(shown: Shown) -> Values:
    """The registration in numbers: residuals by identity, and a chart of where places are in the other image."""
    registration, task = shown.registration, shown.wanted.task
    told: Values = {"type": "solved", "revision": task.revision, "hasty": shown.wanted.hasty, "found": False}
    if registration is None:
        return told
    identities = [pair.identity for pair in task.work.active]
    told |= {
        "found": True, "steps": registration.steps, "met": registration.status == "solved",
        "residuals": _by_identity(identities, registration.residuals), "alignment": registration.alignment.kind,
    }  # fmt: skip
    if task.fixed.spacing is not None:
        told["residual_lengths"] = _by_identity(identities, task.fixed.spacing.lengths(registration.misses))
    if shown.chart is not None:
        charts = {"moving": shown.chart.moving, "fixed": shown.chart.fixed}
        told["chart"] = {side: np.round(places, 3).tolist() for side, places in charts.items()}
    return told


def certified(found: Certified, task: Task) -> Values:
    """What certifies a registration, and how well its landmarks predict each other."""
    told: Values = {
        "type": "certified", "revision": found.revision, "least": _number(found.det_min),
        "most": _number(found.det_max), "folded": found.folded, "round_trip": _number(found.round_trip),
        "left_out": None, "extreme": extreme(found),
    }  # fmt: skip
    identities = [pair.identity for pair in task.work.active]
    told["outliers"] = [identities[k] for k in found.outliers]
    if found.left_out is not None:
        told["left_out"] = _by_identity(identities, found.left_out.errors)
        if task.fixed.spacing is not None:
            told["left_out_lengths"] = _by_identity(identities, task.fixed.spacing.lengths(found.left_out.misses))
    elif len(identities) > solving.MOST_LEFT_OUT:
        told["note"] = f"of more than {solving.MOST_LEFT_OUT} pairs, none is left out in turn"
    return told


def _by_identity(identities: list[int], values: NDArray[np.float64]) -> dict[str, float | None]:
    return {str(identity): _number(float(value)) for identity, value in zip(identities, values, strict=True)}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def seen(shown: Seen, number: int, revision: int) -> bytes:
    """A picture of a window, with the grid and the landmarks on their way."""
    look, window = shown.look, shown.look.window
    header: Values = {
        "type": "frame", "number": number, "revision": revision, "time": look.time,
        "window": None if window is None else [window.left, window.top, window.right, window.bottom],
        "grid": [[np.round(axis, 2).tolist() for axis in axes] for axes in shown.grid],
        "carried": np.round(shown.carried, 2).tolist(),
    }  # fmt: skip
    return packed(header, shown.image)


def areas(found: Certified) -> bytes:
    """The map of det J as a picture, on a logarithmic scale that is the same for growth and shrinking."""
    values = np.log2(np.clip(found.areas, 1e-6, 1e6)) / extreme(found)
    image = np.full((*values.shape, 4), 255, np.uint8)
    for channel in range(3):
        image[..., channel] = np.interp(values, [-1.0, 0.0, 1.0], [end[channel] for end in ENDS]).round()
    return packed({"type": "areas", "extreme": extreme(found)}, image)


def extreme(found: Certified) -> float:
    """The largest of |log2 det J| on the map, 0.1 at least."""
    return max(0.1, float(np.abs(np.log2(np.clip(found.areas, 1e-6, 1e6))).max()))


def packed(header: Mapping[str, Any], image: NDArray[np.uint8]) -> bytes:
    """A picture as a binary message: the length of its description, the description, and RGBA."""
    height, width = image.shape[:2]
    text = json.dumps({**header, "width": width, "height": height}, allow_nan=False).encode()
    return struct.pack("<I", len(text)) + text + image.tobytes()


class Line(Protocol):
    """The way to a browser's tab."""

    def send(self, message: Mapping[str, Any] | bytes) -> None:
        """Send values or a packed picture; whoever is gone hears nothing."""


class Tab:
    """One picture is on its way at a time; of those that come meanwhile only the newest is sent."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.look = Look()
        self._number = 0
        self._busy = False
        self._next: tuple[Seen, int] | None = None

    def show(self, shown: Seen, revision: int) -> None:
        """Send a picture, now or when the one before it has been drawn."""
        if self._busy:
            self._next = (shown, revision)
            return
        self._busy = True
        self._number += 1
        self.line.send(seen(shown, self._number, revision))

    def drawn(self) -> None:
        """The tab has drawn what it was sent."""
        self._busy = False
        if self._next is not None:
            following, self._next = self._next, None
            self.show(*following)
