"""Pairs of landmarks: the same feature in the moving and in the fixed image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from codegen.errors import LandmarkError

PointArray: TypeAlias = NDArray[np.float64]
"""Points (x, y) in pixels, shape (n, 2); or (x, y, z) in the unit of the voxel size, shape (n, 3)."""


@dataclass(frozen=True, eq=False)
class LandmarkPairs:
    """Pairs of landmarks: points of the moving image, the same features in the fixed image, and names.

    Parameters
    ----------
    moving, fixed : array, shape (n, 2) or (n, 3)
        Landmarks of pictures in pixels, or of volumes in the coordinates of their grids.
    names : sequence of str, optional
        By default "1", "2", ...

    Raises
    ------
    LandmarkError
        If a coordinate is not finite, if the numbers of landmarks differ or are zero, or if two landmarks of one image
        coincide, because no invertible map separates or joins them.
    """

    moving: PointArray
    fixed: PointArray
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        try:
            dimension = 3 if np.shape(self.moving)[-1:] == (3,) and np.ndim(self.moving) == 2 else 2
        except ValueError:  # lists of different lengths
            dimension = 2
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
        for side, points in (("moving", self.moving), ("fixed", self.fixed)):
            wrong = np.flatnonzero(~np.isfinite(points).all(axis=1))
            if wrong.size:
                finding = f"{side} landmark {names[wrong[0]]} is at ({_text(points[wrong[0]])})"
                raise LandmarkError(finding, "give finite numbers, or leave it out")
            order = np.lexsort(points.T)
            same = np.flatnonzero((points[order[1:]] == points[order[:-1]]).all(axis=1))
            if same.size:
                one, other = sorted(order[same[0] : same[0] + 2])
                place = f"the same place ({_text(points[one])})"
                finding = f"{side} landmarks {names[one]} and {names[other]} are at {place}"
                raise LandmarkError(finding, "leave one of them out, because no map separates or joins them")

    def __len__(self) -> int:
        return len(self.moving)

    @property
    def dimension(self) -> int:
        """2 for landmarks of pictures, 3 for landmarks of volumes."""
        return int(self.moving.shape[1])

    def without(self, k: int) -> LandmarkPairs:
        """Return all pairs except pair k, counted from zero; LandmarkError if no pair remains."""
        return self.chosen(np.arange(len(self)) != k)

    def chosen(self, kept: NDArray[np.bool_]) -> LandmarkPairs:
        """Return the pairs with True in `kept`, shape (n,); LandmarkError if no pair remains."""
        names = tuple(name for name, is_kept in zip(self.names, kept, strict=True) if is_kept)
        return LandmarkPairs(self.moving[kept], self.fixed[kept], names)

    def swapped(self) -> LandmarkPairs:
        """Return the pairs with the moving and the fixed landmarks exchanged."""
        return LandmarkPairs(self.fixed, self.moving, self.names)


def flipped(pairs: LandmarkPairs, width: int) -> LandmarkPairs:
    """Return the pairs with moving landmarks mirrored left to right, in an image with `width` columns."""
    return LandmarkPairs(pairs.moving * [-1.0, 1.0] + [width - 1.0, 0.0], pairs.fixed, pairs.names)


def as_points(values: ArrayLike, dimension: int = 2, what: str = "") -> PointArray:
    """Return an array of points, shape (n, dimension); LandmarkError, naming the points `what`, for other values."""
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


def _text(point: PointArray) -> str:
    return ", ".join(f"{x:g}" for x in point)
