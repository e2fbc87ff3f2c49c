"""Where costs on ever finer grids tend to: extrapolation of smooth sequences, a fit where errors vary with the grid.

Source of the extrapolation: Richardson (1911); Romberg's scheme as in Hairer, Norsett and Wanner (1993), section II.9.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from codegen.report.section import SUPERSCRIPTS, listed

FAR = 0.2
"""Costs that differ by more than this part belong to optima that have nothing in common."""


@dataclass(frozen=True)
class Limit:
    """An extrapolated value, by how much it may be wrong, and how."""

    value: float
    error: float
    how: str


def limit_of(costs: Sequence[float], order: int) -> Limit:
    """The limit of costs on N, 2N, 4N, ... intervals, for errors h^p + h^(p+1) + ..., or h^p + h^(p+2) + ...

    Symmetric schemes have the second form. Each eliminated power gives a column; the column is taken whose last two
    entries agree best, and their distance is the error.
    """
    found = [_column(costs, [order + step * k for k in range(len(costs) - 1)]) for step in (1, 2)]
    error, value, powers = min(found)
    eliminated = listed([_power(p) for p in powers])
    how = f"extrapolated such that {eliminated} cancel" if powers else "not extrapolated"
    return Limit(value, max(error, 1e-15 * abs(value)), how)


def _power(exponent: int) -> str:
    return "h" if exponent == 1 else "h" + str(exponent).translate(SUPERSCRIPTS)


def _column(costs: Sequence[float], powers: Sequence[int]) -> tuple[float, float, tuple[int, ...]]:
    column = list(costs)
    best: tuple[float, float, tuple[int, ...]] = (math.inf, costs[-1], ())
    for k, power in enumerate(powers):
        column = [b + (b - a) / (2.0**power - 1.0) for a, b in pairwise(column)]
        if len(column) < 2:
            break
        best = min(best, (abs(column[-1] - column[-2]), column[-1], tuple(powers[: k + 1])))
    return best


def fitted_limit(steps: Sequence[int], costs: Sequence[float], order: int) -> Limit:
    """J in J + c N^-p by least squares over the finest quarter of a range of N; its error is two standard errors.

    Coarse grids count only down to the first whose cost is far from the finest one, that of another optimum. Residuals
    are taken to be of the size of the error itself, so that a row counts in proportion to N^p.
    """
    rows = [(n, cost) for n, cost in zip(steps, costs, strict=True) if 4 * n >= max(steps)]
    far = [i for i, (_, cost) in enumerate(rows) if abs(cost - rows[-1][1]) > FAR * abs(rows[-1][1])]
    rows = rows[max(far, default=-1) + 1 :]
    if len(rows) < 3:
        return Limit(rows[-1][1], math.inf, "")
    n, values = (np.array(column, dtype=float) for column in zip(*rows, strict=True))
    weight = (n / n.max()) ** order
    matrix = np.column_stack([weight, weight * (n / n.max()) ** -order])
    (value, slope), *_ = np.linalg.lstsq(matrix, weight * values, rcond=None)
    left = weight * values - matrix @ [value, slope]
    variance = float(left @ left) / max(1, len(rows) - 2) * np.linalg.inv(matrix.T @ matrix)[0, 0]
    return Limit(float(value), max(2.0 * math.sqrt(variance), 1e-15 * abs(value)),
                 f"fitted to {len(rows)} grids by J + c {_power(order)}")  # fmt: skip
