"""Connect problems end to end: reference values, closed forms, agreement of routes and drivers, honest failures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import PROBLEMS
from scipy.integrate import solve_ivp

from codegen import solving
from codegen.author.points import PointSet, read_points
from codegen.compiler import build
from codegen.errors import ArgumentError, PointsError, SchemeError
from codegen.loading import load
from codegen.schemes.particles import PARTICLE_SCHEMES
from codegen.solutions.connect import connect_result
from codegen.solutions.result import ConnectAttempt, Run

FILE = PROBLEMS / "image_registration.py"
START = np.array([[0.1, 0.2], [-0.4, 0.1], [0.3, -0.5]])
TARGET = START + np.array([[0.12, -0.05], [0.03, 0.1], [-0.08, 0.04]])
STEPS = [name for name, scheme in PARTICLE_SCHEMES.items() if not scheme.adaptive]


def few(sigma=0.0):
    return PointSet(START, TARGET, np.full(3, sigma))


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
    result = solving.solve(compiled, points=points)
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
def test_the_guessed_way_where_the_thesis_divides_by_zero(module, start, target):
    place, way = np.empty((1, 2)), []
    for fraction in (0.0, 0.25, 0.5, 0.75, 1.0):
        module("explicit-euler").guide(np.array([start], dtype=float), np.array([target], dtype=float), fraction, place)
        way.append(place[0].copy())
    np.testing.assert_allclose(way[0], start, atol=1e-12)
    np.testing.assert_allclose(way[-1], target, atol=1e-8)
    assert (np.linalg.norm(way, axis=1) < 1).all()


@pytest.mark.parametrize("scheme", ["explicit-euler", "midpoint", "stormer-verlet", "rk4", "yoshida-4-of-midpoint"])
def test_order_against_an_adaptive_reference(module, scheme):
    reference = solving.solve(module("dop853"), points=few(), steps=2, tolerance=1e-13).cost
    order = module(scheme).metadata["order"]
    coarse, fine = (abs(module(scheme).solve(START, TARGET, n).cost - reference) for n in (4, 8))
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.45)


@pytest.mark.parametrize("scheme", ["dop853", "lsoda"])
def test_adaptive_schemes_arrive_and_keep_the_energy(module, scheme):
    result = solving.solve(module(scheme), points=few(), steps=4, tolerance=1e-11)
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
    """Thesis B.2: m = sum_i p_i delta(q - q_i) solves m_t + v.grad m + (grad v)' m + m div v = 0 in the weak sense.

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
    one, other = (made.Solution(*made.described(case, method)) for method in ("stepping", "full"))
    assert one.status == other.status == "solved"
    assert len(one.attempts) == len(other.attempts) == 1
    assert "all states" in other.attempts[0]
    np.testing.assert_allclose(other.q, one.q, atol=1e-10)
    np.testing.assert_allclose(other.p, one.p, atol=1e-9)
    assert other.cost == pytest.approx(one.cost, abs=1e-11)


@pytest.mark.parametrize(("scheme", "method"), [("explicit-euler", "stepping"), ("midpoint", "full")])
def test_fsolve_agrees(module, scheme, method):
    ours, theirs = (solving.solve(module(scheme, method), d, points=few(), steps=3) for d in ("newton", "fsolve"))
    assert theirs.status == "solved", theirs.message
    assert theirs.cost == pytest.approx(ours.cost, abs=1e-9)


def test_fmin_agrees(interpreted, module):
    pair = PointSet(START[:2], TARGET[:2], np.zeros(2))
    ours, theirs = (solving.solve(module("explicit-euler"), d, points=pair, steps=2) for d in ("newton", "fmin"))
    assert theirs.status == "solved", theirs.message
    assert theirs.cost == pytest.approx(ours.cost, abs=1e-7)


@pytest.mark.parametrize("driver", ["newton", "slsqp", "trust-constr"])
@pytest.mark.parametrize("scheme", ["symplectic-euler", "symplectic-euler-adjoint", "midpoint"])
def test_the_action_has_the_optimum_of_its_symplectic_scheme(module, scheme, driver):
    stepping = module(scheme).solve(START, TARGET, 3)
    result = solving.solve(module(scheme, "action"), driver, points=few(), steps=3)
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(stepping.cost, abs=1e-7)


def test_the_action_of_the_explicit_euler_method_is_that_of_the_symplectic_one(module):
    """The conditions of a minimum take momenta at the other end, so that the thesis's two routes differ by O(h)."""
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


def test_many_and_few_directions_agree(module):
    """GMRES, dense elimination and second derivatives that are not stored give the same solution."""
    made = module("explicit-euler")
    generator = np.random.default_rng(4)
    start = 0.7 * generator.uniform(-0.7, 0.7, (14, 2))
    target = start + 0.02 * np.sin(3 * start[:, ::-1])
    solutions = []
    for dense, stored in ((24, 3e7), (100, 3e7), (24, 0.0)):
        before = made.DENSE, made.STORED
        made.DENSE, made.STORED = dense, stored
        try:
            solutions.append(made.solve(start, target, 2))
        finally:
            made.DENSE, made.STORED = before
    for solution in solutions:
        assert solution.status == "solved"
        np.testing.assert_allclose(solution.p, solutions[0].p, atol=1e-8)


# ---- Uncertain targets, attempts, failures ----


def test_uncertain_targets_balance_cost_and_distance(module):
    """Stationarity of cost/2 + sum |q_N - target|^2/(2 sigma^2) by targets that are met exactly, and by differences."""
    made = module("midpoint")
    sigma = 0.2
    solution = made.solve(START, TARGET, 3, sigma=sigma)
    assert solution.status == "solved"

    def total(end):
        exact = made.solve(START, end, 3)
        return exact.cost / 2 + ((end - TARGET) ** 2).sum() / (2 * sigma**2)

    end = solution.q[-1]
    least = total(end)
    for direction in np.random.default_rng(1).normal(size=(3, 3, 2)):
        up, down = total(end + 1e-3 * direction), total(end - 1e-3 * direction)
        assert up > least
        assert down > least
        assert abs(up - down) < 1e-3 * (up + down - 2 * least) + 1e-9


def test_implicit_steps_begin_at_points_of_a_nearby_trajectory(module):
    """They take fewer iterations to the same states, and only as many as the accuracy that is asked for needs."""
    made = module("midpoint")
    case = made.make_case(START, TARGET, 4)
    first, momenta = made.first_momenta(case), 1.001 * made.first_momenta(case)
    _, path, points = made.trajectory(case, momenta)
    made_by = {}
    for near in (0.0, 1e-15, 1e-6):
        other, known = path.copy(), made.trajectory(case, first)[2]
        made_by[near] = made.follow(case.duration / 4, case.own, case.parameters, other, known, near)
        np.testing.assert_allclose(other, path, rtol=0, atol=1e-13 if near < 1e-6 else 1e-5)
        np.testing.assert_allclose(known, points, rtol=0, atol=1e-13 if near < 1e-6 else 1e-5)
    assert 4 <= made_by[1e-6] < made_by[1e-15] < made_by[0.0]


def test_points_that_stay(module):
    solution = module("midpoint").solve(START, START, 3)
    assert solution.status == "solved"
    assert solution.cost == 0.0


ATTEMPTS = ("from_velocity", "from_least_action", "from_rest", "by_continuation", "on_all_states", "by_steps")


@pytest.mark.parametrize("attempt", ATTEMPTS)
def test_every_attempt_finds_the_solution_by_itself(module, attempt):
    made = module("explicit-euler")
    reference = made.solve(START, TARGET, 4)
    rungs = made.ATTEMPTS["stepping"]
    made.ATTEMPTS["stepping"] = tuple(rung for rung in rungs if rung[1].__name__ == attempt)
    try:
        solution = made.solve(START, TARGET, 4)
    finally:
        made.ATTEMPTS["stepping"] = rungs
    assert solution.status == "solved", solution.message
    np.testing.assert_allclose(solution.q, reference.q, atol=1e-10)


def test_fewer_steps_are_taken_as_long_as_they_have_a_solution(module, monkeypatch):
    """Where steps below six never succeed, the attempt says so instead of handing over the solution with six."""
    made, original = module("explicit-euler"), module("explicit-euler").shoot_at

    def shoot_at(case, *others):
        return original(case, *others) if case.steps >= 6 else (made.STALLED, 1, 0.1)

    monkeypatch.setattr(made, "shoot_at", shoot_at)
    monkeypatch.setitem(made.ATTEMPTS, "stepping", made.LAST)
    solution = made.solve(START, TARGET, 4)
    assert solution.status == "not connected"
    assert solution.attempts[-1].endswith("residual 1.0e-01, with 5 steps, but solved with 6")
    assert made.solve(START, TARGET, 6).status == "solved"


def test_what_cannot_be_solved_is_not_called_solved(module):
    """Two neighbours change places in a single explicit step: their common velocity cannot tell them apart."""
    start = np.array([[0.0, 0.0], [1e-7, 0.0]])
    with np.errstate(all="ignore"):  # interpreted code warns where compiled code does not
        solution = module("midpoint").solve(start, np.array([[0.5, 0.0], [-0.5, 1e-9]]), 1, max_iterations=4)
    assert solution.status == "not connected"
    assert len(solution.attempts) == len(ATTEMPTS)
    assert "no attempt connects the points" in solution.message


def test_a_false_claim_of_success_is_downgraded(module):
    made = module("explicit-euler")
    solution = made.solve(START, TARGET, 3)
    path = np.stack([solution.q, solution.p], axis=1)
    path[2, 0, 0, 0] += 1e-6
    claim = ConnectAttempt("solved", "", 1, path, 1e-10)
    result = connect_result(made, "newton", Run(3, points=few()), claim)
    assert result.status == "inaccurate"


def test_what_does_not_fit_is_refused(module):
    with pytest.raises(ArgumentError, match="use --method action"):
        solving.solve(module("midpoint"), "slsqp", points=few())
    row = np.stack([0.01 * np.arange(13), np.zeros(13)], axis=1)
    thirteen = PointSet(row, row + 0.1, np.zeros(13))
    with pytest.raises(ArgumentError, match="at most 24"):
        solving.solve(module("explicit-euler"), "fmin", points=thirteen)
    with pytest.raises(PointsError, match="no points"):
        solving.solve(module("midpoint"))
    with pytest.raises(SchemeError, match="no action belongs to it"):
        module("rk4", "action")
    with pytest.raises(SchemeError, match="chooses its own steps"):
        module("lsoda", "full")
    with pytest.raises(SchemeError, match="did you mean midpoint"):
        module("midpont")


def test_many_landmarks_by_broydens_method_agree_with_newtons(module):
    """Thirteen landmarks without a tangent; Newton's method from the result has nothing left to do."""
    points, made = read_points(PROBLEMS / "data" / "trilobite40.csv", 2), module("explicit-euler")
    start, target = points.start[::3][:13], points.target[::3][:13]
    solution = made.solve(start, target, 4)
    assert (solution.status, solution.tangents) == ("solved", 0), solution.message
    case = made.make_case(start, target, 4)
    matrix = made.jacobian(case, solution.p[0].ravel())
    correction = np.linalg.solve(matrix, made.residual(case, solution.p[0].ravel()))
    assert np.abs(correction).max() < 1e-9


def test_neighbours_that_turn_at_a_millionth(module):
    """Momenta of 1e5 leave residuals above the tolerance that are rounding; each place is met to 1e-8."""
    start, target = START.copy(), TARGET.copy()
    start[1], target[1] = start[0] + [1e-6, 0.0], target[0] + [0.0, 1e-6]
    result = solving.solve(module("explicit-euler"), points=PointSet(start, target, np.zeros(3)), steps=10)
    assert result.status == "solved", result.message
    assert result.residual < 1e-8


@pytest.mark.parametrize(
    ("error", "noise", "outcome"), [(1e-9, 2e-9, "ROUNDED"), (2e-9, 1e-9, "STALLED"), (2e-8, 1e-6, "STALLED")]
)
def test_rounding_excuses_only_what_it_does(module, error, noise, outcome):
    made = module("explicit-euler")
    assert made.without_progress(error, noise) == getattr(made, outcome)


def test_noise_of_the_arrival_grows_with_the_momenta(module):
    """A unit in the last place of momenta p moves places by about 1e-16 |p|; closer neighbours need larger ones."""
    made, noise = module("explicit-euler"), []
    for distance in (1e-1, 1e-3, 1e-5):
        start, target = np.array([[0.1, 0.2], [0.1 + distance, 0.2]]), np.array([[0.1, 0.2], [0.1, 0.2 + distance]])
        solution = made.solve(start, target, 4)
        noise.append(made.rounding(made.make_case(start, target, 4), np.stack([solution.q, solution.p], axis=1)))
    assert 1e-18 < noise[0] < 1e-14
    assert noise[0] < noise[1] < noise[2] < 1e-8
