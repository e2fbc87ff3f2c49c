"""Connect problems end to end: reference values, closed forms, agreement of routes and drivers, honest failures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS
from few_landmarks import START, STEPS, TARGET, few
from scipy.integrate import solve_ivp

from codegen.problem.points import PointSet, read_points
from codegen.runtime.particles import shooting, steps
from codegen.solving import api
from codegen.solving.compiler import build
from codegen.solving.loading import load

FILE = PROBLEMS / "image_registration.py"


@pytest.fixture(scope="session")
def compiled(cache_folder: Path):
    """Machine code, of which tests that need tangents would compile the larger part."""
    return load(build(FILE, scheme="explicit-euler").path)


@pytest.fixture
def module(interpreted):
    def made(scheme, method=None, **arguments):
        return interpreted("image_registration", arguments=arguments, scheme=scheme, method=method)

    return made


# ---- References from outside ----


def test_forty_landmarks_against_an_independent_program(compiled):
    """The discrete cost h sum 2H, from a hand-written program with numpy and scipy's fsolve."""
    points = read_points(PROBLEMS / "data" / "trilobite40.csv", 2)
    result = api.solve(compiled, points=points)
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(1.0220537180672813, abs=1e-9)
    assert result.residual < 1e-11
    assert result.summary["condition_number"] == pytest.approx(2091.7, rel=1e-3)
    assert result.summary["tangents"] == 0  # Broyden's method needs none


def test_a_single_landmark_moves_along_a_hyperbolic_line(module):
    """With one landmark H is kinetic energy on the Poincare disc: the cost is half the squared distance."""
    x, y = complex(0.5, 0.1), complex(-0.2, 0.6)
    w = abs((y - x) / (1 - x.conjugate() * y))
    solution = module("rk4").solve([[x.real, x.imag]], [[y.real, y.imag]], 20)
    assert solution.cost == pytest.approx(2 * np.arctanh(w) ** 2, rel=2e-6)
    guessed = np.empty((1, 2))
    for k in range(21):  # the guessed way is the exact one
        module("rk4").guide(solution.q[0], np.array([[y.real, y.imag]]), k / 20, guessed)
        np.testing.assert_allclose(solution.q[k], guessed, atol=1e-5)


@pytest.mark.parametrize(
    ("start", "target"),
    [((0, 0), (0.3, 0.4)), ((0.3, 0.4), (0, 0)), ((0.3, 0.4), (-0.6, -0.8 + 1e-9)), ((0.3, 0.4), (0.3, 0.4)),
     ((0.5, 0), (-0.5, 0)), ((0.5, 0), (0.5, 1e-17))],
)  # fmt: skip
def test_the_guessed_way_where_its_circle_is_a_line(module, start, target):
    place, way = np.empty((1, 2)), []
    for fraction in (0.0, 0.25, 0.5, 0.75, 1.0):
        module("explicit-euler").guide(np.array([start], dtype=float), np.array([target], dtype=float), fraction, place)
        way.append(place[0].copy())
    np.testing.assert_allclose(way[0], start, atol=1e-12)
    np.testing.assert_allclose(way[-1], target, atol=1e-8)
    assert (np.linalg.norm(way, axis=1) < 1).all()


@pytest.mark.parametrize("scheme", ["explicit-euler", "midpoint", "stormer-verlet", "rk4", "yoshida-4-of-midpoint"])
def test_order_against_an_adaptive_reference(module, scheme):
    reference = api.solve(module("dop853"), points=few(), steps=2, tolerance=1e-13).cost
    order = module(scheme).metadata.order
    coarse, fine = (abs(module(scheme).solve(START, TARGET, n).cost - reference) for n in (4, 8))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.45)


@pytest.mark.parametrize("scheme", ["dop853", "lsoda"])
def test_adaptive_schemes_arrive_and_keep_the_energy(module, scheme):
    result = api.solve(module(scheme), points=few(), steps=4, tolerance=1e-11)
    assert result.status == "solved", result.message
    assert result.summary["energy_drift"] < 1e-9
    momenta = result.p[0].reshape(3, 2)

    def field(_, z):
        gradient = np.empty((2, 3, 2))
        module("midpoint").hamiltonian_gradient(z.reshape(2, 3, 2), np.zeros((3, 0)), np.zeros(0), gradient)
        return np.concatenate([gradient[1].ravel(), -gradient[0].ravel()])

    end = solve_ivp(field, (0, 1), np.concatenate([START.ravel(), momenta.ravel()]), "Radau", rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(end.y[:6, -1].reshape(3, 2), TARGET, atol=1e-7)


def test_the_ansatz_solves_the_euler_poincare_equations(module):
    """m = sum_i p_i delta(q - q_i) solves m_t + v.grad m + (grad v)' m + m div v = 0 weakly (Holm and Marsden 2005).

    A test function psi enters through its values and gradients at the particles only; these are drawn at random.
    """
    generator = np.random.default_rng(5)
    q, p = START, generator.normal(size=(3, 2))
    gradient = np.empty((2, 3, 2))
    module("midpoint").hamiltonian_gradient(np.array([q, p]), np.zeros((3, 0)), np.zeros(0), gradient)
    velocity, force = gradient[1], -gradient[0]

    def flow(x):
        """v(x) = sum_j p_j G(x, q_j), with a massless particle at x."""
        matrix = np.empty((4, 4))
        module("midpoint").momentum_matrix(np.array([[*q, x], [*p, (0, 0)]]), np.zeros((4, 0)), np.zeros(0), matrix)
        return matrix[3, :3] @ p

    for k in range(2):
        values, slopes = generator.normal(size=3), generator.normal(size=(3, 2))
        rate = advected = stretched = compressed = 0.0
        for i in range(3):
            steps = 1e-5 * np.eye(2)
            jacobian = np.array([(flow(q[i] + h) - flow(q[i] - h)) / 2e-5 for h in steps])  # [direction, component]
            rate += force[i, k] * values[i] + p[i, k] * slopes[i] @ velocity[i]
            divergence = np.trace(jacobian)
            advected -= p[i, k] * (values[i] * divergence + slopes[i] @ flow(q[i]))
            stretched += values[i] * jacobian[k] @ p[i]
            compressed += p[i, k] * values[i] * divergence
        assert abs(rate + advected + stretched + compressed) < 1e-8
        assert abs(rate) > 1e-3


# ---- Routes and drivers agree ----


@pytest.mark.parametrize("scheme", STEPS)
def test_shooting_and_all_states_agree(module, scheme):
    made = module(scheme)  # only the order of attempts differs between the two methods
    case = made.make_case(START, TARGET, 4)
    one, other = (made.solve_case(case, method=method) for method in ("stepping", "full"))
    assert one.status == other.status == "solved"
    assert len(one.attempts) == len(other.attempts) == 1
    assert "all states" in other.attempts[0]
    np.testing.assert_allclose(other.q, one.q, atol=1e-10)
    np.testing.assert_allclose(other.p, one.p, atol=1e-9)
    assert other.cost == pytest.approx(one.cost, abs=1e-11)


@pytest.mark.parametrize(("scheme", "method"), [("explicit-euler", "stepping"), ("midpoint", "full")])
def test_fsolve_agrees(module, scheme, method):
    ours, theirs = (api.solve(module(scheme, method), d, points=few(), steps=3) for d in ("newton", "fsolve"))
    assert theirs.status == "solved", theirs.message
    assert theirs.cost == pytest.approx(ours.cost, abs=1e-9)


def test_fmin_agrees(interpreted, module):
    pair = PointSet(START[:2], TARGET[:2], np.zeros(2))
    ours, theirs = (api.solve(module("explicit-euler"), d, points=pair, steps=2) for d in ("newton", "fmin"))
    assert theirs.status == "solved", theirs.message
    assert theirs.cost == pytest.approx(ours.cost, abs=1e-7)


@pytest.mark.parametrize("driver", ["newton", "slsqp", "trust-constr"])
@pytest.mark.parametrize("scheme", ["symplectic-euler", "symplectic-euler-adjoint", "midpoint"])
def test_the_action_has_the_optimum_of_its_symplectic_scheme(module, scheme, driver):
    stepping = module(scheme).solve(START, TARGET, 3)
    result = api.solve(module(scheme, "action"), driver, points=few(), steps=3)
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(stepping.cost, abs=1e-7)


def test_the_action_of_the_explicit_euler_method_is_that_of_the_symplectic_one(module):
    """The conditions of a minimum take momenta at the other end, so that both routes differ by O(h)."""
    action, symplectic = module("explicit-euler", "action"), module("symplectic-euler")
    one, other = action.solve(START, TARGET, 4), symplectic.solve(START, TARGET, 4)
    assert one.cost == pytest.approx(other.cost, abs=1e-11)
    assert abs(one.cost - module("explicit-euler").solve(START, TARGET, 4).cost) > 1e-6


def test_derivatives_of_the_action(module):
    action = module("midpoint", "action")
    case = action.make_case(START, TARGET, 3)
    generator = np.random.default_rng(2)
    x = action.action_start(case)
    x += 0.01 * generator.normal(size=x.size)
    v, weights = generator.normal(size=x.size), generator.normal(size=18)
    h = 1e-5

    def slope(function):
        return (function(x + h * v) - function(x - h * v)) / (2 * h)

    def lagrangian_gradient(y):
        return action.action_cost_gradient(case, y) + weights @ action.action_jacobian(case, y)

    gradient, matrix = action.action_cost_gradient(case, x), action.action_jacobian(case, x)
    assert gradient @ v == pytest.approx(slope(lambda y: action.action_cost(case, y)), rel=1e-7)
    np.testing.assert_allclose(matrix @ v, slope(lambda y: action.action_constraints(case, y)), atol=1e-7)
    hessian = action.action_hessian(case, x, weights)
    np.testing.assert_allclose(hessian @ v, slope(lagrangian_gradient), atol=1e-6)


@pytest.mark.parametrize("scheme", ["explicit-euler", "midpoint", "stormer-verlet", "rk4"])
def test_tangents_are_derivatives(module, scheme):
    made = module(scheme)
    case = made.make_case(START, TARGET, 3, sigma=0.1)
    momenta = made.first_momenta(case).ravel()
    matrix = made.jacobian(case, momenta)
    for k in range(momenta.size):
        step = 1e-6 * np.eye(momenta.size)[k]
        column = (made.residual(case, momenta + step) - made.residual(case, momenta - step)) / 2e-6
        np.testing.assert_allclose(matrix[:, k], column, atol=1e-8)


def test_many_and_few_directions_agree(module, monkeypatch):
    """GMRES, dense elimination and second derivatives that are not stored give the same solution."""
    made = module("explicit-euler")
    generator = np.random.default_rng(4)
    start = 0.7 * generator.uniform(-0.7, 0.7, (14, 2))
    target = start + 0.02 * np.sin(3 * start[:, ::-1])
    solutions = []
    for dense, stored in ((24, 3e7), (100, 3e7), (24, 0.0)):
        monkeypatch.setattr(shooting, "DENSE", dense)
        monkeypatch.setattr(steps, "STORED", stored)
        solutions.append(made.solve(start, target, 2))
    for solution in solutions:
        assert solution.status == "solved"
        np.testing.assert_allclose(solution.p, solutions[0].p, atol=1e-8)
