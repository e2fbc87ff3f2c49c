"""Alignment before the flow: the similarity or the affine map that fits the landmarks best.

The flow keeps the rim of its disc, so a rotation or a change of size would be charged to it as a deformation. A fitted
map takes them out first, and its inverse is exact. Similarities follow Umeyama (1991), IEEE Trans. Pattern Anal. Mach.
Intell. 13(4), without reflections; affine maps are fitted by least squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from codegen.errors import ArgumentError, LandmarkError
from codegen.registration.pairs import LandmarkPairs, PointArray

Kind: TypeAlias = Literal["auto", "none", "similarity", "affine"]
KINDS: tuple[Kind, ...] = ("none", "similarity", "affine")
"""What can be fitted; "auto" is one of these, which is chosen before."""

MIRRORED = 0.2
"""Landmarks are mirrored where a mirrored similarity leaves less than this share of what the best one leaves."""

THIN = 1e-6
"""Landmarks whose width across the line that fits them best is less than this share of their length are collinear."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """The map x -> matrix x + shift from the moving to the fixed image, in pixels.

    `kind` is what was fitted, "none", "translation", "similarity" or "affine", and `message` says why, where it is not
    what was asked for.
    """

    kind: str
    matrix: NDArray[np.float64]
    shift: NDArray[np.float64]
    message: str = ""

    @property
    def is_identity(self) -> bool:
        """Whether the map leaves every point where it is, to the last bit."""
        return bool((self.matrix == np.eye(2)).all() and not self.shift.any())

    @property
    def parameters(self) -> int:
        """How many numbers were fitted."""
        return {"none": 0, "translation": 2, "similarity": 4, "affine": 6}[self.kind]

    @property
    def determinant(self) -> float:
        """The factor by which areas grow."""
        (a, b), (c, d) = self.matrix
        return float(a * d - b * c)

    def apply(self, points: PointArray) -> PointArray:
        """Moving to fixed, points of shape (n, 2)."""
        return points if self.is_identity else points @ self.matrix.T + self.shift

    def apply_inverse(self, points: PointArray) -> PointArray:
        """Fixed to moving, points of shape (n, 2)."""
        return points if self.is_identity else (points - self.shift) @ self.inverse_matrix.T

    @property
    def inverse_matrix(self) -> NDArray[np.float64]:
        """The inverse of the matrix."""
        (a, b), (c, d) = self.matrix
        return np.array([[d, -b], [-c, a]]) / self.determinant

    def part(self, fraction: float, centre: PointArray) -> Alignment:
        """A fraction of the way from the identity: about `centre`, turned and stretched by powers, shifted evenly."""
        if self.is_identity or fraction == 1.0:
            return self
        left, stretches, right = np.linalg.svd(self.matrix)
        turn = left @ right
        angle = np.arctan2(turn[1, 0], turn[0, 0]) * fraction
        turned = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        matrix = turned @ (right.T * stretches**fraction) @ right
        moved = centre + fraction * (self.matrix @ centre + self.shift - centre)
        return Alignment(self.kind, matrix, moved - matrix @ centre)


def align(pairs: LandmarkPairs, kind: Kind = "similarity") -> Alignment:
    """Fit a map of the given kind to landmarks, or the next simpler one where they do not determine it.

    An affine map needs three landmarks that are not on one line, a similarity two; one landmark gives a translation.
    Raises ArgumentError for an unknown kind, and LandmarkError where the landmarks mirror the image, or where the best
    affine map turns it over.
    """
    if kind not in KINDS:
        raise ArgumentError(f"alignment is {kind!r}", f"use {', '.join(KINDS)}")
    require_unmirrored(pairs)
    if kind == "none" or (pairs.moving == pairs.fixed).all():
        return Alignment("none" if kind == "none" else kind, np.eye(2), np.zeros(2))
    if kind == "affine":
        if len(pairs) >= 3 and not (_is_thin(pairs.moving) or _is_thin(pairs.fixed)):
            return _affine(pairs)
        reason = "needs three landmarks that are not on one line"
        found = _similarity(pairs) if len(pairs) > 1 else _translation(pairs)
        return Alignment(found.kind, found.matrix, found.shift, f"an affine map {reason}; {found.kind} instead")
    if len(pairs) > 1:
        return _similarity(pairs)
    found = _translation(pairs)
    return Alignment(found.kind, found.matrix, found.shift, "a similarity needs two landmarks; translation instead")


def require_unmirrored(pairs: LandmarkPairs) -> None:
    """Refuse landmarks that a mirrored similarity fits and no other does: LandmarkError.

    Squared residuals are those of Umeyama's equation (33), which in the plane are two sums of complex numbers.
    """
    if len(pairs) < 3 or _is_thin(pairs.moving) or _is_thin(pairs.fixed):
        return
    x, y = (points - points.mean(axis=0) for points in (pairs.moving, pairs.fixed))
    before, after = x[:, 0] + 1j * x[:, 1], y[:, 0] + 1j * y[:, 1]
    whole, spread = float((np.abs(after) ** 2).sum()), float((np.abs(before) ** 2).sum())
    turned, mirrored = (whole - abs((z * after).sum()) ** 2 / spread for z in (before.conj(), before))
    if mirrored < MIRRORED * turned:
        remedy = "use --flip, or mirror the moving image and its landmarks (codegen.registration.flipped)"
        raise LandmarkError("the landmarks mirror the image, and no map without a fold does that", remedy)


def _is_thin(points: PointArray) -> bool:
    length, width = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[:2]
    return bool(width <= THIN * length)


def _translation(pairs: LandmarkPairs) -> Alignment:
    return Alignment("translation", np.eye(2), (pairs.fixed - pairs.moving).mean(axis=0))


def _similarity(pairs: LandmarkPairs) -> Alignment:
    """Equations (40) to (42) of Umeyama; in the plane, turn and size are one complex number."""
    before, after = pairs.moving.mean(axis=0), pairs.fixed.mean(axis=0)
    x, y = pairs.moving - before, pairs.fixed - after
    spread = float((x**2).sum())
    cosine, sine = (x * y).sum() / spread, (x[:, 0] * y[:, 1] - x[:, 1] * y[:, 0]).sum() / spread
    if np.hypot(cosine, sine) * np.sqrt(spread) <= THIN * np.sqrt((y**2).sum()):
        # No turn is better than another, as where landmarks are mirrored.
        found = _translation(pairs)
        return Alignment(found.kind, found.matrix, found.shift, "no similarity fits the landmarks; translation instead")
    matrix = np.array([[cosine, -sine], [sine, cosine]])
    return Alignment("similarity", matrix, after - matrix @ before)


def _affine(pairs: LandmarkPairs) -> Alignment:
    before, after = pairs.moving.mean(axis=0), pairs.fixed.mean(axis=0)
    transposed = np.linalg.lstsq(pairs.moving - before, pairs.fixed - after, rcond=None)[0]
    found = Alignment("affine", transposed.T, after - transposed.T @ before)
    if not found.determinant > 0.0:
        finding = f"the affine map that fits the landmarks best turns the image over (det {found.determinant:.3g})"
        raise LandmarkError(finding, "mirror the moving image and its landmarks, or correct the landmarks")
    return found
