"""One-step methods of order 1 and 2: Euler methods, the alpha family, midpoint, Störmer-Verlet and trapezoidal."""

from __future__ import annotations

from dataclasses import dataclass

import sympy
from sympy import Expr, Rational, S

from codegen.discretise.schemes.base import FIRST_ORDER, PARTICLES, FieldPoint, Scheme, Step, Update

_ZERO, _HALF, _ONE = Rational(0), Rational(1, 2), Rational(1)


@dataclass(frozen=True)
class Substep:
    """A part of the step, which has the length `fraction` h and evaluates the field at one point.

    From (q0, p0) to (q1, p1) the point is q = (1-a) q0 + a q1, p = (1-b) p0 + b p1. The numbers a and b in [0, 1] are
    `position` and `momentum`.
    """

    fraction: Expr
    position: Rational
    momentum: Rational


@dataclass(frozen=True)
class OneStep(Scheme):
    """A chain of substeps q1 = q0 + g h H_p(q, p), p1 = p0 - g h H_q(q, p) + g h f(q, p).

    Each substep has its fraction g of the step and its point (q, p), see `Substep`.
    """

    substeps: tuple[Substep, ...]

    @property
    def dense_derivatives(self) -> int:
        """1 if the field is evaluated at both nodes, where the motion is a parabola (trapezoidal rule), else 0."""
        first, last = self.substeps[0], self.substeps[-1]
        at_nodes = first.position, first.momentum, last.position, last.momentum
        return int(at_nodes == (_ZERO, _ZERO, _ONE, _ONE))

    def step(self) -> Step:
        """Return the step in which substep n leads from state n to state n + 1, with one point between them."""
        points, updates, abscissae, elapsed = list[FieldPoint](), list[Update](), list[Expr](), S.Zero
        for n, s in enumerate(self.substeps):
            position, momentum = (((n, 1 - share), (n + 1, share)) for share in (s.position, s.momentum))
            points.append(FieldPoint(elapsed + s.position * s.fraction, s.fraction, position, momentum))
            updates.append(Update(n, s.fraction, tuple(S(int(m == n)) for m in range(len(self.substeps)))))
            elapsed = sympy.expand(elapsed + s.fraction)
            abscissae.append(elapsed)
        return Step(tuple(points), tuple(updates), tuple(updates), tuple(abscissae))


ONE_STEPS = (
    OneStep(
        name="explicit-euler", order=1, symmetric=False, symplectic=False,
        source="Hairer, Lubich and Wanner (2006), Geometric numerical integration, I.1",
        summary="field at (q0, p0)",
        substeps=(Substep(_ONE, _ZERO, _ZERO),),
    ),
    OneStep(
        name="implicit-euler", order=1, symmetric=False, symplectic=False,
        source="Hairer, Lubich and Wanner (2006), I.1",
        summary="field at (q1, p1)",
        substeps=(Substep(_ONE, _ONE, _ONE),),
    ),
    OneStep(
        name="symplectic-euler", order=1, symmetric=False, symplectic=True,
        source="Hairer, Lubich and Wanner (2006), (VI.3.1)",
        summary="field at (q0, p1)",
        substeps=(Substep(_ONE, _ZERO, _ONE),),
    ),
    OneStep(
        name="symplectic-euler-adjoint", order=1, symmetric=False, symplectic=True,
        source="Hairer, Lubich and Wanner (2006), (VI.3.1)",
        summary="field at (q1, p0)",
        substeps=(Substep(_ONE, _ONE, _ZERO),),
    ),
    OneStep(
        name="midpoint", order=2, symmetric=True, symplectic=True,
        source="Hairer, Lubich and Wanner (2006), (VI.3.2)",
        summary="field at ((q0 + q1)/2, (p0 + p1)/2)",
        substeps=(Substep(_ONE, _HALF, _HALF),),
    ),
    OneStep(
        name="stormer-verlet", order=2, symmetric=True, symplectic=True,
        source="Hairer, Lubich and Wanner (2006), (VI.3.4)",
        summary="half a step of symplectic-euler, then half a step of its adjoint",
        substeps=(Substep(_HALF, _ZERO, _ONE), Substep(_HALF, _ONE, _ZERO)),
    ),
    OneStep(
        name="position-verlet", order=2, symmetric=True, symplectic=True,
        source="Hairer, Lubich and Wanner (2006), (VI.3.4), second variant; Tuckerman, Berne and Martyna (1992)",
        summary="half a step of symplectic-euler-adjoint, then half a step of symplectic-euler; one force a step",
        substeps=(Substep(_HALF, _ONE, _ZERO), Substep(_HALF, _ZERO, _ONE)),
    ),
)  # fmt: skip

TRAPEZOIDAL = OneStep(
    name="trapezoidal", order=2, symmetric=True, symplectic=False,
    source="Hairer, Norsett and Wanner (1993), Solving ordinary differential equations I, II.1 and II.7",
    summary="mean of the fields at x0 and x1; half a step of explicit-euler, then half a step of implicit-euler",
    substeps=(Substep(_HALF, _ZERO, _ZERO), Substep(_HALF, _ONE, _ONE)),
)  # fmt: skip
"""A scheme for first-order systems alone: it is not symplectic, unlike the midpoint rule for mechanical systems."""

_SAME_POINT = (scheme for scheme in ONE_STEPS if all(s.position == s.momentum for s in scheme.substeps))
SCHEMES = {"hamiltonian": ONE_STEPS, FIRST_ORDER: (*_SAME_POINT, TRAPEZOIDAL), PARTICLES: ONE_STEPS}
"""The schemes by method; schemes for x' = f(x, u, t) evaluate coordinates and momenta at the same point."""


def alpha(value: Rational) -> OneStep:
    """Return the scheme with the field at ((1-a) q0 + a q1, a p0 + (1-a) p1), which is symplectic for every a.

    For mechanical Hamiltonians it is equivalent to the discrete Lagrangian h L((1-a) q0 + a q1, (q1 - q0)/h).
    """
    half = value == _HALF
    return OneStep(
        name=f"alpha-{value}",
        order=2 if half else 1,
        symmetric=bool(half),
        symplectic=True,
        source="Marsden and West (2001), Discrete mechanics and variational integrators, section 2.6",
        summary="field at ((1-a) q0 + a q1, a p0 + (1-a) p1)",
        substeps=(Substep(_ONE, value, _ONE - value),),
    )
