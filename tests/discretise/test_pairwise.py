"""Pairwise Hamiltonians: scalars and limits, derivatives against 50 digits where digits are easily lost, refusals."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import sympy
from conftest import PROBLEMS

from codegen import Connect, Pairwise, Simulate, parameters, particles
from codegen.discretise.model.from_problem import load_problem
from codegen.discretise.model.pairwise import normalise_pairwise
from codegen.errors import BoundaryError, ExpressionError, SymbolError
from codegen.problem.symbols import recorded_declarations
from codegen.symbolic.terms import Invariants

NONE = np.zeros(0)


@pytest.fixture(scope="module")
def plate(interpreted):
    return interpreted("image_registration", scheme="explicit-euler")


# ---- Several threads ----


@pytest.mark.slow
def test_threads_share_the_gradient_in_blocks(interpreted, plate):
    """What a particle gets is what one thread adds up, to the last digit, in one block and in more."""
    shared = interpreted("image_registration", arguments={"parallel": "true"}, scheme="explicit-euler")
    assert not hasattr(plate, "gradient_by_threads")
    generator = np.random.default_rng(3)
    for count in (9, shared.GROUP + 3):
        state = generator.uniform(-0.6, 0.6, (2, count, 2))
        one, several = np.empty_like(state), np.full_like(state, np.nan)
        plate.hamiltonian_gradient(state, np.zeros((count, 0)), NONE, one)
        shared.hamiltonian_gradient(state, np.zeros((count, 0)), NONE, several)
        np.testing.assert_array_equal(several, one)


def test_threads_cannot_share_a_gradient_that_visits_pairs_once(interpreted):
    with pytest.raises(ExpressionError, match="parallel=True, but the gradient calls exp"):
        interpreted("image_registration", arguments={"parallel": "true", "kernel": "gauss"}, scheme="explicit-euler")


# ---- The plate's kernel by an independent formula, with 50 digits ----


def green(x1, x2, y1, y2):
    """Boggio (1905): |x - y|^2 ((A^2 - 1)/2 - log A), and its limit where points coincide."""
    s = (x1 - y1) ** 2 + (x2 - y2) ** 2
    if s == 0:
        return (x1**2 + x2**2 - 1) ** 2 / 2
    A = mpmath.sqrt(((x1**2 + x2**2) * (y1**2 + y2**2) - 2 * (x1 * y1 + x2 * y2) + 1) / s)
    return s * ((A**2 - 1) / 2 - mpmath.log(A))


def reference(state):
    """H, its gradient and its second derivatives, differentiated numerically with 120 digits."""
    z = [mpmath.mpf(float(v)) for v in state.ravel()]

    def hamiltonian(*z):
        q, p = [z[0:2], z[2:4]], [z[4:6], z[6:8]]
        total = mpmath.mpf(0)
        for i in range(2):
            for j in range(2):
                same = i == j
                g = (1 - q[i][0] ** 2 - q[i][1] ** 2) ** 2 / 2 if same else green(*q[i], *q[j])
                total += (p[i][0] * p[j][0] + p[i][1] * p[j][1]) * g / 2
        return total

    h = mpmath.mpf(10) ** -30

    def shifted(*steps):
        moved = list(z)
        for k, sign in steps:
            moved[k] += sign * h
        return hamiltonian(*moved)

    with mpmath.workdps(120):
        gradient = [(shifted((k, 1)) - shifted((k, -1))) / (2 * h) for k in range(8)]
        second = [
            [
                (
                    shifted((k, 1), (m, 1))
                    - shifted((k, 1), (m, -1))
                    - shifted((k, -1), (m, 1))
                    + shifted((k, -1), (m, -1))
                )
                / (4 * h**2)
                for m in range(8)
            ]
            for k in range(8)
        ]
        return hamiltonian(*z), np.array(gradient), np.array(second)


def largest(errors):
    return float(np.abs(np.array(errors, dtype=float)).max())


PLACES = {
    "ordinary": ((0.3, -0.2), (-0.5, 0.4)),
    "neighbours at 1e-12": ((0.3, 0.4), (0.3 + 1e-12, 0.4)),
    "neighbours at 1e-6": ((0.3, 0.4), (0.3, 0.4 - 1e-6)),
    "on an axis, 1e-12 from the circle": ((1 - 1e-12, 0.0), (0.1, 0.2)),
    "off the axes, 1e-12 from the circle": ((0.6 * (1 - 1e-12), 0.8 * (1 - 1e-12)), (-0.3, 0.5)),
    "both at the circle": ((0.6 * (1 - 1e-12), 0.8 * (1 - 1e-12)), (0.8 * (1 - 1e-12), 0.6 * (1 - 1e-12))),
    "neighbours at the circle": ((0.0, 1 - 1e-12), (1e-12, 1 - 1e-12)),
    "at the origin": ((0.0, 0.0), (1e-9, 0.7)),
}


@pytest.mark.parametrize("name", PLACES)
def test_derivatives_to_twelve_digits(plate, name):
    state = np.array([PLACES[name], ((0.7, -1.1), (0.4, 0.9))])
    own = np.zeros((2, 0))
    value, gradient, second = reference(state)
    found, products = np.empty_like(state), np.empty((8, 8))
    hessian = np.empty((8, 8))
    plate.hamiltonian_gradient(state, own, NONE, found)
    plate.hamiltonian_hessian(state, own, NONE, hessian)
    plate.hessian_products(state, own, NONE, np.eye(8), products)
    assert abs(float((plate.hamiltonian(state, own, NONE) - value) / value)) < 1e-12
    for part in (slice(0, 4), slice(4, 8)):  # H_q, then H_p
        assert largest((found.ravel()[part] - gradient[part]) / largest(gradient[part])) < 1e-12
    for rows in (slice(0, 4), slice(4, 8)):
        for columns in (slice(0, 4), slice(4, 8)):
            size = largest(second[rows, columns])
            assert largest((hessian[rows, columns] - second[rows, columns]) / size) < 1e-12
            assert largest((products[rows, columns] - second[rows, columns]) / size) < 1e-12


def test_kernel_itself_to_twelve_digits_everywhere(plate):
    for x, y in PLACES.values():
        state, matrix = np.zeros((2, 2, 2)), np.empty((2, 2))
        state[0] = x, y
        plate.momentum_matrix(state, np.zeros((2, 0)), NONE, matrix)
        with mpmath.workdps(120):
            exact = green(*(mpmath.mpf(float(v)) for v in (*x, *y)))
            assert abs(float((matrix[0, 1] - exact) / exact)) < 1e-12


def test_value_and_gradient_attain_their_limits(plate):
    """By continuation: G(x, x) = (|x|^2 - 1)^2/2, and half of its derivative is that by either argument."""
    x = np.array([0.3, -0.4])
    state, matrix, gradient = np.array([[x, x], [[1.0, 0.0], [2.0, 0.0]]]), np.empty((2, 2)), np.empty((2, 2, 2))
    plate.momentum_matrix(state, np.zeros((2, 0)), NONE, matrix)
    np.testing.assert_allclose(matrix, np.full((2, 2), (x @ x - 1) ** 2 / 2), rtol=1e-15)
    plate.hamiltonian_gradient(state, np.zeros((2, 0)), NONE, gradient)
    slope = 2 * x * (x @ x - 1)
    np.testing.assert_allclose(gradient[0], [(0.5 + 1.0) * slope, (2.0 + 1.0) * slope], rtol=1e-15)


def test_kernel_vanishes_with_its_normal_derivative_on_the_circle(plate):
    for distance in (1e-4, 1e-8):
        state, matrix = np.zeros((2, 2, 2)), np.empty((2, 2))
        state[0] = (0.6 * (1 - distance), 0.8 * (1 - distance)), (0.1, 0.3)
        plate.momentum_matrix(state, np.zeros((2, 0)), NONE, matrix)
        assert 0.0 < matrix[0, 1] < 10 * distance**2


@pytest.mark.parametrize("x", [1e-300, 1e-17, 1e-9, 1e-4, 0.1, 0.49999, 0.5, 0.50001, 3.0, 1e10, 1e300])
def test_differences_without_cancellation(plate, x):
    with mpmath.workdps(700):
        exact = mpmath.mpf(x)
        first, second = exact - mpmath.log1p(exact), mpmath.log1p(exact) - exact / (1 + exact)
        log = float(mpmath.log1p(exact))
        for value, wanted in ((plate.x_minus_log1p(x, log), first), (plate.log1p_minus_ratio(x, log), second)):
            assert value == pytest.approx(float(wanted), rel=4e-16, abs=5e-324)


def test_a_corrupted_kernel_is_noticed(interpreted, plate):
    state, found = np.array([PLACES["ordinary"], ((0.7, -1.1), (0.4, 0.9))]), np.empty((2, 2, 2))
    gradient = reference(state)[1]
    original = plate.__dict__["packed_log1p_minus_ratio"]
    try:
        plate.__dict__["packed_log1p_minus_ratio"] = lambda x, log: 1.001 * original(x, log)
        plate.hamiltonian_gradient(state, np.zeros((2, 0)), NONE, found)
    finally:
        plate.__dict__["packed_log1p_minus_ratio"] = original
    assert largest((found.ravel() - gradient) / largest(gradient)) > 1e-6


# ---- What is derived from the author's terms ----


def invariants(kernel, dimension=2):
    model = load_problem(PROBLEMS / "image_registration.py", {"kernel": kernel, "dimension": str(dimension)})
    return model, Invariants.of(model.pair_term, model.first.moving, model.second.moving)


def test_scalars_of_the_kernels():
    model, plate = invariants("plate")
    assert len(plate.symbols) == 4
    assert len(plate.distances()) == 1
    assert model.smooth
    model, ball = invariants("plate", 3)
    assert len(ball.symbols) == 4
    assert model.limit is not None
    assert not model.smooth  # like |x - y|, the kernel of the ball has a kink
    model, gauss = invariants("gauss")
    assert len(gauss.symbols) == 2
    assert model.domain == ()


@pytest.mark.parametrize(
    ("kernel", "dimension"), [("gauss", 2), ("gauss", 3), pytest.param("plate", 3, marks=pytest.mark.slow)]
)
def test_other_kernels_follow_from_the_problem_file_alone(interpreted, kernel, dimension):
    module = interpreted("image_registration", arguments={"kernel": kernel, "dimension": str(dimension)})
    generator = np.random.default_rng(3)
    start = generator.uniform(-0.4, 0.4, (3, dimension))
    solution = module.solve(start, start + 0.02 * generator.normal(size=start.shape), 2)
    assert solution.status == "solved", solution.message
    assert solution.residual < 1e-12


# ---- Refusals ----


def made(problem):
    with recorded_declarations() as declared:
        return normalise_pairwise(problem(), declared, "made", "")


def spring(pair, self_term=0, **options):
    def problem():
        i, j = particles("x", "p")
        (k,) = parameters(k=1)
        return Connect(
            hamiltonian=Pairwise((i, j), pair_term=pair(i, j, k), self_term=self_term), points="none.csv", **options
        )

    return problem


def test_asymmetric_terms_are_refused():
    with pytest.raises(ExpressionError, match="exchanged"):
        made(spring(lambda i, j, k: k * i.q[0]))


def test_unused_parameters_are_named():
    model = made(spring(lambda i, j, k: i.q[0] * j.q[0]))
    assert (model.unused, model.parameters) == (("k",), ())


def test_a_missing_self_term_needs_a_limit():
    with pytest.raises(ExpressionError, match="self_term is missing"):
        made(spring(lambda i, j, k: k / (i.q[0] - j.q[0]) ** 2, self_term=None))


def test_an_incomplete_start_is_refused():
    def problem():
        i, j = particles("x", "p")
        return Simulate(
            hamiltonian=Pairwise((i, j), self_term=i.p[0] ** 2, pair_term=(i.q[0] - j.q[0]) ** 2),
            start={i.q[0]: [0, 1]},
            duration=1,
        )

    with pytest.raises(BoundaryError, match="start lacks p_i"):
        made(problem)


@pytest.mark.parametrize(("names", "momenta"), [("x y", "px"), ("", ""), ("x x", "p q")])
def test_unusable_names_are_refused(names, momenta):
    with pytest.raises(SymbolError):
        particles(names, momenta)


def test_a_difference_is_no_squared_distance():
    """In one dimension the scalar of a spring has both signs, as an indefinite form has: neither is cut at zero."""
    x, y, a, b, p, q, r, s = sympy.symbols("x y a b p q r s", real=True)
    spring = Invariants.of((x - a) ** 2, (x, p), (a, q))
    assert spring.distances() == ()
    assert spring.coincidence() == (0, True)
    assert Invariants.of(1 / (x - a), (x, p), (a, q)).coincidence() == (None, False)
    indefinite = Invariants.of(sympy.exp(x * y - x * b - a * y + a * b), (x, y, p, r), (a, b, q, s))
    assert indefinite.distances() == ()
    squared = Invariants.of(sympy.exp(-(x**2) + 2 * x * a - a**2), (x, p), (a, q))
    assert len(squared.distances()) == 1
