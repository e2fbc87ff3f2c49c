"""What a scheme is: data that says how one time interval is filled.

Two families exist so far. A discrete Lagrangian is a quadrature rule along the straight line between two positions. A
one-step method is a composition of substeps, each of which evaluates the Hamiltonian vector field at one point
between its ends.
"""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Rational


@dataclass(frozen=True)
class Scheme:
    """Name, order of consistency, structural flags and source of a scheme."""

    name: str
    order: int
    symmetric: bool
    symplectic: bool
    source: str
    summary: str


@dataclass(frozen=True)
class QuadraturePoint:
    """One point of a quadrature rule on [0, 1]: its weight and its place c."""

    weight: Rational
    place: Rational


@dataclass(frozen=True)
class DiscreteLagrangian(Scheme):
    """Ld(q0, q1) = h sum_i w_i L((1 - c_i) q0 + c_i q1, (q1 - q0)/h)."""

    points: tuple[QuadraturePoint, ...]


@dataclass(frozen=True)
class Substep:
    """A fraction of the step whose vector field is evaluated at q = (1-a) q0 + a q1, p = (1-b) p0 + b p1."""

    fraction: Rational
    position: Rational
    momentum: Rational


@dataclass(frozen=True)
class OneStep(Scheme):
    """A composition of substeps q1 = q0 + g h H_p(q, p), p1 = p0 - g h H_q(q, p) + g h f(q, p)."""

    substeps: tuple[Substep, ...]

    @property
    def same_point(self) -> bool:
        """Whether coordinates and momenta are always taken at the same point, as a first-order system needs."""
        return all(substep.position == substep.momentum for substep in self.substeps)
