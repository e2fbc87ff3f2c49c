"""Discrete Lagrangians by quadrature: rectangle, midpoint and trapezoidal rule."""

from __future__ import annotations

from sympy import Rational

from codegen.schemes.base import DiscreteLagrangian, QuadraturePoint

_HALF = Rational(1, 2)

DISCRETE_LAGRANGIANS = (
    DiscreteLagrangian(
        name="rectangle",
        order=1,
        symmetric=False,
        symplectic=True,
        source="Marsden and West (2001), Discrete mechanics and variational integrators, section 2.6; thesis 2.1.2",
        summary="h L(q0, v)",
        points=(QuadraturePoint(Rational(1), Rational(0)),),
    ),
    DiscreteLagrangian(
        name="midpoint",
        order=2,
        symmetric=True,
        symplectic=True,
        source="Marsden and West (2001), section 2.6.2; thesis (2.4.2)",
        summary="h L((q0 + q1)/2, v)",
        points=(QuadraturePoint(Rational(1), _HALF),),
    ),
    DiscreteLagrangian(
        name="trapezoidal",
        order=2,
        symmetric=True,
        symplectic=True,
        source="Marsden and West (2001), section 2.6.3; Hairer, Lubich and Wanner (2006), VI.6.2",
        summary="h/2 L(q0, v) + h/2 L(q1, v); Störmer-Verlet when the mass matrix is constant",
        points=(QuadraturePoint(_HALF, Rational(0)), QuadraturePoint(_HALF, Rational(1))),
    ),
)
