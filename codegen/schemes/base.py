"""What a scheme is: data that says how one time interval is filled.

Schemes come in families, one file each. A family says what a step is: either a discrete Lagrangian, which is a
quadrature rule along a polynomial between two positions, or a `Step` in states at both ends. Nothing that works with
schemes needs to know the family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from sympy import Expr, Rational, Symbol

from codegen.errors import SchemeError
from codegen.schemes.step import Step

FIRST_ORDER = "one-step"
"""The method for first-order systems x' = f(x, u, t)."""
PARTICLES = "particles"
"""Under which a family lists what is offered for pairwise systems, by themselves and with both ends given."""


@dataclass(frozen=True)
class Scheme:
    """Name, order of consistency, structural flags and source of a scheme.

    Where it repeats another scheme, `parts` has a row for each time: the lengths of that one's step, or of each of its
    substeps, in parts of h. `adaptive` is the name in scipy of a code that chooses its own steps.
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
        """Whether a step is a discrete Lagrangian of positions; else it is written in states."""
        return False

    @property
    def is_chain(self) -> bool:
        """Whether a step is a chain of substeps, so that no stages inside it depend on each other."""
        return self.step().is_chain

    @property
    def dense_derivatives(self) -> int:
        """How many derivatives at both nodes continue a motion inside a step, at the scheme's own order or better.

        Without any it goes on along a straight line, as that of a midpoint or an Euler does by itself.
        """
        return 0 if self.order <= 2 else 1 if self.order <= 4 else 2

    def part(self, lengths: Sequence[Symbol], step: Symbol) -> Scheme:
        """What is repeated: one step whose substeps have the given lengths instead of fractions of the step."""
        return self

    def step(self) -> Step:
        """One step in states; SchemeError where there is none."""
        raise SchemeError(f"scheme {self.name!r} does not belong to the hamiltonian method", "choose another method")

    def discrete_lagrangian(self) -> DiscreteLagrangian:
        """The quadrature rule of one step; SchemeError where there is none."""
        raise SchemeError(f"scheme {self.name!r} does not belong to the variational method", "choose another method")


@dataclass(frozen=True)
class QuadraturePoint:
    """One point of a quadrature rule on [0, 1]: its weight and its abscissa c."""

    weight: Expr
    abscissa: Expr


@dataclass(frozen=True)
class DiscreteLagrangian(Scheme):
    """Ld(q0, q1) = ext h sum_i w_i L(q(c_i h), q'(c_i h)) over the inner values of the polynomial q.

    q has its values at the fractions `nodes` of the step, of which the first is 0 with q0 and the last 1 with q1; with
    no others it is the straight line, and nothing is left to extremise.
    """

    points: tuple[QuadraturePoint, ...]
    nodes: tuple[Rational, ...] = (Rational(0), Rational(1))

    @property
    def variational(self) -> bool:
        """A discrete Lagrangian is."""
        return True

    @property
    def is_chain(self) -> bool:
        """Whether nothing is left to extremise."""
        return len(self.nodes) == 2

    def discrete_lagrangian(self) -> DiscreteLagrangian:
        """The scheme itself."""
        return self
