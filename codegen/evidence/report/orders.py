"""Measured orders of convergence: slopes that have settled, above the errors by rounding and of the reference.

Between numbers of steps N_i with errors e_i the local order is log(e_i/e_i+1)/log(N_i+1/N_i). It tends to the order of
the scheme until rounding errors dominate. An order is reported if local orders agree with each other over a range of N,
whatever their value. Without such a range, no order is reported and the verdict is "not asymptotic".
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.stats import linregress

from codegen.evidence.report.page import number, slope
from codegen.evidence.report.store import Values

LEAST_POINTS, LEAST_RANGE = 3, 2.0
"""The least number of successive points in a least-squares fit, and the least ratio of its last to its first N."""
ABOVE, ABOVE_REFERENCE = 100.0, 30.0
"""A point counts if its error exceeds the plateau of rounding and the reference's error by these factors."""
LEAST_FIT, ABOVE_REFERENCE_FIT = 8, 5.0
"""The least number of grids in a fit to irregular errors, and their least ratio to the reference's error."""
SHRINKING = 0.75  # rounding errors dominate if an error exceeds this multiple of the error with half as many steps
SMALL = 1e-6  # the relative error above which rounding errors cannot dominate
LARGE = 0.5  # the relative error from which on a motion is unlike the exact motion and shows no order
SETTLED, SETTLED_HIGH, HIGH = 0.03, 0.15, 5.0
"""Local orders have settled if they differ by at most the first value, or by the second if they are above HIGH."""
TOLERANCE, TOLERANCE_HIGH = 0.1, 0.3
"""The largest accepted difference between measured and expected order, below order 6 and from order 6 on."""


@dataclass(frozen=True)
class Order:
    """A measured order, the largest difference of its local orders, and the least and the largest number of steps.

    For a fit to irregular errors, `spread` is the range of residuals, `uncertainty` twice the slope's standard error.
    """

    value: float
    spread: float
    coarsest: int
    finest: int
    uncertainty: float | None = None

    @property
    def range(self) -> str:
        """Return the range of numbers of steps as text."""
        return f"{self.coarsest}\N{NO-BREAK SPACE}to\N{NO-BREAK SPACE}{self.finest}"


@dataclass(frozen=True)
class Measured:
    """The solves of a scheme by increasing number of steps, their errors, and the order with its verdict."""

    rows: list[Values]
    errors: list[float | None]
    order: Order | None
    expected: int
    verdict: str


def measured_order(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> Order | None:
    """Return the exponent a of errors ~ N^-a over the finest range of N where local orders have settled, or None.

    `floor` is the error of the reference with which `errors` were computed. The plateau of rounding follows from the
    errors themselves: it begins where they are small and no longer decrease.
    """
    points = [(n, error) for n, error in above_plateau(steps, errors, floor) if error < LARGE]
    for last in range(len(points) - 1, -1, -1):
        starts = range(last - LEAST_POINTS + 1, -1, -1)
        first = next((k for k in starts if points[last][0] >= LEAST_RANGE * points[k][0]), None)
        if first is None:
            continue
        chosen = points[first : last + 1]
        local = [math.log(e / f) / math.log(m / n) for (n, e), (m, f) in pairwise(chosen)]
        value = -slope([n for n, _ in chosen], [e for _, e in chosen])
        spread = max(local) - min(local)
        if spread <= (SETTLED_HIGH if value > HIGH else SETTLED):
            return Order(value, spread, chosen[0][0], chosen[-1][0])
    return None


def fitted_order(steps: Sequence[int], errors: Sequence[float], floor: float = 0.0) -> Order | None:
    """Return the exponent by least squares over all errors above the reference's error; None for too few grids.

    The fit serves irregular errors, which vary with the position of a switching time in its interval.
    """
    kept = [(n, error) for n, error in zip(steps, errors, strict=True) if error > ABOVE_REFERENCE_FIT * floor]
    if len(kept) < LEAST_FIT:
        return None
    x, y = np.log(kept).T
    fit = linregress(x, y)
    residuals = y - fit.slope * x - fit.intercept
    return Order(-float(fit.slope), float(np.ptp(residuals)), kept[0][0], kept[-1][0], 2.0 * float(fit.stderr))


def verdict(order: Order | None, expected: int) -> str:
    """Return the verdict on a measured order as text, which is empty if the order is as expected."""
    if order is None:
        return "not asymptotic"
    tolerance = max(TOLERANCE_HIGH if expected >= 6 else TOLERANCE, order.uncertainty or 0.0)
    if abs(order.value - expected) <= tolerance:
        return ""
    return "superconvergent" if order.value > expected else "below the expected order"


def order_text(order: Order | None, remark: str) -> str:
    """Return the measured order with a remark as text, or the remark alone without an order."""
    if order is None:
        return remark
    value = number(order.value) if order.uncertainty is None else f"{order.value:.2f} ± {order.uncertainty:.2f}"
    return f"{value}, {remark}" if remark else value


def is_exhausted(steps: Sequence[int], errors: Sequence[float | None]) -> bool:
    """Return True if the last errors lie on the plateau of rounding, so that more steps add no information."""
    finite = [error for error in errors if error is not None and math.isfinite(error)]
    return len(finite) >= LEAST_POINTS + 2 and len(above_plateau(steps, errors)) <= len(finite) - 3


def above_plateau(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> list[tuple[int, float]]:
    """Return pairs (steps, error) by increasing steps, up to where rounding or the reference ends convergence."""
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
