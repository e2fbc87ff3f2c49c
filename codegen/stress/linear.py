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
from codegen.schemes import Composition, RungeKutta

DIGITS = 30


@cache
def _tables(name: str) -> tuple[Any, ...]:
    """Lengths of drifts and kicks in turn, or both tables and the weights of a Runge-Kutta method, as floats."""
    scheme = schemes.find(name, "hamiltonian")
    with mpmath.workdps(DIGITS):
        if isinstance(scheme, Composition):
            rows = [[mpmath.mpf(str(f.evalf(DIGITS))) for f in row] for row in scheme.fractions]
            return ("kicks", *((first, first + second, second) for first, second in rows))
        assert isinstance(scheme, RungeKutta)
        parts = (scheme.positions, scheme.momenta, (scheme.weights,))
        return ("stages", *([[mpmath.mpf(e.p) / e.q if e.is_Rational else mpmath.mpf(str(e.evalf(DIGITS))) for e in row]
                             for row in _rows(part)] for part in parts))  # fmt: skip


def _rows(part: Any) -> list[list[Any]]:
    return [list(row) for row in (part.tolist() if hasattr(part, "tolist") else part)]


def step_matrix(name: str, x: float) -> tuple[Any, Any, Any, Any]:
    """Entries a, b, c, d of q1 = a q + b p, p1 = c q + d p, in 30 digits."""
    kind, *table = _tables(name)
    with mpmath.workdps(DIGITS):
        if kind == "kicks":
            return _of_kicks(table, mpmath.mpf(x))
        columns = [_of_stages(table, mpmath.mpf(x), q, p) for q, p in ((1, 0), (0, 1))]
        return columns[0][0], columns[1][0], columns[0][1], columns[1][1]


def _of_kicks(table: list[Any], x: Any) -> tuple[Any, Any, Any, Any]:
    """Each part drifts, q + x p, kicks, p - x q, and drifts again."""
    a, b, c, d = mpmath.mpf(1), mpmath.mpf(0), mpmath.mpf(0), mpmath.mpf(1)
    for first, kick, second in table:
        a, b = a + first * x * c, b + first * x * d
        c, d = c - kick * x * a, d - kick * x * b
        a, b = a + second * x * c, b + second * x * d
    return a, b, c, d


def _of_stages(table: list[Any], x: Any, q: int, p: int) -> tuple[Any, Any]:
    """Solve Q = q + x A P, P = p - x B Q for the stages, and add the weighted sums."""
    positions, momenta, (weights,) = table
    size = len(weights)
    matrix = mpmath.eye(2 * size)
    for i in range(size):
        for j in range(size):
            matrix[i, size + j] -= x * positions[i][j]
            matrix[size + i, j] += x * momenta[i][j]
    stages = mpmath.lu_solve(matrix, mpmath.matrix([q] * size + [p] * size))
    return (
        q + x * sum(w * stages[size + i] for i, w in enumerate(weights)),
        p - x * sum(w * stages[i] for i, w in enumerate(weights)),
    )


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
