"""Pairs of landmarks, the same feature in the moving and in the fixed image, and the alignment that fits them best.

The flow moves no point on the rim of its disc, so rotation and scaling of the image would count as deformation. The
alignment removes rotation and scaling, and its inverse is exact. Similarities without reflection follow Umeyama (1991),
IEEE Trans. Pattern Anal. Mach. Intell. 13(4); affine maps are fitted by least squares. Rotations in space are matrices
from a singular value decomposition; rotations in the plane are complex numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from codegen.errors import ArgumentError, LandmarkError

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


# Alignment

Kind: TypeAlias = Literal["auto", "none", "similarity", "affine"]
KINDS: tuple[Kind, ...] = ("none", "similarity", "affine")
"""The kinds of alignment that `align` fits; for "auto", `chosen_alignment` selects one of these kinds."""

MIRRORED = 0.2  # the ratio of squared residuals, mirrored to proper similarity, below which landmarks count as mirrored

_NEEDED = {
    2: ("two landmarks", "three landmarks that are not on one line"),
    3: ("three landmarks that are not on one line", "four landmarks that are not in one plane"),
}
"""The landmarks that a similarity and an affine map need, by dimension."""

THIN = 1e-6  # the largest ratio of width to length at which landmarks count as collinear


@dataclass(frozen=True, eq=False)
class Alignment:
    """The map x -> matrix x + shift from the moving to the fixed image, in pixels; shapes are (d, d) and (d,).

    `kind` is "none", "translation", "similarity" or "affine". If it is simpler than requested, `message` says why.
    """

    kind: str
    matrix: NDArray[np.float64]
    shift: NDArray[np.float64]
    message: str = ""

    @property
    def is_identity(self) -> bool:
        """True if the map leaves every point exactly unchanged."""
        return bool((self.matrix == np.eye(len(self.shift))).all() and not self.shift.any())

    @property
    def parameters(self) -> int:
        """The number of fitted parameters."""
        d = len(self.shift)
        turns = d * (d - 1) // 2
        return {"none": 0, "translation": d, "similarity": d + turns + 1, "affine": d * (d + 1)}[self.kind]

    @property
    def determinant(self) -> float:
        """The factor by which the map enlarges areas, or volumes in space."""
        if len(self.shift) == 3:
            return float(np.linalg.det(self.matrix))
        (a, b), (c, d) = self.matrix
        return float(a * d - b * c)

    def apply(self, points: PointArray) -> PointArray:
        """Map points of the moving image, shape (n, d), to the fixed image."""
        return points if self.is_identity else points @ self.matrix.T + self.shift

    def apply_inverse(self, points: PointArray) -> PointArray:
        """Map points of the fixed image, shape (n, d), to the moving image."""
        return points if self.is_identity else (points - self.shift) @ self.inverse_matrix.T

    @property
    def inverse_matrix(self) -> NDArray[np.float64]:
        """The inverse of the matrix."""
        if len(self.shift) == 3:
            return np.asarray(np.linalg.inv(self.matrix))
        (a, b), (c, d) = self.matrix
        return np.array([[d, -b], [-c, a]]) / self.determinant

    def tangent(self, points: PointArray) -> NDArray[np.float64]:
        """Return an orthonormal basis, shape (n, d, number), of the displacements that parameter changes cause."""
        count, d = points.shape
        units = np.eye(d * d).reshape(-1, d, d)
        turns = [units[d * i + j] - units[d * j + i] for i in range(d) for j in range(i)]
        matrices = {"similarity": [np.eye(d), *turns], "affine": [*units]}.get(self.kind, [])
        changes = [np.broadcast_to(shift, points.shape) for shift in np.eye(d)] if self.kind != "none" else []
        changes += [(self.apply(points) - self.apply(points).mean(axis=0)) @ matrix.T for matrix in matrices]
        columns = np.array(changes).reshape(len(changes), count * d).T
        basis, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        return np.asarray(basis[:, sizes > THIN * sizes.max(initial=0.0)].reshape(count, d, -1))

    def part(self, fraction: float, centre: PointArray) -> Alignment:
        """Return the map with rotation and stretch to the power `fraction`; `centre` (d,) moves on a straight line."""
        if self.is_identity or fraction == 1.0:
            return self
        left, stretches, right = np.linalg.svd(self.matrix)
        turn = left @ right
        if len(turn) == 3:
            rotation = Rotation.from_rotvec(fraction * Rotation.from_matrix(turn).as_rotvec()).as_matrix()
        else:
            angle = np.arctan2(turn[1, 0], turn[0, 0]) * fraction
            rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        matrix = rotation @ (right.T * stretches**fraction) @ right
        shifted = centre + fraction * (self.matrix @ centre + self.shift - centre)
        return Alignment(self.kind, matrix, shifted - matrix @ centre)


def align(pairs: LandmarkPairs, kind: Kind = "similarity") -> Alignment:
    """Fit a map of the given kind to landmarks, or a simpler map if the landmarks do not determine this kind.

    Parameters
    ----------
    pairs : LandmarkPairs
        The landmarks.
    kind : {"none", "similarity", "affine"}
        An affine map needs three landmarks that are not on one line, and a similarity needs two. Fewer landmarks give
        a translation. In space an affine map needs four landmarks that are not in one plane, and a similarity needs
        three that are not on one line.

    Returns
    -------
    Alignment
        The map from moving to fixed.

    Raises
    ------
    ArgumentError
        For an unknown kind.
    LandmarkError
        If the landmarks, or the best affine map, mirror the image.
    """
    if kind not in KINDS:
        raise ArgumentError(f"alignment is {kind!r}", f"use {', '.join(KINDS)}")
    require_unmirrored(pairs)
    if kind == "none" or (pairs.moving == pairs.fixed).all():
        return Alignment(kind, np.eye(pairs.dimension), np.zeros(pairs.dimension))
    if kind == "affine":
        if len(pairs) > pairs.dimension and not (_is_thin(pairs.moving) or _is_thin(pairs.fixed)):
            before, after = pairs.moving.mean(axis=0), pairs.fixed.mean(axis=0)
            transposed = np.linalg.lstsq(pairs.moving - before, pairs.fixed - after, rcond=None)[0]
            affine = Alignment("affine", transposed.T, after - transposed.T @ before)
            if not affine.determinant > 0.0:
                determinant = f"(det {affine.determinant:.3g})"
                finding = f"the affine map that fits the landmarks best turns the image over {determinant}"
                raise LandmarkError(finding, "mirror the moving image and its landmarks, or correct the landmarks")
            return affine
        simpler = _similarity(pairs)
        reason = f"an affine map needs {_NEEDED[pairs.dimension][1]}; {simpler.kind} instead"
        return replace(simpler, message=reason)
    return _similarity(pairs)


def require_unmirrored(pairs: LandmarkPairs) -> None:
    """Raise LandmarkError for landmarks that a mirrored similarity fits much better than a proper similarity.

    Squared residuals follow equation (33) of Umeyama (1991).
    """
    if len(pairs) <= pairs.dimension or _is_thin(pairs.moving) or _is_thin(pairs.fixed):
        return
    x, y = (points - points.mean(axis=0) for points in (pairs.moving, pairs.fixed))
    left, (*values, last), right = np.linalg.svd(y.T @ x)
    sign = np.linalg.det(left) * np.linalg.det(right)
    turned, mirrored = ((y**2).sum() - (sum(values) + s * last) ** 2 / (x**2).sum() for s in (sign, -sign))
    if mirrored < MIRRORED * turned:
        remedy = "use --flip, or mirror the moving image and its landmarks (codegen.registration.flipped)"
        if pairs.dimension == 3:
            remedy = "look for landmarks whose left and right are exchanged (LPS or RAS), or mirror the moving volume"
        raise LandmarkError("the landmarks mirror the image, and no map without a fold does that", remedy)


def _is_thin(points: PointArray, axis: int = -1) -> bool:
    """Return True for collinear points of the plane; in space for coplanar (`axis` -1) or collinear points (1)."""
    widths = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(widths[axis] <= THIN * widths[0])


def _similarity(pairs: LandmarkPairs) -> Alignment:
    """Fit a similarity by equations (40) to (42) of Umeyama, or a translation if landmarks determine no similarity.

    In the plane one complex number represents rotation and scaling.
    """
    before, after, dimension = pairs.moving.mean(axis=0), pairs.fixed.mean(axis=0), pairs.dimension
    shift = (pairs.fixed - pairs.moving).mean(axis=0)
    reason = f"a similarity needs {_NEEDED[dimension][0]}; translation instead"
    translation = Alignment("translation", np.eye(dimension), shift, reason)
    if len(pairs) < dimension:
        return translation
    x, y = pairs.moving - before, pairs.fixed - after
    spread = float((x**2).sum())
    if dimension == 3:
        if _is_thin(pairs.moving, 1) or _is_thin(pairs.fixed, 1):
            return translation
        left, values, right = np.linalg.svd(y.T @ x)
        signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
        matrix = (left * signs) @ right * ((signs * values).sum() / spread)
        return Alignment("similarity", matrix, after - matrix @ before)
    cosine, sine = (x * y).sum() / spread, (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum() / spread
    if np.hypot(cosine, sine) * np.sqrt(spread) <= THIN * np.sqrt((y**2).sum()):
        # All rotations fit equally well, for instance for mirrored landmarks.
        return replace(translation, message="no similarity fits the landmarks; translation instead")
    matrix = np.array([[cosine, -sine], [sine, cosine]])
    return Alignment("similarity", matrix, after - matrix @ before)
