"""Runge-Kutta methods by their Butcher tableaux, and discrete Lagrangians by quadrature.

Runge-Kutta methods are Gauss, Radau and Lobatto collocation, diagonally implicit and explicit methods. Discrete
Lagrangians use straight lines or polynomials (Galerkin variational integrators) with the same quadrature rules.

The tableaux are exact; `tests/discretise/test_orders.py` proves orders and symplecticity from them. Integrators with
adaptive steps are references for particles whose ends are both fixed.
"""

from __future__ import annotations

from dataclasses import dataclass

from sympy import Expr, Integer, Rational, S, sqrt

from codegen.discretise.schemes.base import (
    FIRST_ORDER,
    PARTICLES,
    DiscreteLagrangian,
    FieldPoint,
    QuadraturePoint,
    Rows,
    Scheme,
    Step,
    Update,
)


@dataclass(frozen=True)
class RungeKutta(Scheme):
    """X_i = x0 + h sum_j a_ij F(X_j), x1 = x0 + h sum_i b_i F(X_i).

    Coordinates and momenta have a tableau a_ij each.
    """

    weights: tuple[Expr, ...]
    positions: Rows
    momenta: Rows

    @property
    def abscissae(self) -> tuple[Expr, ...]:
        """The fractions c_i of the step at the stages: the row sums of the tableau a_ij for coordinates."""
        return tuple(sum(row, S.Zero) for row in self.positions)

    def step(self) -> Step:
        """Return the step in which stage i is state i, unless its row in the tableau shows that it equals a node."""
        end, numbers = Update(0, S.One, self.weights), range(1, len(self.weights) + 1)

        def state(number: int, row: tuple[Expr, ...]) -> int:
            return 0 if not any(row) else numbers.stop if row == self.weights else number

        def updates(table: Rows) -> tuple[Update | None, ...]:
            rows = zip(numbers, table, strict=True)
            return (*(Update(0, S.One, row) if state(i, row) == i else None for i, row in rows), end)

        rows = zip(numbers, self.abscissae, self.weights, self.positions, self.momenta, strict=True)
        points = (FieldPoint(c, b, ((state(i, a), S.One),), ((state(i, d), S.One),)) for i, c, b, a, d in rows)
        return Step(tuple(points), updates(self.positions), updates(self.momenta), (*self.abscissae, S.One))


def _table(*rows: str) -> tuple[tuple[Expr, ...], ...]:
    return tuple(tuple(Rational(entry) for entry in row.split()) for row in rows)


_ROOT_3, _ROOT_15 = sqrt(Integer(3)), sqrt(Integer(15))
_GAUSS_4 = ((Rational(1, 4), Rational(1, 4) - _ROOT_3 / 6), (Rational(1, 4) + _ROOT_3 / 6, Rational(1, 4)))
_GAUSS_6 = (
    (Rational(5, 36), Rational(2, 9) - _ROOT_15 / 15, Rational(5, 36) - _ROOT_15 / 30),
    (Rational(5, 36) + _ROOT_15 / 24, Rational(2, 9), Rational(5, 36) - _ROOT_15 / 24),
    (Rational(5, 36) + _ROOT_15 / 30, Rational(2, 9) + _ROOT_15 / 15, Rational(5, 36)),
)
_LOBATTO_IIIA = _table("0 0 0", "5/24 1/3 -1/24", "1/6 2/3 1/6")
_LOBATTO_IIIB = _table("1/6 -1/6 0", "1/6 1/3 0", "1/6 5/6 0")
_ROOT_6, _ROOT_30 = sqrt(Integer(6)), sqrt(Integer(30))
_RADAU_3 = _table("5/12 -1/12", "3/4 1/4")
_RADAU_5 = (
    (Rational(11, 45) - 7 * _ROOT_6 / 360, Rational(37, 225) - 169 * _ROOT_6 / 1800, Rational(-2, 225) + _ROOT_6 / 75),
    (Rational(37, 225) + 169 * _ROOT_6 / 1800, Rational(11, 45) + 7 * _ROOT_6 / 360, Rational(-2, 225) - _ROOT_6 / 75),
    (Rational(4, 9) - _ROOT_6 / 36, Rational(4, 9) + _ROOT_6 / 36, Rational(1, 9)),
)
_SDIRK_4 = _table(
    "1/4 0 0 0 0",
    "1/2 1/4 0 0 0",
    "17/50 -1/25 1/4 0 0",
    "371/1360 -137/2720 15/544 1/4 0",
    "25/24 -49/48 125/16 -85/12 1/4",
)
_CLASSICAL = _table("0 0 0 0", "1/2 0 0 0", "0 1/2 0 0", "0 0 1 0")
_BUTCHER = _table(
    "0 0 0 0 0 0 0",
    "1/3 0 0 0 0 0 0",
    "0 2/3 0 0 0 0 0",
    "1/12 1/3 -1/12 0 0 0 0",
    "-1/16 9/8 -3/16 -3/8 0 0 0",
    "0 9/8 -3/8 -3/4 1/2 0 0",
    "9/44 -9/11 63/44 18/11 0 -16/11 0",
)

_DORMAND_PRINCE = _table(
    "0 0 0 0 0 0",
    "1/5 0 0 0 0 0",
    "3/40 9/40 0 0 0 0",
    "44/45 -56/15 32/9 0 0 0",
    "19372/6561 -25360/2187 64448/6561 -212/729 0 0",
    "9017/3168 -355/33 46732/5247 49/176 -5103/18656 0",
)


def _gauss_8() -> Rows:
    """Return the tableau of Kuntzmann and Butcher, with the outer points first and last."""
    outer, inner = (sqrt((15 + sign * 2 * _ROOT_30) / 35) / 2 for sign in (1, -1))
    half = [Rational(1, 8) - sign * _ROOT_30 / 144 for sign in (1, -1)]
    third = [outer * (Rational(1, 6) + _ROOT_30 / 24), inner * (Rational(1, 6) - _ROOT_30 / 24)]
    fourth = [outer * (Rational(1, 21) + 5 * _ROOT_30 / 168), inner * (Rational(1, 21) - 5 * _ROOT_30 / 168)]
    fifth = [outer - 2 * third[0], inner - 2 * third[1]]
    a, b = half
    return (
        (a, b - third[0] + fourth[1], b - third[0] - fourth[1], a - fifth[0]),
        (a - third[1] + fourth[0], b, b - fifth[1], a - third[1] - fourth[0]),
        (a + third[1] + fourth[0], b + fifth[1], b, a + third[1] - fourth[0]),
        (a + fifth[0], b + third[0] + fourth[1], b + third[0] - fourth[1], a),
    )


_GAUSS_8 = _gauss_8()

GAUSS_4 = RungeKutta(
    name="gauss-4", order=4, symmetric=True, symplectic=True,
    source="Hairer, Lubich and Wanner (2006), table II.1.1; Kuntzmann (1961), Butcher (1964)",
    summary="collocation at the 2 Gauss points",
    weights=_table("1/2 1/2")[0], positions=_GAUSS_4, momenta=_GAUSS_4,
)  # fmt: skip
GAUSS_6 = RungeKutta(
    name="gauss-6", order=6, symmetric=True, symplectic=True,
    source="Hairer, Lubich and Wanner (2006), table II.1.1; Kuntzmann (1961), Butcher (1964)",
    summary="collocation at the 3 Gauss points",
    weights=_table("5/18 4/9 5/18")[0], positions=_GAUSS_6, momenta=_GAUSS_6,
)  # fmt: skip
GAUSS_8 = RungeKutta(
    name="gauss-8", order=8, symmetric=True, symplectic=True,
    source="Hairer, Norsett and Wanner (1993), table II.7.5; Kuntzmann (1961), Butcher (1964)",
    summary="collocation at the 4 Gauss points",
    weights=tuple(2 * _GAUSS_8[i][i] for i in range(4)), positions=_GAUSS_8, momenta=_GAUSS_8,
)  # fmt: skip
RADAU_3 = RungeKutta(
    name="radau-3", order=3, symmetric=False, symplectic=False,
    source="Hairer and Wanner (1996), Solving ordinary differential equations II, table IV.5.5; Ehle (1969)",
    summary="Radau IIA, collocation at 2 points of which the end is one; L-stable",
    weights=_RADAU_3[-1], positions=_RADAU_3, momenta=_RADAU_3,
)  # fmt: skip
RADAU_5 = RungeKutta(
    name="radau-5", order=5, symmetric=False, symplectic=False,
    source="Hairer and Wanner (1996), Solving ordinary differential equations II, table IV.5.6; Ehle (1969)",
    summary="Radau IIA, collocation at 3 points of which the end is one; L-stable",
    weights=_RADAU_5[-1], positions=_RADAU_5, momenta=_RADAU_5,
)  # fmt: skip
SDIRK_4 = RungeKutta(
    name="sdirk-4", order=4, symmetric=False, symplectic=False,
    source="Hairer and Wanner (1996), Solving ordinary differential equations II, table IV.6.5",
    summary="5 stages, one implicit after the other; L-stable",
    weights=_SDIRK_4[-1], positions=_SDIRK_4, momenta=_SDIRK_4,
)  # fmt: skip
LOBATTO_4 = RungeKutta(
    name="lobatto-4", order=4, symmetric=True, symplectic=True,
    source="Hairer, Lubich and Wanner (2006), table II.2.2; Sun (1993), Jay (1996)",
    summary="Lobatto IIIA for coordinates with Lobatto IIIB for momenta, 3 stages; with 2 it is Störmer-Verlet",
    weights=_table("1/6 2/3 1/6")[0], positions=_LOBATTO_IIIA, momenta=_LOBATTO_IIIB,
)  # fmt: skip
RK4 = RungeKutta(
    name="rk4", order=4, symmetric=False, symplectic=False,
    source="Kutta (1901); Hairer, Norsett and Wanner (1993), Solving ordinary differential equations I, table II.1.2",
    summary="the classical explicit Runge-Kutta method",
    weights=_table("1/6 1/3 1/3 1/6")[0], positions=_CLASSICAL, momenta=_CLASSICAL,
)  # fmt: skip
DORMAND_PRINCE_5 = RungeKutta(
    name="dormand-prince-5", order=5, symmetric=False, symplectic=False,
    source="Dormand and Prince (1980), A family of embedded Runge-Kutta formulae, J. Comput. Appl. Math. 6",
    summary="explicit Runge-Kutta method with 6 stages, of constant steps",
    weights=_table("35/384 0 500/1113 125/192 -2187/6784 11/84")[0],
    positions=_DORMAND_PRINCE, momenta=_DORMAND_PRINCE,
)  # fmt: skip
BUTCHER_6 = RungeKutta(
    name="butcher-6", order=6, symmetric=False, symplectic=False,
    source="Butcher (1964), On Runge-Kutta processes of high order, Journal of the Australian Mathematical Society 4",
    summary="explicit Runge-Kutta method with 7 stages",
    weights=_table("11/120 0 27/40 27/40 -4/15 -4/15 11/120")[0], positions=_BUTCHER, momenta=_BUTCHER,
)  # fmt: skip
HERMITE_SIMPSON = RungeKutta(
    name="hermite-simpson", order=4, symmetric=True, symplectic=False,
    source="Hairer, Norsett and Wanner (1993), table II.7.7 (Lobatto IIIA); Hargraves and Paris (1987)",
    summary="collocation at both ends and the middle, Lobatto IIIA with 3 stages",
    weights=_table("1/6 2/3 1/6")[0], positions=_LOBATTO_IIIA, momenta=_LOBATTO_IIIA,
)  # fmt: skip


@dataclass(frozen=True)
class Adaptive(Scheme):
    """An integrator of scipy that chooses its steps by a tolerance."""

    def step(self) -> Step:
        """Return the step of the classical Runge-Kutta method, which is used for derivatives alone."""
        return RK4.step()


ADAPTIVE = (
    Adaptive(
        name="dop853", order=8, symmetric=False, symplectic=False,
        source="Hairer, Norsett and Wanner (1993), II.5 (scipy.integrate.DOP853)",
        summary="explicit Runge-Kutta method of order 8 with step-size control",
        adaptive="DOP853",
    ),
    Adaptive(
        name="lsoda", order=12, symmetric=False, symplectic=False,
        source="Petzold (1983), SIAM Journal on Scientific and Statistical Computing 4 (scipy.integrate.LSODA)",
        summary="multistep methods of Adams and backward differentiation formulas, order and step by error control",
        adaptive="LSODA",
    ),
)  # fmt: skip


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


DISCRETE_LAGRANGIANS = (
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
        points=(QuadraturePoint(Rational(1), Rational(1, 2)),),
    ),
    DiscreteLagrangian(
        name="trapezoidal", order=2, symmetric=True, symplectic=True,
        source="Marsden and West (2001), section 2.6.3; Hairer, Lubich and Wanner (2006), VI.6.2",
        summary="h/2 L(q0, v) + h/2 L(q1, v); Störmer-Verlet when the mass matrix is constant",
        points=(QuadraturePoint(Rational(1, 2), Rational(0)), QuadraturePoint(Rational(1, 2), Rational(1))),
    ),
    _galerkin(GAUSS_4, 2, "polynomials of degree 2, Gauss quadrature with 2 points"),
    _galerkin(GAUSS_6, 3, "polynomials of degree 3, Gauss quadrature with 3 points"),
    _galerkin(LOBATTO_4, 2, "polynomials of degree 2, Simpson's rule"),
)  # fmt: skip

SCHEMES = {
    "variational": DISCRETE_LAGRANGIANS,
    "hamiltonian": (GAUSS_4, GAUSS_6, GAUSS_8, RADAU_5, HERMITE_SIMPSON, LOBATTO_4, RK4),
    FIRST_ORDER: (GAUSS_4, GAUSS_6, GAUSS_8, RADAU_3, RADAU_5, SDIRK_4, HERMITE_SIMPSON, RK4, DORMAND_PRINCE_5),
    PARTICLES: (RK4, BUTCHER_6, *ADAPTIVE),
}
"""The schemes of this family by method; schemes for particles have explicit steps."""
