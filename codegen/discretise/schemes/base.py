"""The definition of a scheme: the data that discretise one time interval.

Schemes belong to families, one file each. A step of a scheme is either a discrete Lagrangian (a quadrature rule along a
polynomial between two positions), or a `Step` in the states at both ends. Other modules do not depend on the family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import sympy
from sympy import Expr, Rational, Symbol

from codegen.errors import SchemeError

Shares: TypeAlias = tuple[tuple[int, Expr], ...]
"""A weighted sum of states of a step: pairs (number of the state, weight)."""
Rows: TypeAlias = tuple[tuple[Expr, ...], ...]


@dataclass(frozen=True)
class FieldPoint:
    """A point X_j at which a scheme evaluates the vector field: its abscissa in the step and weight in quadratures.

    Its `position` and `momentum` are weighted sums of states, whose weights add up to 1.
    """

    abscissa: Expr
    weight: Expr
    position: Shares
    momentum: Shares


@dataclass(frozen=True)
class Update:
    """The equation x = x_begin + g h sum_j w_j F(X_j) of a state, over all points of the step; g is the `fraction`."""

    begin: int
    fraction: Expr
    weights: tuple[Expr, ...]


@dataclass(frozen=True)
class Tableau:
    """The weights b_i of a partitioned Runge-Kutta method, and its a_ij for coordinates and for momenta."""

    weights: tuple[Expr, ...]
    positions: Rows
    momenta: Rows


@dataclass(frozen=True)
class Step:
    """A step through states 0, ..., s + 1: state 0 is the left node, the last state is the right node.

    The updates `positions[n]` and `momenta[n]` lead to state n + 1 at the fraction `abscissae[n]` of the step. An
    update is None if no point depends on the state.
    """

    points: tuple[FieldPoint, ...]
    positions: tuple[Update | None, ...]
    momenta: tuple[Update | None, ...]
    abscissae: tuple[Expr, ...]

    @property
    def is_chain(self) -> bool:
        """True if each state follows from the state before it alone, so that stages are independent."""
        for n, update in (*enumerate(self.positions), *enumerate(self.momenta)):
            if update is None or update.begin != n:
                return False
            used = (point for point, weight in zip(self.points, update.weights, strict=True) if weight != 0)
            if any(state not in (n, n + 1) for point in used for state, _ in (*point.position, *point.momentum)):
                return False
        return True

    @property
    def is_explicit(self) -> bool:
        """True if each field depends on earlier fields of the step alone, so that stages need no equations."""
        tableau = self.tableau
        return not any(
            entry for table in (tableau.positions, tableau.momenta) for i, row in enumerate(table) for entry in row[i:]
        )

    @property
    def substeps(self) -> tuple[tuple[Expr, Expr, Expr], ...]:
        """Triples (g, a, b) of a chain: fraction of a substep, weights of its end state in position and momentum."""
        links = enumerate(self.points, start=1)
        return tuple((point.weight, dict(point.position)[n], dict(point.momentum)[n]) for n, point in links)

    @property
    def tableau(self) -> Tableau:
        """The step as a partitioned Runge-Kutta method, whose stages are the points."""
        weights, positions = self._rows(self.positions, [point.position for point in self.points])
        return Tableau(weights, positions, self._rows(self.momenta, [point.momentum for point in self.points])[1])

    def _rows(self, updates: Sequence[Update | None], points: Sequence[Shares]) -> tuple[tuple[Expr, ...], Rows]:
        """Return the weights of the fields at all points in the right node, and in the state of each point."""
        states = {0: sympy.zeros(1, len(points))}
        for n, update in enumerate(updates):
            if update:
                states[n + 1] = states[update.begin] + update.fraction * sympy.Matrix([update.weights])
        rows = [sum((share * states[n] for n, share in point), 0 * states[0]) for point in points]
        return tuple(states[len(updates)]), tuple(tuple(row) for row in rows)


FIRST_ORDER = "one-step"
"""The method for first-order systems x' = f(x, u, t)."""
LEAST_DETERMINANT = 1e-6
"""Determinant of a mass matrix on an interval of unit length below which it counts as singular; exactly 1/12."""
PARTICLES = "particles"
"""The key of the schemes for pairwise systems, in simulations and in problems with both ends fixed."""


@dataclass(frozen=True)
class Scheme:
    """A scheme: its name, order of consistency, properties, source, and a one-line summary.

    A scheme that repeats another scheme has a row of `parts` for each repetition: the length of the step, or of each
    substep, as a fraction of h. `adaptive` is the name of an integrator in scipy that chooses its own steps, or "".
    """

    name: str
    order: int
    symmetric: bool
    symplectic: bool
    source: str
    summary: str
    parts: tuple[tuple[Expr, ...], ...] = field(default=(), kw_only=True)
    adaptive: str = field(default="", kw_only=True)

    @property
    def variational(self) -> bool:
        """True if a step is a discrete Lagrangian of positions, False if it is written in states."""
        return False

    @property
    def is_chain(self) -> bool:
        """True if a step is a chain of substeps, whose stages are independent."""
        return self.step().is_chain

    @property
    def dense_derivatives(self) -> int:
        """The number of derivatives at both nodes that interpolate a motion with the scheme's order or better.

        Without derivatives the motion is a straight line, as for the midpoint rule and the Euler methods.
        """
        return 0 if self.order <= 2 else 1 if self.order <= 4 else 2

    @property
    def _points(self) -> tuple[FieldPoint, ...] | tuple[QuadraturePoint, ...]:
        return self.discrete_lagrangian().points if self.variational else self.step().points

    @property
    def point_times(self) -> tuple[Expr, ...]:
        """The fractions of a step at which the scheme evaluates dynamics and cost."""
        return tuple(point.abscissa for point in self._points)

    @property
    def resolves_lines(self) -> bool:
        """True if the quadrature of the scheme distinguishes both ends of a function that is linear on an interval.

        The quadrature of the square of a (1-c) + b c is then a positive definite form in a and b. Otherwise the mode
        a = -b, as in the midpoint rule, or the value at one end, as in the Euler methods, has no effect.
        """
        weighted = [(float(point.weight), float(point.abscissa)) for point in self._points]
        left = sum(w * (1.0 - c) ** 2 for w, c in weighted)
        right = sum(w * c**2 for w, c in weighted)
        mixed = sum(w * (1.0 - c) * c for w, c in weighted)
        return left > 0.0 and left * right - mixed**2 > LEAST_DETERMINANT

    def part(self, lengths: Sequence[Symbol], step: Symbol) -> Scheme:
        """Return the scheme of one repetition, see `parts`; a scheme without repetitions returns itself.

        `lengths` are the lengths of its step or of its substeps, and `step` is the symbol h.
        """
        return self

    def step(self) -> Step:
        """Return one step in states; raise SchemeError for a discrete Lagrangian."""
        raise SchemeError(f"scheme {self.name!r} does not belong to the hamiltonian method", "choose another method")

    def discrete_lagrangian(self) -> DiscreteLagrangian:
        """Return the discrete Lagrangian of one step; raise SchemeError for a scheme in states."""
        raise SchemeError(f"scheme {self.name!r} does not belong to the variational method", "choose another method")


@dataclass(frozen=True)
class QuadraturePoint:
    """One point of a quadrature rule on [0, 1]: its weight and its abscissa c."""

    weight: Expr
    abscissa: Expr


@dataclass(frozen=True)
class DiscreteLagrangian(Scheme):
    """Ld(q0, q1) = ext h sum_i w_i L(q(c_i h), q'(c_i h)), extremal with respect to the inner values of q.

    The polynomial q is given by its values at the fractions `nodes` of the step, with q0 at 0 and q1 at 1. Without
    inner nodes q is the straight line, and there are no inner values.
    """

    points: tuple[QuadraturePoint, ...]
    nodes: tuple[Rational, ...] = (Rational(0), Rational(1))

    @property
    def variational(self) -> bool:
        """Always True."""
        return True

    @property
    def is_chain(self) -> bool:
        """True if there are no inner values."""
        return len(self.nodes) == 2

    def discrete_lagrangian(self) -> DiscreteLagrangian:
        """Return the scheme itself."""
        return self
