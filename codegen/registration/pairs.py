"""Pairs of landmarks: the same feature in the moving and in the fixed image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import LandmarkError

PointArray: TypeAlias = NDArray[np.float64]
"""Points (x, y) in pixels, shape (n, 2); or (x, y, z) in units of the size of a voxel, shape (n, 3)."""


@dataclass(frozen=True, eq=False)
class LandmarkPairs:
    """Landmarks of the moving and the fixed image in pixels, arrays of shape (n, 2), and their names.

    Those of volumes have shape (n, 3), in the coordinates of the volumes' grids.

    Names are "1", "2", ... where none are given. Raises LandmarkError, naming the landmark, when a coordinate is not
    finite, when the numbers of landmarks differ or are zero, and when two landmarks of one image are at one place,
    which no map that can be inverted separates.
    """

    moving: PointArray
    fixed: PointArray
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        dimension = 3 if _is_in_space(self.moving) else 2
        object.__setattr__(self, "moving", as_points(self.moving, dimension, "moving"))
        object.__setattr__(self, "fixed", as_points(self.fixed, dimension, "fixed"))
        count = len(self.moving)
        if len(self.fixed) != count:
            finding = f"there are {count} moving landmarks but {len(self.fixed)} fixed ones"
            raise LandmarkError(finding, "give both places of every landmark")
        if count == 0:
            raise LandmarkError("there are no landmarks", "give at least one pair")
        names = tuple(str(name) for name in self.names) or tuple(str(k + 1) for k in range(count))
        if len(names) != count:
            raise LandmarkError(f"there are {len(names)} names for {count} landmarks", "name all or none")
        object.__setattr__(self, "names", names)
        for what, points in (("moving", self.moving), ("fixed", self.fixed)):
            _require_finite(what, points, names)
            _require_distinct(what, points, names)

    def __len__(self) -> int:
        return len(self.moving)

    @property
    def dimension(self) -> int:
        """2 for landmarks of pictures, 3 for those of volumes."""
        return int(self.moving.shape[1])

    def without(self, k: int) -> LandmarkPairs:
        """All pairs but number k, counted from zero; LandmarkError when none would be left."""
        return self.chosen(np.arange(len(self)) != k)

    def chosen(self, kept: NDArray[np.bool_]) -> LandmarkPairs:
        """The pairs that are marked, shape (n,); LandmarkError when there are none."""
        names = tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept)
        return LandmarkPairs(self.moving[kept], self.fixed[kept], names)

    def swapped(self) -> LandmarkPairs:
        """The pairs with the fixed image as the moving one."""
        return LandmarkPairs(self.fixed, self.moving, self.names)


def flipped(pairs: LandmarkPairs, width: int) -> LandmarkPairs:
    """The pairs for a moving image of so many columns that is mirrored left to right."""
    return LandmarkPairs(pairs.moving * [-1.0, 1.0] + [width - 1.0, 0.0], pairs.fixed, pairs.names)


def _is_in_space(values: Any) -> bool:
    """Whether points have three coordinates, as far as numpy can tell."""
    try:
        return bool(np.shape(values)[-1:] == (3,) and np.ndim(values) == 2)
    except ValueError:
        return False


def as_points(values: Any, dimension: int = 2, what: str = "") -> PointArray:
    """An array of points, shape (n, dimension), from whatever numpy makes one of; LandmarkError when it makes none."""
    axes = "x, y" if dimension == 2 else "x, y, z"
    try:
        points = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise LandmarkError(
            f"{what} points are no numbers ({error})".strip(),
            f"give pairs {axes}" if dimension == 2 else f"give triples {axes}",
        ) from error
    if points.size == 0:
        points = points.reshape(0, dimension)
    if points.ndim != 2 or points.shape[1] != dimension:
        finding = f"{what} points have shape {points.shape}, expected (n, {dimension})".strip()
        raise LandmarkError(finding, f"give {' and '.join(axes.rsplit(', ', 1))} of every point")
    return np.ascontiguousarray(points)


def _require_finite(what: str, points: PointArray, names: Sequence[str]) -> None:
    wrong = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if wrong.size:
        place = ", ".join(f"{x:g}" for x in points[wrong[0]])
        raise LandmarkError(
            f"{what} landmark {names[wrong[0]]} is at ({place})", "give finite numbers, or leave it out"
        )


def _require_distinct(what: str, points: PointArray, names: Sequence[str]) -> None:
    order = np.lexsort(points.T)
    same = np.flatnonzero((points[order[1:]] == points[order[:-1]]).all(axis=1))
    if same.size:
        one, other = sorted(order[same[0] : same[0] + 2])
        place = ", ".join(f"{x:g}" for x in points[one])
        finding = f"{what} landmarks {names[one]} and {names[other]} are at the same place ({place})"
        raise LandmarkError(finding, "leave one of them out, because no map separates or joins them")
