"""What the browser did to a table of points, told from the rows that it sends back.

The point-drawing tool sends the whole table after every click and while a point is dragged, perhaps composed before the
last answer reached it. Every row therefore carries the identity of its pair and the edition of the table from which
the browser started; rows without identity are new clicks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from codegen.registration.app.state import Place, Side, Work

REMEMBERED = 50
"""Editions that a late message may refer to."""


@dataclass(frozen=True)
class Changes:
    """New points, points at new places, and pairs that are gone."""

    added: tuple[Place, ...] = ()
    moved: tuple[tuple[int, Place], ...] = ()
    removed: tuple[int, ...] = ()


class Editions:
    """The tables of one image that were sent to the browser, and the clicks that came back since each."""

    def __init__(self, side: Side) -> None:
        self.side = side
        self.edition = 0
        self._known: dict[int, dict[int, Place]] = {}
        self._clicks: dict[int, list[Place]] = {}

    def publish(self, work: Work) -> int:
        """Note what the browser is about to be shown, and number it."""
        self.edition += 1
        self._known[self.edition] = {pair.identity: pair.at(self.side) for pair in work.pairs}
        self._clicks[self.edition] = []
        for table in (self._known, self._clicks):
            table.pop(self.edition - REMEMBERED, None)
        return self.edition

    def changes(self, rows: Mapping[str, Sequence[Any]], work: Work) -> Changes:
        """What the browser did since the edition that its rows carry, as far as it concerns pairs that still exist.

        Every click is told once, although it comes with every message until the browser has seen the next edition.
        """
        read = [_row(*values) for values in zip(rows["x"], rows["y"], rows["id"], rows["edition"], strict=False)]
        given = [row for row in read if row is not None]
        edition = max((row[3] for row in given), default=0) or self.edition
        before = self._known.get(edition, {})
        alive = {pair.identity for pair in work.pairs}
        moved = [
            (identity, (x, y))
            for x, y, identity, _ in given
            if identity in alive and identity in before and before[identity] != (x, y)
        ]
        added, dragged = self._clicked(edition, [(x, y) for x, y, identity, _ in given if identity == 0], work)
        seen = {identity for _, _, identity, _ in given}
        removed = tuple(identity for identity in before if identity not in seen and identity in alive)
        return Changes(added, (*moved, *dragged), removed)

    def _clicked(
        self, edition: int, places: Sequence[Place], work: Work
    ) -> tuple[tuple[Place, ...], list[tuple[int, Place]]]:
        """New clicks, and those told of before that were dragged meanwhile."""
        known = self._clicks.setdefault(edition, [])
        pairs = {pair.at(self.side): pair.identity for pair in work.pairs}
        dragged = []
        for k, (before, place) in enumerate(zip(known, places, strict=False)):
            if before != place and before in pairs:
                dragged.append((pairs[before], place))
                known[k] = place
        added = tuple(place for place in places[len(known) :] if place not in pairs)
        known.extend(places[len(known) :])
        return added, dragged


def dragged(rows: Mapping[str, Sequence[Any]]) -> list[tuple[int, Place]]:
    """The pair whose point is being dragged, and where to; nothing where the browser sent anything else."""
    read = [_row(x, y, identity, 0) for x, y, identity in zip(rows["x"], rows["y"], rows["id"], strict=False)]
    return [(row[2], row[:2]) for row in read if row is not None and row[2] > 0]


def _row(x: Any, y: Any, identity: Any, edition: Any) -> tuple[float, float, int, int] | None:
    """A row as numbers; None where the browser sent anything else."""
    try:
        values = float(x), float(y), float(identity or 0), float(edition or 0)
    except (TypeError, ValueError):
        return None
    if not np.isfinite(values[:2]).all():
        return None
    whole = [int(v) if np.isfinite(v) else 0 for v in values[2:]]
    return values[0], values[1], whole[0], whole[1]
