"""What a scheme is: data that says how one time interval is filled.

A discrete Lagrangian is a quadrature rule along a polynomial between two positions. A one-step method is a chain of
substeps, each of which evaluates the Hamiltonian vector field at one point between its ends. A Runge-Kutta method has
stages that depend on each other. A composition repeats one of these with steps of different lengths.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeAlias

from sympy import Expr, Rational, S, Symbol


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

    weight: Expr
    place: Expr


@dataclass(frozen=True)
class DiscreteLagrangian(Scheme):
    """Ld(q0, q1) = ext h sum_i w_i L(q(c_i h), q'(c_i h)) over the inner values of the polynomial q.

    q has its values at the fractions `nodes` of the step, of which the first is 0 with q0 and the last 1 with q1; with
    no others it is the straight line, and nothing is left to extremise.
    """

    points: tuple[QuadraturePoint, ...]
    nodes: tuple[Rational, ...] = (Rational(0), Rational(1))


@dataclass(frozen=True)
class Substep:
    """A fraction of the step whose vector field is evaluated at q = (1-a) q0 + a q1, p = (1-b) p0 + b p1."""

    fraction: Expr
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


@dataclass(frozen=True)
class RungeKutta(Scheme):
    """X_i = x0 + h sum_j a_ij F(X_j), x1 = x0 + h sum_i b_i F(X_i): a table for coordinates, one for momenta."""

    weights: tuple[Expr, ...]
    positions: tuple[tuple[Expr, ...], ...]
    momenta: tuple[tuple[Expr, ...], ...]

    @property
    def places(self) -> tuple[Expr, ...]:
        """The fractions c_i of the step at which stages are, the row sums of the coordinates' table."""
        return tuple(sum(row, S.Zero) for row in self.positions)

    @property
    def same_point(self) -> bool:
        """Whether one table serves coordinates and momenta, as a first-order system needs."""
        return self.positions == self.momenta


@dataclass(frozen=True)
class Composition(Scheme):
    """Steps of a base scheme, one after the other, whose lengths add up to h.

    `fractions` has a row for each of them: the length of the base's step, or of each of the base's substeps, in parts
    of h. Lengths may be negative.
    """

    base: OneStep | DiscreteLagrangian
    fractions: tuple[tuple[Expr, ...], ...]

    @property
    def same_point(self) -> bool:
        """Whether coordinates and momenta are always taken at the same point, as a first-order system needs."""
        return isinstance(self.base, OneStep) and self.base.same_point

    def part(self, lengths: tuple[Symbol, ...], step: Symbol) -> OneStep | DiscreteLagrangian:
        """One step of the base whose substeps have the given lengths instead of fractions of the step."""
        if len(lengths) == 1:
            return self.base
        assert isinstance(self.base, OneStep)
        pairs = zip(self.base.substeps, lengths, strict=True)
        return replace(self.base, substeps=tuple(replace(s, fraction=length / step) for s, length in pairs))

    def written_out(self) -> OneStep:
        """The same one-step method as one chain of substeps; the base must be a one-step method."""
        assert isinstance(self.base, OneStep), "a composition of discrete Lagrangians is no chain of substeps"
        whole = [s.fraction for s in self.base.substeps]
        substeps = []
        for row in self.fractions:
            fractions = row if len(row) == len(whole) else [row[0] * fraction for fraction in whole]
            substeps += [replace(s, fraction=f) for s, f in zip(self.base.substeps, fractions, strict=True)]
        return OneStep(
            self.name, self.order, self.symmetric, self.symplectic, self.source, self.summary, tuple(substeps)
        )


OfSteps: TypeAlias = OneStep | RungeKutta | Composition
"""What is written in states at both ends of a step, not in positions alone."""
