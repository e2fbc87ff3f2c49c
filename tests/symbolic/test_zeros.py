"""What counts as identically zero: everything that is proved to be, and nothing because it is small somewhere."""

import itertools

import pytest
import sympy
from hypothesis import given, settings
from hypothesis import strategies as st
from sympy import Integer, Max, Rational, atan, cos, cosh, exp, log, sin, sinh, sqrt, symbols, tan, tanh

from codegen.symbolic.derivatives import second_derivatives
from codegen.symbolic.zeros import PRIMES, identically_zero

X, Y, Z, A, H, T = symbols("x y z a H T", real=True)

ZEROS = [
    (X + Y) ** 3 - sympy.expand((X + Y) ** 3),
    1 / (X - Y) + 1 / (Y - X) + X / (X * Y) - 1 / Y,
    sin(X) ** 2 + cos(X) ** 2 - 1,
    sin(2 * X) - 2 * sin(X) * cos(X),
    cos(X + Y) - cos(X) * cos(Y) + sin(X) * sin(Y),
    tan(X) ** 2 + 1 - 1 / cos(X) ** 2,
    exp(X + Y) - exp(X) * exp(Y),
    exp((X + Y) ** 2) - exp(X**2) * exp(2 * X * Y) * exp(Y**2),
    exp(exp(X + Y)) - exp(exp(X) * exp(Y)),
    1 / (1 + exp(-X)) - exp(X) / (1 + exp(X)),
    tanh(X) - sinh(X) / cosh(X),
    1 - tanh(200 * X) ** 2 - 1 / cosh(200 * X) ** 2,
    (sqrt(X**2 + Y**2) + A) * (sqrt(X**2 + Y**2) - A) - X**2 - Y**2 + A**2,
    sqrt(X * Y) * sqrt(X * Z) * sqrt(Y * Z) / (X * Y * Z) - 1,
    X**A * X - X ** (A + 1),
    log(X * Y) - log(X) - log(Y),
    atan(X) - 2 * atan(X / (1 + sqrt(1 + X**2))),
    Max(X, Y) * (X + 1) - Max(X, Y) * X - Max(X, Y),
    Integer(10) ** 300 * ((X + 1) ** 2 - X**2 - 2 * X - 1),
]
NOT_ZERO = [
    Rational(1, 10**42) * X**2,
    Rational(1, 10**300) * X + 0,
    sqrt(X * Y) - sqrt(X) * sqrt(Y) + Rational(1, 10**60) * X,
    log(X * Y) - log(X) - log(Y) + Rational(1, 10**200) * X,
    (X + 1) ** 2 - X**2 - 2 * X - 1 + Rational(1, 10**200),
    exp(-X / H) - exp(-2 * X / H),
    72 * 10**9 * exp(-8750 / T) - exp(-8751 / T),
    exp(-((X - 20) ** 2)) * (X - 20),
    exp(X - 8) / (1 + exp(X - 8)) ** 2 - exp(-1000 * X**2),
    1 - tanh(200 * X) ** 2,
    1 - tanh(200 * (X - 20)) ** 2,
    1 - tanh(10**6 * (X - 20)) ** 2,
    log(X * Y) - log(X) - log(Y) + 1 - tanh(10**6 * (X - 20)),
    atan(X) - 2 * atan(X / (1 + sqrt(1 + X**2))) + exp(-(10**6) * X**2),
    sqrt(X**2 - 2 * X + 1) - X + 1,
    sqrt(X) - sqrt(Y),
    Max(X, 0) - X,
    Max(X, 10**6) - 10**6,
]


@pytest.mark.parametrize("expression", ZEROS, ids=str)
def test_what_cancels_is_zero(expression):
    assert expression != 0, "sympy sees it"
    assert identically_zero(expression)


@pytest.mark.parametrize("expression", NOT_ZERO, ids=str)
def test_what_is_small_somewhere_is_not_zero(expression):
    assert not identically_zero(expression)


FLAT = {
    "atmosphere": exp(-X / H) * Y**2,
    "reaction": 72 * 10**9 * exp(-8750 / X) * Y,
    "logistic": Y / (1 + exp(-X)),
    "gaussian": Y * exp(-((X - 20) ** 2)),
    "steep": Y * tanh(200 * X),
    "tiny": Rational(1, 10**42) * X**2 * Y**2,
    "huge": Integer(10) ** 300 * X**2 * Y**2,
}


@pytest.mark.parametrize("name", FLAT)
def test_long_scalars_keep_all_second_derivatives_of_flat_terms(name):
    """Among 200 operations and more, in which sin^2 + cos^2 hides zeros."""
    term = FLAT[name]
    rest = sum(sin(k * Z) ** 2 + cos(k * Z) ** 2 + (Z + k) ** 2 / (1 + k) for k in range(1, 12))
    found = second_derivatives(term + rest, (X, Y, Z))
    exact = {(i, j) for i, a in enumerate((X, Y)) for j, b in enumerate((X, Y)) if j <= i and term.diff(a, b) != 0}
    assert set(found.indices) == exact | {(2, 2)}


CONSTANTS = st.builds(lambda m, e: m * Rational(10) ** e, st.sampled_from([1, -3, 7]), st.integers(-300, 300))
SHAPES = st.sampled_from(
    [
        lambda c: exp(-X * c),
        lambda c: tanh(c * X + Y),
        lambda c: c * X**2 * Y,
        lambda c: 1 / (1 + exp(c * (X - 8))),
        lambda c: sin(c * X) * cos(Y),
        lambda c: sqrt(c**2 + X**2),
        lambda c: log(1 + c**2 * X**2),
        lambda c: (X + c) ** 2 / (c**2 + Y**2),
    ]
)


@settings(max_examples=60, deadline=None)
@given(SHAPES, CONSTANTS, CONSTANTS)
def test_a_term_of_any_size_beside_what_cancels(shape, constant, factor):
    nothing = (sin(X) ** 2 + cos(X) ** 2 - 1) * Y + exp(X + Y) - exp(X) * exp(Y)
    assert identically_zero(nothing * constant)
    assert not identically_zero(nothing + factor * shape(constant).diff(X))


def test_deltas_of_kinks_are_zero_almost_everywhere():
    kink = Max(X - 1, 0) ** 3 * Y
    assert identically_zero(sympy.DiracDelta(X, 1) * Y)
    assert not identically_zero(kink.diff(X, 2))
    assert identically_zero(kink.diff(Y, 2))


def test_each_prime_leaves_one_when_it_is_divided_by_the_next_and_has_roots_of_small_numbers():
    for prime, smaller in itertools.pairwise(PRIMES):
        assert prime % smaller == 1
    for prime in PRIMES:
        assert sympy.isprime(prime)
        assert all(sympy.ntheory.sqrt_mod(n, prime) is not None for n in (-1, 2, 3, 5, 7, 11, 13))
