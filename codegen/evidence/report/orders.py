"""Measured orders of convergence: slopes that have settled, above the plateau of rounding and of the reference.

Between numbers of steps N_i the local order is log(e_i/e_i+1)/log(N_i+1/N_i). It tends to the order of the scheme until
rounding takes over. An order is reported where local orders agree with each other over a range of N, whatever their
value; where no such range is reached there is none, and it is said that convergence is not asymptotic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from codegen.evidence.report.page import number, slope

LEAST_POINTS, LEAST_RANGE = 3, 2.0
"""So many successive points, over such a factor in N, enter the least-squares fit at least."""
ABOVE, ABOVE_REFERENCE = 100.0, 30.0
"""A point counts if its error exceeds the plateau by the first factor and the reference's error by the second."""
LEAST_FIT, ABOVE_REFERENCE_FIT = 8, 5.0
"""A fit wants so many grids, with errors that exceed the reference's by the second factor."""
SHRINKING = 0.75
"""Where an error is more than this part of that with half as many steps, rounding is taken to have begun."""
SMALL = 1e-6
"""... provided that it is smaller than this."""
LARGE = 0.5
"""Relative errors from here on belong to motions that have little to do with the exact one, and show no order."""
SETTLED, SETTLED_HIGH, HIGH = 0.03, 0.15, 5.0
"""Local orders have settled if they differ by no more than this; by the second, if they are above the third."""
TOLERANCE, TOLERANCE_HIGH = 0.1, 0.3
"""How far a measured order may be from the expected one; the second from order 6 on."""


@dataclass(frozen=True)
class Order:
    """A measured order, the difference of its local orders, and the numbers of steps between which it was seen.

    Of a fit to errors that vary with the grid, `uncertainty` is twice the standard error of the slope.
    """

    value: float
    spread: float
    coarsest: int
    finest: int
    uncertainty: float | None = None


def measured_order(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> Order | None:
    """The exponent a of errors ~ N^-a over the finest range of N where local orders have settled; None if none has.

    `floor` is the error of the reference with which `errors` were computed. The plateau of rounding is found from the
    errors themselves: where they are small and no longer shrink.
    """
    points = [(n, error) for n, error in above_plateau(steps, errors, floor) if error < LARGE]
    for last in range(len(points) - 1, -1, -1):
        found = _fitted(_range_to(points, last))
        if found is not None:
            return found
    return None


def fitted_order(steps: Sequence[int], errors: Sequence[float], floor: float = 0.0) -> Order | None:
    """The exponent by least squares over all grids with errors above the reference's, without regard to local orders.

    For errors that vary with the place in its interval at which a control switches; None for too few grids.
    """
    kept = [(n, error) for n, error in zip(steps, errors, strict=True) if error > ABOVE_REFERENCE_FIT * floor]
    if len(kept) < LEAST_FIT:
        return None
    x, y = (np.log([pair[i] for pair in kept]) for i in (0, 1))
    value, at_one = np.polyfit(x, y, 1)
    left = y - value * x - at_one
    error = math.sqrt(float(left @ left) / (len(kept) - 2) / float(np.sum((x - x.mean()) ** 2)))
    return Order(-float(value), float(np.ptp(left)), kept[0][0], kept[-1][0], 2.0 * error)


def verdict(order: Order | None, expected: int) -> str:
    """What is to be said beside a measured order: nothing if it is the expected one."""
    if order is None:
        return "not asymptotic"
    tolerance = max(TOLERANCE_HIGH if expected >= 6 else TOLERANCE, order.uncertainty or 0.0)
    if abs(order.value - expected) <= tolerance:
        return ""
    return "superconvergent" if order.value > expected else "below the expected order"


def order_text(order: Order | None, expected: int, said: str | None = None) -> str:
    """The measured order with its verdict, which may be given."""
    said = verdict(order, expected) if said is None else said
    if order is None:
        return said
    value = number(order.value) if order.uncertainty is None else f"{order.value:.2f} ± {order.uncertainty:.2f}"
    return ", ".join(text for text in (value, said) if text)


def _range_to(points: Sequence[tuple[int, float]], last: int) -> list[tuple[int, float]]:
    """The shortest range of points that ends there and is long enough; empty if there is none."""
    for first in range(last - LEAST_POINTS + 1, -1, -1):
        if points[last][0] >= LEAST_RANGE * points[first][0]:
            return list(points[first : last + 1])
    return []


def _fitted(points: Sequence[tuple[int, float]]) -> Order | None:
    if not points:
        return None
    local = [math.log(e / f) / math.log(m / n) for (n, e), (m, f) in pairwise(points)]
    value = -slope([n for n, _ in points], [e for _, e in points])
    spread = max(local) - min(local)
    if spread > (SETTLED_HIGH if value > HIGH else SETTLED):
        return None
    return Order(value, spread, points[0][0], points[-1][0])


def is_exhausted(steps: Sequence[int], errors: Sequence[float | None]) -> bool:
    """Whether the last two errors lie on the plateau, so that more steps would tell nothing."""
    known = [error for error in errors if error is not None and math.isfinite(error)]
    return len(known) >= LEAST_POINTS + 2 and len(above_plateau(steps, errors)) <= len(known) - 3


def above_plateau(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> list[tuple[int, float]]:
    """Numbers of steps and errors, by growing N, up to where rounding or the reference ends convergence."""
    rows = sorted((n, e) for n, e in zip(steps, errors, strict=True) if e is not None and math.isfinite(e))
    kept: list[tuple[int, float]] = []
    for n, error in rows:
        if error <= max(ABOVE_REFERENCE * floor, 1e-300):
            break
        if error < SMALL and any(error > SHRINKING * e for k, e in kept if 2 * k <= n):
            plateau = min(e for _, e in rows)
            return [(k, e) for k, e in kept if e > ABOVE * plateau]
        kept.append((n, error))
    return kept
