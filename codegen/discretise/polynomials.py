"""The motion inside an interval as a polynomial in time through values of the coordinates, in Lagrange's form."""

from __future__ import annotations

from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

_ABSCISSA = Symbol("abscissa", real=True)
"""The fraction of a step, in basis polynomials."""


@dataclass(frozen=True)
class PolynomialMotion:
    """The polynomial in time, in Lagrange's form, through `values` of the coordinates at the `nodes`."""

    step: Symbol
    nodes: tuple[Expr, ...]
    values: tuple[tuple[Symbol, ...], ...]

    def shares(self, c: Expr) -> list[Expr]:
        """The basis polynomials at c, with which the values enter the position."""
        if len(self.nodes) == 2:
            return [1 - c, c]
        return [sympy.expand(basis.subs(_ABSCISSA, c)) for basis in self._basis()]

    def rates(self, c: Expr) -> list[Expr]:
        """The derivatives of the basis polynomials at c."""
        return [sympy.expand(sympy.diff(basis, _ABSCISSA).subs(_ABSCISSA, c)) for basis in self._basis()]

    def position(self, c: Expr) -> list[Expr]:
        """The coordinates at c; but on a straight line written in differences from the first value."""
        if len(self.nodes) == 2:
            return [between(left, right, c) for left, right in zip(*self.values, strict=True)]
        positions = []
        for first, *others in zip(*self.values, strict=True):
            terms = (share * (q - first) for share, q in zip(self.shares(c)[1:], others, strict=True) if share != 0)
            positions.append(first + sum(terms, sympy.S.Zero))
        return positions

    def velocity(self, c: Expr) -> list[Expr]:
        """The derivative by time at c, written in differences from the first value, of which no digits cancel."""
        if len(self.nodes) == 2:
            return [(right - left) / self.step for left, right in zip(*self.values, strict=True)]
        velocities = []
        for first, *others in zip(*self.values, strict=True):
            terms = (rate * ((q - first) / self.step) for rate, q in zip(self.rates(c)[1:], others, strict=True))
            velocities.append(sum(terms, sympy.S.Zero))
        return velocities

    def _basis(self) -> list[Expr]:
        return [
            sympy.prod([(_ABSCISSA - other) / (node - other) for other in self.nodes if other != node])
            for node in self.nodes
        ]


def between(left: Expr, right: Expr, c: Expr) -> Expr:
    """The point at the fraction c of the line from left to right."""
    if left == right:
        return left
    if c == sympy.Rational(1, 2):
        return (left + right) / 2
    return (1 - c) * left + c * right
