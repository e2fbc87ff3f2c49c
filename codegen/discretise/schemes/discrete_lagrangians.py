"""Discrete Lagrangians by quadrature along straight lines or polynomials (Galerkin variational integrators)."""

from __future__ import annotations

from sympy import Rational

from codegen.discretise.schemes.base import DiscreteLagrangian, QuadraturePoint
from codegen.discretise.schemes.runge_kutta import GAUSS_4, GAUSS_6, LOBATTO_4, RungeKutta

_HALF = Rational(1, 2)


def _galerkin(method: RungeKutta, degree: int, summary: str) -> DiscreteLagrangian:
    """Return the Galerkin integrator with polynomials of a degree and the quadrature rule of a Runge-Kutta method.

    Both methods are the same map for Gauss quadrature, and for other rules if the mass matrix is constant.
    """
    pairs = zip(method.weights, method.abscissae, strict=True)
    return DiscreteLagrangian(
        name=method.name,
        order=method.order,
        symmetric=True,
        symplectic=True,
        source="Marsden and West (2001), section 2.6.5; Ober-Bloebaum and Saake (2015), Construction and analysis of "
        "higher order Galerkin variational integrators",
        summary=summary,
        points=tuple(QuadraturePoint(weight, abscissa) for weight, abscissa in pairs),
        nodes=tuple(Rational(i, degree) for i in range(degree + 1)),
    )


_DISCRETE_LAGRANGIANS = (
    DiscreteLagrangian(
        name="rectangle", order=1, symmetric=False, symplectic=True,
        source="Marsden and West (2001), Discrete mechanics and variational integrators, section 2.6",
        summary="h L(q0, v)",
        points=(QuadraturePoint(Rational(1), Rational(0)),),
    ),
    DiscreteLagrangian(
        name="midpoint", order=2, symmetric=True, symplectic=True,
        source="Marsden and West (2001), section 2.6.2",
        summary="h L((q0 + q1)/2, v)",
        points=(QuadraturePoint(Rational(1), _HALF),),
    ),
    DiscreteLagrangian(
        name="trapezoidal", order=2, symmetric=True, symplectic=True,
        source="Marsden and West (2001), section 2.6.3; Hairer, Lubich and Wanner (2006), VI.6.2",
        summary="h/2 L(q0, v) + h/2 L(q1, v); Störmer-Verlet when the mass matrix is constant",
        points=(QuadraturePoint(_HALF, Rational(0)), QuadraturePoint(_HALF, Rational(1))),
    ),
    _galerkin(GAUSS_4, 2, "polynomials of degree 2, Gauss quadrature with 2 points"),
    _galerkin(GAUSS_6, 3, "polynomials of degree 3, Gauss quadrature with 3 points"),
    _galerkin(LOBATTO_4, 2, "polynomials of degree 2, Simpson's rule"),
)  # fmt: skip
SCHEMES = {"variational": _DISCRETE_LAGRANGIANS}
