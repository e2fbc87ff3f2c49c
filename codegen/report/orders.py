"""Measured orders of convergence, above the level at which rounding or the reference's own error takes over."""

from __future__ import annotations

import math
from collections.abc import Sequence

from codegen.report.section import slope

LEAST_POINTS, MOST_POINTS = 3, 4
"""So many of the finest usable points enter the least-squares fit."""
ABOVE = 10.0
"""A point counts if its error exceeds the plateau by this factor."""
SHRINKING = 0.75
"""Where an error is more than this part of that with half as many steps, rounding is taken to have begun."""
LARGE = 0.5
"""Relative errors from here on belong to motions that have little to do with the exact one, and show no order."""
SMALL = 1e-6
"""... provided that it is smaller than this."""


def measured_order(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> float | None:
    """The exponent a of errors ~ N^-a by least squares over the finest points above the plateau, None for too few.

    `floor` is the error of the reference with which `errors` were computed. The plateau of rounding is found from the
    errors themselves: where they are small and no longer shrink.
    """
    points = [(n, error) for n, error in above_plateau(steps, errors, floor) if error < LARGE][-MOST_POINTS:]
    if len(points) < LEAST_POINTS:
        return None
    return -slope([n for n, _ in points], [e for _, e in points])


def is_exhausted(steps: Sequence[int], errors: Sequence[float | None]) -> bool:
    """Whether the last two errors lie on the plateau, so that more steps would tell nothing."""
    known = [error for error in errors if error is not None and math.isfinite(error)]
    return len(known) >= LEAST_POINTS + 2 and len(above_plateau(steps, errors)) <= len(known) - 3


def above_plateau(steps: Sequence[int], errors: Sequence[float | None], floor: float = 0.0) -> list[tuple[int, float]]:
    """Numbers of steps and errors, by growing N, up to where rounding or the reference ends convergence."""
    rows = sorted((n, e) for n, e in zip(steps, errors, strict=True) if e is not None and math.isfinite(e))
    kept: list[tuple[int, float]] = []
    for n, error in rows:
        if error <= max(ABOVE * floor, 1e-300):
            break
        if kept and error > SHRINKING * kept[-1][1] and error < SMALL:
            plateau = min(e for _, e in rows)
            return [(k, e) for k, e in kept if e > ABOVE * plateau]
        kept.append((n, error))
    return kept
