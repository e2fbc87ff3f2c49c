"""What a session works on: numbered pairs of points, and how they are registered; values that never change."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import numpy as np

from codegen.errors import LandmarkError
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
