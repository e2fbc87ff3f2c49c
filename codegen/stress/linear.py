"""What schemes of higher order do on the oscillator q' = p, p' = -q, from their published tables alone.

A step of length x multiplies (q, p) by a matrix. A symplectic step is stable while its trace lies between -2 and 2
(Hairer, Lubich and Wanner 2006, I.5.2 and VIII.6), and if it is symmetric, too, q_k = cos(k theta) with
theta = arccos(trace/2), and q^2 + r p^2 is kept, where -r is the quotient of the entries off the diagonal.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import mpmath

from codegen import schemes

DIGITS = 30


@cache
def _tables(name: str) -> tuple[Any, Any, Any]:
    """The coefficients of a scheme as a Runge-Kutta method, for coordinates, for momenta, and the row of weights."""
    table = schemes.find(name, "hamiltonian").step().tableau
    with mpmath.workdps(DIGITS):
        a, b, weights = (
            mpmath.matrix([[mpmath.mpf(str(entry.evalf(DIGITS))) for entry in row] for row in rows])
            for rows in (table.positions, table.momenta, [table.weights])
        )
    return a, b, weights


@cache
def step_matrix(name: str, x: float) -> tuple[Any, Any, Any, Any]:
    """Entries a, b, c, d of q1 = a q + b p, p1 = c q + d p, in 30 digits."""
    a, b, weights = _tables(name)
    with mpmath.workdps(DIGITS):
        x, ones = mpmath.mpf(x), mpmath.ones(a.rows, 1)
        columns = []
        for q, p in ((ones, 0 * ones), (0 * ones, ones)):
            # Stages are Q = q + x A P and P = p - x B Q.
            stages = mpmath.lu_solve(mpmath.eye(a.rows) + x**2 * (b * a), p - x * (b * q))
            columns.append((q[0] + x * (weights * stages)[0], p[0] - x * (weights * (q + x * (a * stages)))[0]))
    return columns[0][0], columns[1][0], columns[0][1], columns[1][1]


def angle(name: str, x: float) -> float:
    """Theta of a symmetric symplectic scheme below its limit; NaN beyond it."""
    a, _, _, d = step_matrix(name, x)
    with mpmath.workdps(DIGITS):
        return float(mpmath.acos((a + d) / 2)) if abs(a + d) < 2 else math.nan


def growth(name: str, x: float) -> float:
    """The largest modulus of the matrix's eigenvalues."""
    a, b, c, d = step_matrix(name, x)
    with mpmath.workdps(DIGITS):
        root = mpmath.sqrt(((a - d) / 2) ** 2 + b * c)
        return float(max(abs((a + d) / 2 + root), abs((a + d) / 2 - root)))


def swing(name: str, x: float) -> float:
    """By how much of itself the energy swings from rest at q = 1, where a symmetric symplectic scheme is stable."""
    _, b, c, _ = step_matrix(name, x)
    return float(abs(-c / b - 1)) if b * c < 0 else math.inf
