"""Points of the plane whose straight ways cross, which is where matchings are wrong or hard."""

from __future__ import annotations

import numpy as np

from codegen.interfaces import Vector


def intersecting_paths(start: Vector, target: Vector) -> list[tuple[int, int]]:
    """Numbers, from 1, of points whose segments from start to target, arrays of shape (n, d), cross; none unless d = 2.

    Segments that only touch or overlap are not counted.
    """
    found = list[tuple[int, int]]()
    if start.shape[1] != 2:
        return found
    for i in range(len(start) - 1):
        p, q, r, s = start[i], target[i], start[i + 1 :], target[i + 1 :]
        apart = _side(p, q, r) * _side(p, q, s) < 0.0
        both = apart & (_side(r, s, p) * _side(r, s, q) < 0.0)
        found += [(i + 1, i + 2 + int(j)) for j in np.flatnonzero(both)]
    return found


def _side(a: Vector, b: Vector, c: Vector) -> Vector:
    """On which side of the line from a to b a point c lies: twice the signed area of the triangle."""
    left: Vector = (b[..., 0] - a[..., 0]) * (c[..., 1] - a[..., 1])
    return left - (b[..., 1] - a[..., 1]) * (c[..., 0] - a[..., 0])
