"""Messages between the page and the server: edits, images, changes of pairs, and results of the solver, as JSON."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError
from codegen.registration.alignment import KINDS
from codegen.registration.app import solving
from codegen.registration.app.reading import LIMITS, MOST_LANDMARK_BYTES
from codegen.registration.app.session import MOST_PAIRS, SIDE, Picture, Session, Settings, Side, Task, Work
from codegen.registration.app.solving import Certified, Look, Seen, Shown
from codegen.registration.formats import FORMATS

Message: TypeAlias = Mapping[str, Any]
Values: TypeAlias = dict[str, Any]

SCHEMES = {"rk4": "fourth order", "midpoint": "second order", "explicit-euler": "first order"}
"""Schemes in the page, with their orders."""
ALIGNMENTS = ("auto", *KINDS)
INTERPOLATIONS = ("linear", "cubic", "nearest")
COLOURS = ((0, 90, 170), (247, 247, 247), (200, 85, 0))
"""Blue for smaller, white, orange for larger areas: distinct for the colour-blind."""
_REMEDY = "load the page again"


def operate(session: Session, message: Message) -> int | None:
    """Apply an edit; return the identity of the pair that it adds or completes.

    Raises LandmarkError for an invalid edit, and the errors of the session; the session is then unchanged.
    """
    action = str(message.get("do"))
    try:
        match action:
            case "add":
                awaiting = message.get("awaiting")
                side, place = _side(message), _place(message)
                return session.add(side, place, None if awaiting is None else int(awaiting)).identity
            case "move":
                session.move(int(message["id"]), _side(message), _place(message), bool(message["settled"]))
            case "rename":
                session.rename(int(message["id"]), str(message["name"]))
            case "activate":
                session.activate(_identities(message), bool(message["active"]))
            case "remove":
                session.remove(*_identities(message))
            case "set":
                values = message["settings"]
                settings = Settings(**{f.name: type(f.default)(values[f.name]) for f in fields(Settings)})  # type: ignore[misc]
                choices = {"align": ALIGNMENTS, "scheme": SCHEMES, "interpolation": INTERPOLATIONS}
                for name, allowed in choices.items():
                    if getattr(settings, name) not in allowed:
                        raise ValueError(name)
                session.set(settings)
            case "undo":
                session.undo()
            case "redo":
                session.redo()
            case "settle":
                session.settle()
            case _:
                raise LandmarkError(f"{action[:40]!r} is no edit", _REMEDY)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise LandmarkError(f"the edit {action!r} cannot be read", _REMEDY) from error
    return None


def _side(message: Message) -> Side:
    side: Any = message["side"]
    if side not in ("moving", "fixed"):
        raise ValueError("side")
    return "moving" if side == "moving" else "fixed"


def _place(message: Message) -> tuple[float, float]:
    x, y = message["place"]
    return float(x), float(y)


def _identities(message: Message) -> list[int]:
    return [int(identity) for identity in list(message["ids"])[:MOST_PAIRS]]


def offers() -> Values:
    """Return the limits and choices, which are constant."""
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
    """Return the images of a session; `alone` is True for a single one."""
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
    """Return the pairs that changed since `before`, or all pairs if it is None, as rows, and the state of undo."""
    now = session.work
    earlier = {} if before is None else {pair.identity: pair for pair in before.pairs}
    changed = [pair.row for pair in now.pairs if earlier.get(pair.identity) != pair]
    order = [pair.identity for pair in now.pairs]
    same_order = before is not None and order == [pair.identity for pair in before.pairs]
    return {
        "type": "work", "revision": session.revision, "all": before is None, "changed": changed,
        "order": None if same_order else order, "settings": dict(vars(now.settings)),
        "undo": session.history.can_undo, "redo": session.history.can_redo,
    }  # fmt: skip


def solved(shown: Shown) -> Values:
    """Return the numbers of a registration: residuals by identity, and a chart of points in the other image."""
    registration, task = shown.registration, shown.wanted.task
    values: Values = {"type": "solved", "revision": task.revision, "hasty": shown.wanted.hasty, "found": False}
    if registration is None:
        return values
    identities = [pair.identity for pair in task.work.active]
    values |= {
        "found": True, "steps": registration.steps, "met": registration.status == "solved",
        "residuals": _by_identity(identities, registration.residuals), "alignment": registration.alignment.kind,
    }  # fmt: skip
    if task.fixed.spacing is not None:
        values["residual_lengths"] = _by_identity(identities, task.fixed.spacing.lengths(registration.misses))
    if shown.chart is not None:
        charts = {"moving": shown.chart.moving, "fixed": shown.chart.fixed}
        values["chart"] = {side: np.round(places, 3).tolist() for side, places in charts.items()}
    return values


def certified(certificate: Certified, task: Task) -> Values:
    """Return the certificate of a registration, leave-one-out errors and outliers."""
    identities = [pair.identity for pair in task.work.active]
    values: Values = {
        "type": "certified", "revision": certificate.revision, "least": _number(certificate.det_min),
        "most": _number(certificate.det_max), "folded": certificate.folded,
        "round_trip": _number(certificate.round_trip), "left_out": None, "extreme": _extreme(certificate),
        "outliers": [identities[k] for k in certificate.outliers],
    }  # fmt: skip
    if certificate.left_out is not None:
        values["left_out"] = _by_identity(identities, certificate.left_out.errors)
        if task.fixed.spacing is not None:
            lengths = task.fixed.spacing.lengths(certificate.left_out.misses)
            values["left_out_lengths"] = _by_identity(identities, lengths)
    elif len(identities) > solving.MOST_LEFT_OUT:
        values["note"] = f"of more than {solving.MOST_LEFT_OUT} pairs, none is left out in turn"
    return values


def _by_identity(identities: list[int], values: NDArray[np.float64]) -> dict[str, float | None]:
    return {str(identity): _number(float(value)) for identity, value in zip(identities, values, strict=True)}


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def seen(picture: Seen, number: int, revision: int) -> bytes:
    """Return the picture of a window, with the grid and the landmarks at a time along the flow."""
    look, window = picture.look, picture.look.window
    header: Values = {
        "type": "frame", "number": number, "revision": revision, "time": look.time,
        "window": None if window is None else [window.left, window.top, window.right, window.bottom],
        "grid": [[np.round(axis, 2).tolist() for axis in axes] for axes in picture.grid],
        "carried": np.round(picture.carried, 2).tolist(),
    }  # fmt: skip
    return _packed(header, picture.image)


def areas(certificate: Certified) -> bytes:
    """Return the map of det J as a picture, on a logarithmic scale that is symmetric in growth and shrinking."""
    values = np.log2(np.clip(certificate.areas, 1e-6, 1e6)) / _extreme(certificate)
    image = np.full((*values.shape, 4), 255, np.uint8)
    for channel in range(3):
        image[..., channel] = np.interp(values, [-1.0, 0.0, 1.0], [end[channel] for end in COLOURS]).round()
    return _packed({"type": "areas", "extreme": _extreme(certificate)}, image)


def _extreme(certificate: Certified) -> float:
    """The largest |log2 det J| of the map, at least 0.1."""
    return max(0.1, float(np.abs(np.log2(np.clip(certificate.areas, 1e-6, 1e6))).max()))


def _packed(header: Message, image: NDArray[np.uint8]) -> bytes:
    """A binary message: the length of the header, the header, and RGBA."""
    height, width = image.shape[:2]
    text = json.dumps({**header, "width": width, "height": height}, allow_nan=False).encode()
    return struct.pack("<I", len(text)) + text + image.tobytes()


class Line(Protocol):
    """The connection to a tab of a browser."""

    def send(self, message: Mapping[str, Any] | bytes) -> None:
        """Send values or a packed picture; closed connections are ignored."""


class Tab:
    """A tab that receives one picture at a time; of several waiting pictures only the newest is sent."""

    def __init__(self, line: Line) -> None:
        self.line = line
        self.look = Look()
        self._number = 0
        self._busy = False
        self._next: tuple[Seen, int] | None = None

    def show(self, picture: Seen, revision: int) -> None:
        """Send a picture, now or when the tab has drawn the previous one."""
        if self._busy:
            self._next = (picture, revision)
            return
        self._busy = True
        self._number += 1
        self.line.send(seen(picture, self._number, revision))

    def drawn(self) -> None:
        """Send the waiting picture: the tab has drawn the previous one."""
        self._busy = False
        if self._next is not None:
            following, self._next = self._next, None
            self.show(*following)
