"""Derivatives of a table in any arithmetic: floating-point and complex arrays, numbers with many digits.

What has branches goes by real parts, so that complex steps and differences with many digits see one polynomial. Source:
de Boor (2001), A practical guide to splines, chapter 4, for Hermite's form.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codegen.tables.data import TableData

DEGREE = 3
ORDERS: dict[int, tuple[tuple[int, ...], ...]] = {
    1: ((0,), (1,), (2,), (3,)),
    2: ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)),
}
"""The derivatives that a look-up returns, in their order, by the number of inputs."""
_HERMITE = ((1, 0, -3, 2), (0, 1, -2, 1), (0, 0, 3, -2), (0, 0, -1, 1))
"""Coefficients of 1, s, s^2, s^3 of the cubics that are 1 in the value, then the slope, at s = 0, then at s = 1."""
_BASES: dict[str, tuple[tuple[int, ...], ...]] = {"linear": ((1, -1), (0, 1))}


def derivative(table: TableData, order: Sequence[int], at: Sequence[Any], real: Callable[[Any], Any]) -> Any:
    """The derivative of an `order` by each input, at numbers or arrays; `real` gives the real part of a number."""
    kind, heights = table.shape.kind, table.heights
    if kind == "steps":
        before = np.searchsorted(table.axes[0], np.asarray(real(at[0]), dtype=float), side="right") - 1
        return at[0] * 0 + (0.0 if order[0] else heights[np.clip(before, 0, table.shape.sizes[0] - 1), 0])
    parts = [_part(axis, table, o, x, real) for axis, o, x in zip(table.axes, order, at, strict=True)]
    if len(parts) == 1:
        cell, weights = parts[0]
        width = 2 if kind in ("cubic", "monotone") else 1
        terms = [_plain(heights[cell + i // width, i % width]) * weight for i, weight in enumerate(weights)]
        return sum(terms[1:], terms[0])
    (row, down), (column, across) = parts
    width = 2 if kind == "cubic" else 1
    terms = []
    for i, one in enumerate(down):
        for j, other in enumerate(across):
            # By the first input before by the second: f, f_1, f_2, f_12.
            height = heights[row + i // width, column + j // width, i % width + 2 * (j % width)]
            terms.append(_plain(height) * one * other)
    return sum(terms[1:], terms[0])


def _part(axis: NDArray[np.float64], table: TableData, order: int, x: Any, real: Callable[[Any], Any]) -> Any:
    """The cell of an input, and the weights, differentiated, of what stands at its ends."""
    flat, at, factor = np.asarray(real(x), dtype=float), x, None
    if table.shape.outside == "clamp":
        inside = (flat >= axis[0]) & (flat <= axis[-1])
        edge = np.where(flat < axis[0], axis[0], axis[-1])
        at = np.where(inside, x, edge) if flat.ndim else (x if inside else x * 0 + float(edge))
        factor = (np.where(inside, 1.0, 0.0) if flat.ndim else int(inside)) if order else None
    cell: Any = np.clip(np.searchsorted(axis, flat, side="right") - 1, 0, axis.size - 2)
    left, length = _plain(axis[cell]), _plain(np.diff(axis)[cell])
    s = (at - left) / length
    weights = [_differentiated(polynomial, order, s) for polynomial in _BASES.get(table.shape.kind, _HERMITE)]
    for number in (1, 3) if len(weights) == len(_HERMITE) else ():
        weights[number] = weights[number] * length
    for _ in range(order):
        weights = [weight / length for weight in weights]
    return cell, weights if factor is None else [weight * factor for weight in weights]


def _plain(height: Any) -> Any:
    return float(height) if np.ndim(height) == 0 else height


def _differentiated(polynomial: Sequence[int], order: int, s: Any) -> Any:
    """The derivative of a polynomial."""
    coefficients = list(polynomial)
    for _ in range(order):
        coefficients = [k * c for k, c in enumerate(coefficients)][1:] or [0]
    total = s * 0 + coefficients[-1]
    for coefficient in coefficients[-2::-1]:
        total = total * s + coefficient
    return total
