"""Landmarks in another order: whether they fit much better if some change their partners.

Two files whose rows do not correspond are what most often makes a registration impossible, and then no pair is to blame
more than others. Partners are found as the iterative closest point method does (Besl and McKay 1992, IEEE Trans.
Pattern Anal. Mach. Intell. 14(2)), but one to one (the assignment problem), from several alignments.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from codegen.errors import LandmarkError
from codegen.registration.alignment import align
from codegen.registration.pairs import LandmarkPairs, PointArray

FEWEST, MOST = 4, 1000
"""Of fewer landmarks another order says nothing, and of more it takes too long to look for one."""
MOST_TURNED = 200
"""More are looked at without turning them."""
BETTER = 0.25
"""The share of the squared distances that other partners may leave at the most."""
ROUNDS = 20
NAMED = 5
"""Landmarks that are named at the most."""


def partners(pairs: LandmarkPairs) -> NDArray[np.intp] | None:
    """The number of the fixed landmark that each moving one fits, shape (n,); None where none other fits much better.

    What is compared are squared distances after the best similarity.
    """
    count = len(pairs)
    if not FEWEST <= count <= MOST:
        return None
    given = _left(pairs, np.arange(count))
    best, least = np.arange(count), BETTER * given
    for start in _starts(pairs):
        order = _assigned(start, pairs.fixed)
        for _ in range(ROUNDS):
            try:
                moved = align(_reordered(pairs, order)).apply(pairs.moving)
            except LandmarkError:  # a mirrored or a degenerate fit
                break
            following = _assigned(moved, pairs.fixed)
            if (following == order).all():
                break
            order = following
        left = _left(pairs, order)
        if left < least:
            best, least = order, left
    return best if (best != np.arange(count)).any() else None


def said_of_partners(pairs: LandmarkPairs) -> str:
    """Which landmarks fit other partners much better, in words; empty where none do."""
    order = partners(pairs)
    if order is None:
        return ""
    other = np.flatnonzero(order != np.arange(len(pairs)))
    names = pairs.names
    if len(other) == 2:
        return f"landmarks {names[other[0]]} and {names[other[1]]} seem to have changed places"
    named = ", ".join(f"{names[k]} with {names[order[k]]}" for k in other[:NAMED])
    more = " ..." if len(other) > NAMED else ""
    return f"{len(other)} of {len(pairs)} landmarks fit others' partners better (moving {named}{more})"


def _starts(pairs: LandmarkPairs) -> Iterator[PointArray]:
    """Where moving landmarks may belong before any partner is known: as they are; alike in place and size, turned."""
    yield pairs.moving
    middle, spread = pairs.fixed.mean(axis=0), pairs.fixed.std()
    centred = (pairs.moving - pairs.moving.mean(axis=0)) * (spread / pairs.moving.std())
    if len(pairs) > MOST_TURNED:
        yield centred + middle
    elif pairs.dimension == 2:
        for cosine, sine in ((np.cos(angle), np.sin(angle)) for angle in np.arange(12) * np.pi / 6.0):
            yield centred @ np.array([[cosine, sine], [-sine, cosine]]) + middle
    else:
        for turn in Rotation.create_group("O"):
            yield turn.apply(centred) + middle


def _assigned(moved: PointArray, fixed: PointArray) -> NDArray[np.intp]:
    return np.asarray(linear_sum_assignment(cdist(moved, fixed, "sqeuclidean"))[1])


def _reordered(pairs: LandmarkPairs, order: NDArray[np.intp]) -> LandmarkPairs:
    return LandmarkPairs(pairs.moving, pairs.fixed[order])


def _left(pairs: LandmarkPairs, order: NDArray[np.intp]) -> float:
    """The squared distances that the best similarity leaves; infinite where there is none."""
    reordered = _reordered(pairs, order)
    try:
        return float(((align(reordered).apply(pairs.moving) - reordered.fixed) ** 2).sum())
    except LandmarkError:
        return np.inf
