"""One visitor's work: two images, pairs of points, undo and redo; every operation of the page, without the page."""

from __future__ import annotations

from collections.abc import Collection, Hashable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from codegen.errors import LandmarkError
from codegen.registration.app.state import (
    MOST_NAME,
    MOST_PAIRS,
    Pair,
    Picture,
    Place,
    Settings,
    Side,
    Work,
    other,
    pairs_of,
)
from codegen.registration.maps import Registration
from codegen.registration.pairs import LandmarkPairs

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
