"""One interval by a scheme, on both sides, beside closed forms of textbooks."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import sympy
from sympy import Matrix, Rational, Symbol, eye

from codegen import Control, canonical_pair, control, coordinate, parameter, state
from codegen.discretise import schemes
from codegen.discretise.interval import STEP, one_step_interval, variational_interval
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import normalise
from codegen.discretise.schemes.base import FIRST_ORDER

H = STEP
Q, P, Q1, P1, U = (Symbol(name, real=True) for name in "q_k p_k q_k1 p_k1 u_k".split())
MASS, STIFFNESS = 2, 5


def lagrangian() -> Model:
    q, dq = coordinate("q")
    u = control("u")
    return normalise(
        Control(
            lagrangian=MASS * dq**2 / 2 - STIFFNESS * q**2 / 2,
            force={q: u * q},
            cost=u**2 * q,
            duration=1,
            start={q: 1, dq: 0},
            integral=[q**2 <= 3],
        )
    )


def hamiltonian() -> Model:
    q, p = canonical_pair("q", "p")
    u = control("u")
    energy = p**2 / (2 * MASS) + STIFFNESS * q**2 / 2
    return normalise(Control(hamiltonian=energy, force={q: u * q}, cost=u**2 * q, duration=1, start={q: 1, p: 0}))


def vanishes(expression: sympy.Expr) -> bool:
    return sympy.simplify(expression) == 0


def step_of(equations: Sequence[sympy.Expr], unknowns: Sequence[Symbol], wanted: Sequence[Symbol]) -> Matrix:
    """The values at the right node, where equations are linear in their unknowns."""
    (solution,) = sympy.linsolve(equations, list(unknowns))
    found = dict(zip(unknowns, solution, strict=True))
    return Matrix([found[x] for x in wanted])


class TestDiscreteLagrangians:
    def test_midpoint(self):
        """Marsden and West (2001), example 1.2.1 with alpha = 1/2; forces as in section 3.2."""
        interval = variational_interval(lagrangian(), schemes.find("midpoint", "variational"))
        middle, speed = (Q + Q1) / 2, (Q1 - Q) / H
        assert vanishes(interval.lagrangian - H * (MASS * speed**2 / 2 - STIFFNESS * middle**2 / 2))
        assert vanishes(interval.force_minus[0] - H * U * middle / 2)
        assert vanishes(interval.force_plus[0] - H * U * middle / 2)
        assert vanishes(interval.cost - H * U**2 * middle)
        assert vanishes(interval.integrals[0] - H * middle**2)
        assert vanishes(interval.left_momentum[0] - (MASS * speed + H * STIFFNESS * middle / 2 - H * U * middle / 2))
        assert vanishes(interval.right_momentum[0] - (MASS * speed - H * STIFFNESS * middle / 2 + H * U * middle / 2))

    def test_of_both_ends(self):
        """That of Stoermer and Verlet (Hairer, Lubich and Wanner 2006, VI.6.2): forces act where they are evaluated."""
        interval = variational_interval(lagrangian(), schemes.find("trapezoidal", "variational"))
        speed = (Q1 - Q) / H
        assert vanishes(interval.lagrangian - H * (MASS * speed**2 / 2 - STIFFNESS * (Q**2 + Q1**2) / 4))
        assert vanishes(interval.force_minus[0] - H * U * Q / 2)
        assert vanishes(interval.force_plus[0] - H * U * Q1 / 2)
        assert vanishes(interval.integrals[0] - H * (Q**2 + Q1**2) / 2)

    def test_virtual_work_is_what_momenta_do(self):
        interval = variational_interval(lagrangian(), schemes.find("midpoint", "variational"))
        left, right, a, b = sympy.symbols("left right a b", real=True)
        work = interval.virtual_work([left, right], [a, b])
        momenta = left * (a - interval.left_momentum[0]) + right * (b + interval.right_momentum[0])
        assert vanishes(work - momenta)

    @pytest.mark.parametrize(
        "scheme", ["lobatto-4", *(pytest.param(name, marks=pytest.mark.slow) for name in ("gauss-4", "gauss-6"))]
    )
    def test_slopes_are_derivatives(self, scheme):
        """Those of the discrete Lagrangian, where they are written from those of L."""
        interval = variational_interval(lagrangian(), schemes.find(scheme, "variational"))
        values = (*interval.q.left, *interval.inner, *interval.q.right)
        assert len(values) > 2
        for value, slope in zip(values, interval.slopes, strict=True):
            assert vanishes(sympy.diff(interval.lagrangian, value) - slope)


class TestOneStep:
    def test_midpoint_is_cayleys_transform(self):
        """(I - h A/2)^-1 (I + h A/2) for x' = A x (Hairer, Lubich and Wanner 2006, VI.4.2)."""
        interval = one_step_interval(hamiltonian(), schemes.find("midpoint", "hamiltonian"))
        field = Matrix([[0, Rational(1, MASS)], [U - STIFFNESS, 0]])
        exact = (eye(2) - H * field / 2).inv() * (eye(2) + H * field / 2) * Matrix([Q, P])
        found = step_of(interval.equations, [*interval.stages, Q1, P1], [Q1, P1])
        assert all(map(vanishes, found - exact))
        assert vanishes(interval.cost - H * U**2 * (Q + Q1) / 2)

    @pytest.mark.parametrize(
        ("scheme", "numerator", "denominator"),
        [
            ("explicit-euler", [1, 1], [1]),
            ("midpoint", [1, Rational(1, 2)], [1, -Rational(1, 2)]),
            ("trapezoidal", [1, Rational(1, 2)], [1, -Rational(1, 2)]),
            pytest.param(
                "gauss-4",
                [1, Rational(1, 2), Rational(1, 12)],
                [1, -Rational(1, 2), Rational(1, 12)],
                marks=pytest.mark.slow,
            ),
            ("hermite-simpson", [1, Rational(1, 2), Rational(1, 12)], [1, -Rational(1, 2), Rational(1, 12)]),
            ("rk4", [1, 1, Rational(1, 2), Rational(1, 6), Rational(1, 24)], [1]),
        ],
    )
    def test_stability_functions(self, scheme, numerator, denominator):
        """R(h r) of x' = r x, Pade's approximants but for rk4 (Hairer and Wanner 1996, IV.3)."""
        x, r = state("x"), parameter("r", 2)
        model = normalise(Control(dynamics={x: r * x}, cost=x, duration=1, start={x: 1}), [x, r])
        interval = one_step_interval(model, schemes.find(scheme, FIRST_ORDER))
        left, right = Symbol("x_k", real=True), Symbol("x_k1", real=True)
        found = step_of(interval.equations, [*interval.stages, right], [right])[0]
        z = H * model.parameters[0]
        exact = sum(c * z**i for i, c in enumerate(numerator)) / sum(c * z**i for i, c in enumerate(denominator))
        assert vanishes(found - exact * left)


def test_both_sides_make_the_same_step_by_midpoints():
    """The discrete Legendre transforms of one are the step of the other (Marsden and West 2001, section 2.6)."""
    one, other = (
        variational_interval(lagrangian(), schemes.find("midpoint", "variational")),
        one_step_interval(hamiltonian(), schemes.find("midpoint", "hamiltonian")),
    )
    equations = [one.left_momentum[0] - P, one.right_momentum[0] - P1]
    first = step_of(equations, [Q1, P1], [Q1, P1])
    second = step_of(other.equations, [*other.stages, Q1, P1], [Q1, P1])
    assert all(map(vanishes, first - second))
