"""Modified equations against published ones, closed forms, and the steps of textbooks in high precision."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mpmath
import numpy as np
import pytest
import sympy
from scipy.integrate import solve_ivp
from simulation_systems import SYSTEMS, model_of
from sympy import Rational, S, cos, sin
from textbook_steps import TEXTBOOK, textbook_step

from codegen import Control, Simulate, canonical_pair, control, coordinate
from codegen.discretise import schemes
from codegen.discretise.model.definitions import Boundary
from codegen.discretise.model.from_problem import load_problem, normalise
from codegen.discretise.schemes.low_order import alpha
from codegen.errors import ExpressionError
from codegen.evidence.analysis import modified_equations as subject
from codegen.evidence.analysis.modified_equations import flow_series, modified_equations
from codegen.evidence.checks.one_step import generic_model, without_forces

PROBLEMS = Path(__file__).parents[2] / "problems"


REGISTERED = [(method, name) for method, names in schemes.METHODS.items() for name in names]


h, a = sympy.symbols("h alpha", real=True)


def pendulum():
    model = model_of("pendulum-hamiltonian")
    return model, *model.coordinates, *model.rates


def on(model, name, power, method="hamiltonian"):
    return modified_equations(model, schemes.find(name, method), power)


def assert_equal(found, expected):
    assert [sympy.simplify(x - y) for x, y in zip(found, expected, strict=True)] == [0] * len(expected)


def oscillator():
    q, p = canonical_pair("q", "p")
    return normalise(Simulate(hamiltonian=(p**2 + q**2) / 2, duration=1, start={q: 1, p: 0}))


def first_order(dynamics):
    zero = (None,) * len(dynamics)
    return replace(
        oscillator(),
        form="first-order",
        coordinates=tuple(dynamics),
        rates=(),
        function=S.Zero,
        force=(),
        dynamics=tuple(dynamics.values()),
        start=Boundary(zero, ()),
    )


# The alpha family and symplectic Euler on the pendulum, by hand; two terms are often printed wrongly


def test_alpha_family_has_the_right_third_term_and_not_a_factor_a_times_a_minus_a_sixth():
    model, q, p = pendulum()
    result = modified_equations(model, alpha(a), 2)
    assert_equal(result.field[0], (p, -sin(q)))
    assert_equal(result.field[1], ((a - Rational(1, 2)) * sin(q), -(a - Rational(1, 2)) * p * cos(q)))
    correct = (6 * a**2 - 6 * a + 1) / 6
    assert_equal(result.field[2], (correct * p * cos(q), correct * (p**2 / 2 - cos(q)) * sin(q)))
    printed = a * (a - Rational(1, 6))
    assert sympy.simplify(result.field[2][0] - printed * p * cos(q)) != 0
    assert sympy.simplify(result.field[2][1] - printed * (p**2 * sin(q) / 2 - sin(q) * cos(q))) != 0


def test_symplectic_euler_and_its_modified_hamiltonian():
    model, q, p = pendulum()
    result = on(model, "symplectic-euler", 2)
    assert_equal(result.field[1], (-sin(q) / 2, p * cos(q) / 2))
    assert_equal(result.field[2], (2 * p * cos(q) / 12, (p**2 - 2 * cos(q)) * sin(q) / 12))
    assert result.defects == ()
    assert_equal(result.hamiltonian, (p**2 / 2 - cos(q), -p * sin(q) / 2, (p**2 - cos(q)) * cos(q) / 12))


@pytest.mark.parametrize("method", ["hamiltonian", "variational"])
def test_midpoint_has_the_right_second_term(method):
    model, q, p = pendulum()
    result = on(model, "midpoint", 2, method)
    assert result.hamiltonian[1] == 0

    def differ(expected):
        return [sympy.simplify(sympy.diff(result.hamiltonian[2] - expected, x)) for x in (q, p)]

    assert differ(-(2 * p**2 * cos(q) - cos(2 * q)) / 48) == [0, 0]
    assert differ(-(2 * p**2 - cos(2 * q)) / 48) != [0, 0]


@pytest.mark.parametrize(("name", "sign"), [("explicit-euler", 1), ("implicit-euler", -1)])
def test_eulers_have_2_5_7_and_its_divergence(name, sign):
    model, q, p = pendulum()
    result = on(model, name, 2)
    assert_equal(result.field[1], (sign * sin(q) / 2, sign * p * cos(q) / 2))
    assert_equal(result.field[2], (-4 * p * cos(q) / 12, (p**2 + 4 * cos(q)) * sin(q) / 12))
    assert result.hamiltonian is None
    # In the plane the only component of d(i_f omega) is the divergence: h cos q + h^2 p sin q / 2.
    assert [defect.power for defect in result.defects] == [1, 2]
    assert_equal([defect.value for defect in result.defects], (sign * cos(q), p * sin(q) / 2))


# Other published series and closed forms


def test_explicit_euler_and_midpoint_on_a_square():
    """Hairer, Lubich and Wanner (2006), example IX.1.1: y' = y^2."""
    y = sympy.Symbol("y", real=True)
    model = first_order({y: y**2})
    result = on(model, "explicit-euler", 5, "one-step")
    factors = [1, -1, Rational(3, 2), -Rational(8, 3), Rational(31, 6), -Rational(157, 15)]
    assert_equal([f for (f,) in result.field], [c * y ** (k + 2) for k, c in enumerate(factors)])
    assert result.defects is None
    result = on(model, "midpoint", 6, "one-step")
    factors = [1, 0, Rational(1, 4), 0, Rational(1, 8), 0, Rational(11, 192)]
    assert_equal([f for (f,) in result.field], [c * y ** (k + 2) for k, c in enumerate(factors)])


@pytest.mark.parametrize("method", ["hamiltonian", "variational"])
def test_midpoint_turns_an_oscillator_by_twice_the_arc_tangent(method):
    model = oscillator()
    (q,), (p,) = model.coordinates, model.rates
    result = on(model, "midpoint", 6, method)
    exact = sympy.series(2 * sympy.atan(h / 2) / h, h, 0, 7).removeO()
    for k in range(7):
        assert_equal(result.field[k], (exact.coeff(h, k) * p, -exact.coeff(h, k) * q))
        assert_equal([result.hamiltonian[k]], [exact.coeff(h, k) * (q**2 + p**2) / 2])


def test_symplectic_euler_on_an_oscillator_keeps_its_quadratic_form():
    """The map keeps q^2 + p^2 - h q p exactly, so that the modified Hamiltonian is a multiple of it."""
    model = oscillator()
    (q,), (p,) = model.coordinates, model.rates
    total = sum(h**k * term for k, term in enumerate(on(model, "symplectic-euler", 6).hamiltonian))
    factor = sympy.series(2 * sympy.asin(h / 2) / (h * sympy.sqrt(1 - h**2 / 4)), h, 0, 7).removeO()
    expected = sympy.expand(factor * (q**2 + p**2 - h * q * p) / 2)
    assert [sympy.expand(total).coeff(h, k) - expected.coeff(h, k) for k in range(7)] == [0] * 7


# Every scheme of the registries


@pytest.mark.parametrize(("method", "name"), [case for case in REGISTERED if schemes.find(*case[::-1]).order <= 2])
def test_order_symmetry_and_symplecticity_are_those_that_the_scheme_states(method, name):
    scheme = schemes.find(name, method)
    power = min(scheme.order + 1, 4)
    result = modified_equations(without_forces(generic_model()), scheme, power)
    for k, field in enumerate(result.field[1:], start=1):
        if k < scheme.order or (scheme.symmetric and k % 2):
            assert set(field) == {0}, k
    assert scheme.order > power or set(result.field[scheme.order]) != {0}
    assert (result.defects == ()) is scheme.symplectic
    assert bool(result.hamiltonian) is scheme.symplectic


@pytest.mark.parametrize(("method", "name"), [case for case in REGISTERED if schemes.find(*case[::-1]).order == 4])
def test_scheme_of_order_four_has_no_lower_terms(method, name):
    """Up to the rounding of coefficients that are known as decimals."""
    scheme = schemes.find(name, method)
    model = oscillator()
    result = modified_equations(model, scheme, 3)
    for field in result.field[1:]:
        assert all(abs(f.subs(dict.fromkeys(result.states, 1)).evalf()) < 1e-13 for f in field)
    assert result.defects == () or not scheme.symplectic


@pytest.mark.parametrize(
    ("system", "method", "name"),
    [
        *((system, *case) for system in ("kepler", "driven") for case in REGISTERED if case in TEXTBOOK),
        ("double-pendulum", "hamiltonian", "symplectic-euler"),
        ("double-pendulum", "variational", "trapezoidal"),
    ],
)
def test_flow_of_the_modified_equations_is_the_textbook_step(system, method, name):
    """One power more than is kept: halving h divides the error of a step by 2^(power + 2)."""
    model, power, instant = model_of(system), 1 if system == "double-pendulum" else 2, 0.3
    result = on(model, name, power, method)
    values = {symbol: Rational(str(x)) for symbol, x in model.default_values.items()}
    field = sympy.lambdify((h, model.time, *result.states), _summed(result.field, values), "numpy")
    errors = []
    for length in (0.04, 0.02):
        flow = solve_ivp(
            lambda t, z, length=length: [float(x) for x in field(length, t, *z)],
            (instant, instant + length),
            SYSTEMS[system].state,
            method="DOP853",
            rtol=1e-13,
            atol=1e-13,
        )
        with mpmath.workdps(30):
            step = textbook_step(SYSTEMS[system], method, name, instant, length)
        errors.append(np.linalg.norm(flow.y[:, -1] - step))
    # A symmetric scheme has no next odd power.
    expected = power + 2 + (schemes.find(name, method).symmetric and power % 2 == 0)
    assert math.log2(errors[0] / errors[1]) == pytest.approx(expected, abs=0.25)


def _summed(field, values):
    columns = zip(*field, strict=True)
    return [sum(h**k * term for k, term in enumerate(column)).xreplace(values) for column in columns]


def test_modified_hamiltonian_is_kept_two_powers_better_than_the_energy():
    model, q, p = pendulum()
    result = on(model, "stormer-verlet", 2)
    energy = sympy.lambdify((q, p), result.hamiltonian[0])
    modified = sympy.lambdify((h, q, p), sum(h**k * term for k, term in enumerate(result.hamiltonian)))
    spread = {}
    for length in (0.2, 0.1):
        place, momentum, found = 0.0, 1.4, []
        for _ in range(int(30 / length)):
            middle = momentum - length / 2 * math.sin(place)
            place += length * middle
            momentum = middle - length / 2 * math.sin(place)
            found.append((energy(place, momentum), modified(length, place, momentum)))
        spread[length] = np.ptp(found, axis=0)
    powers = np.log2(spread[0.2] / spread[0.1])
    np.testing.assert_allclose(powers, [2, 4], atol=0.2)


# Forces, controls, time


def test_force_of_a_constant_control_becomes_a_potential():
    q, dq = coordinate("q")
    u = control("u")
    problem = Control(
        lagrangian=dq**2 / 2 + cos(q), force={q: u}, cost=u**2, duration=1, start={q: 0, dq: 0}, end={q: 1, dq: 0}
    )
    model = normalise(problem, [q, dq, u])
    (q,), (u,) = model.coordinates, model.controls
    result = on(model, "midpoint", 2, "variational")
    (_, p) = result.states
    assert_equal([result.hamiltonian[0]], [p**2 / 2 - cos(q) - u * q])
    # The second term of the midpoint rule is -(H_qq H_p H_p - 2 H_qp H_p H_q + H_pp H_q H_q)/24 up to a constant.
    expected = -(cos(q) * p**2 + (sin(q) - u) ** 2) / 24
    assert_equal([sympy.diff(result.hamiltonian[2] - expected, x) for x in (q, p)], [0, 0])


def test_friction_is_named_in_every_coefficient():
    result = modified_equations(generic_model(), schemes.find("symplectic-euler", "hamiltonian"), 1)
    assert {defect.power for defect in result.defects} == {0, 1}
    coupled = on(model_of("coupled"), "midpoint", 0)
    # The velocity of a is (2 p_a - p_b) 2/(3 m), the force on it -c times that.
    names = [tuple(symbol.name for symbol in defect.pair) for defect in coupled.defects]
    assert names == [("a", "p_a"), ("a", "p_b")]
    m, c = (next(s for s in coupled.field[0][2].free_symbols if s.name == name) for name in ("m", "c"))
    assert_equal([defect.value for defect in coupled.defects], (-4 * c / (3 * m), 2 * c / (3 * m)))


def test_hamiltonian_that_depends_on_time_and_force_that_does():
    result = on(model_of("driven"), "symplectic-euler", 2)
    assert result.defects == ()
    assert model_of("driven").time in result.hamiltonian[1].free_symbols


def test_force_of_the_orbital_transfer_has_no_potential():
    model = load_problem(PROBLEMS / "orbital_transfer.py")
    result = on(model, "midpoint", 1, "variational")
    (defect,) = result.defects
    assert (defect.power, [symbol.name for symbol in defect.pair]) == (0, ["r", "phi"])
    assert defect.value == -model.controls[0]


def test_wrong_hamiltonian_is_not_accepted(monkeypatch):
    model, q, _ = pendulum()

    def damaged(series, fields):
        return [x + series.ring.symbol(q) for x in subject_hamiltonian(series, fields)]

    subject_hamiltonian = subject.modified_hamiltonian
    monkeypatch.setattr(subject, "modified_hamiltonian", damaged)
    result = on(model, "midpoint", 2)
    assert (result.defects, result.hamiltonian) == ((), ())


# The ring


@pytest.mark.parametrize(
    "function",
    [
        "sin(2*x - y)*cos(x + 3)/(2 - cos(x - y)**2)",
        "sqrt(4*x**2 + y**2)**3/(x*y)",
        "exp(-x*y + 2*x) + log(x + y)",
        "tan(x/2)*sinh(y) + tanh(x*y)",
        "asin(x/9)/x**Rational(2, 3) + atan(y)",
        "x**k*pi + sqrt(3)*y**(1/(2 - 2**Rational(1, 3)))",
    ],
)
def test_derivatives_of_elements_are_those_of_sympy(function):
    x, y, k = sympy.symbols("x y k", real=True)
    expression = sympy.sympify(function, {"x": x, "y": y, "k": k})
    series = flow_series(first_order({x: expression, y: x}), schemes.find("explicit-euler", "one-step"), 1)
    point = {x: 0.71, y: 1.23, k: 1.7}
    for element, symbol in zip(series.ring.gradient(series.flow[0][1]), (x, y), strict=False):
        found = series.ring.expression(element).evalf(30, subs=point)
        assert abs(found - sympy.diff(expression, symbol).evalf(30, subs=point)) < 1e-12


def test_function_with_a_kink_is_refused():
    q, p = canonical_pair("q", "p")
    model = normalise(Simulate(hamiltonian=p**2 / 2 + sympy.Abs(q), duration=1, start={q: 1, p: 0}))
    with pytest.raises(ExpressionError, match="no expansion in powers of h"):
        on(model, "midpoint", 1)
