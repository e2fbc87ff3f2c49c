"""A basis of the angles of a problem, in which sines and cosines are independent of each other."""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from sympy import Expr


def angles_that_span(angles: Sequence[Expr]) -> tuple[Expr, ...]:
    """Some of the angles of which all are sums with integer coefficients, sums before single terms; or none."""
    simple = {_without_factor(angle) for angle in angles}
    longest = sorted(simple, key=lambda angle: (-len(angle.as_coefficients_dict()), sympy.count_ops(angle), str(angle)))
    terms = sorted({term for angle in simple for term in angle.as_coefficients_dict()}, key=str)
    rows = {angle: [angle.as_coefficients_dict()[term] for term in terms] for angle in longest}
    chosen: list[Expr] = []
    for angle in longest:
        if sympy.Matrix([rows[x] for x in (*chosen, angle)]).rank() > len(chosen):
            chosen.append(angle)
    basis = sympy.Matrix([rows[x] for x in chosen]).T
    for angle in longest:
        factors = weights(basis, rows[angle])
        if not all(weight.is_Integer for weight in factors):
            return ()
    return tuple(chosen)


def _without_factor(angle: Expr) -> Expr:
    """The angle over the common factor of the numerators of its coefficients."""
    numerators = [coefficient.p for coefficient in angle.as_coefficients_dict().values()]
    return sympy.expand(angle / sympy.igcd(0, *numerators))


def weights(basis: sympy.Matrix, row: Sequence[Expr]) -> list[Expr]:
    """The combination of the columns that makes up the row."""
    normal = basis.T * basis
    return list(normal.LUsolve(basis.T * sympy.Matrix(row)))
