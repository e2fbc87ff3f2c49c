"""The particle ansatz solves the Euler-Poincare equations for every kernel and test function; what is near does not."""

from __future__ import annotations

import numpy as np
import pytest
from sympy import Function, Rational, exp, simplify
from weak_solution import is_zero, weak_defect


def test_two_particles_with_any_kernel_and_any_test_function():
    assert is_zero(weak_defect())


@pytest.mark.parametrize("term", ["rate", "advection", "stretching", "divergence"])
def test_every_term_is_needed(term):
    assert not is_zero(weak_defect(particles=1, without=term))


def test_the_kernel_must_be_symmetric():
    assert not is_zero(weak_defect(lambda x, y: Function("G")(*x, *y)))


def test_random_test_functions_and_a_gaussian_kernel():
    """Exact arithmetic at rational places: the sum of exponentials cancels, and does not without one term."""
    generator = np.random.default_rng(3)

    def gauss(x, y):
        return exp(-sum((a - b) ** 2 for a, b in zip(x, y, strict=True)))

    coefficients = generator.integers(-5, 6, (3, 3)).tolist()

    def test(x, c=coefficients):
        return (1 - x[0] ** 2 - x[1] ** 2) ** 2 * sum(
            c[a][b] * x[0] ** a * x[1] ** b for a in range(3) for b in range(3)
        )

    defect, rest = weak_defect(gauss, test), weak_defect(gauss, test, without="advection")
    names = sorted(defect.free_symbols | rest.free_symbols, key=str)
    values = {name: Rational(int(k), 7) for name, k in zip(names, generator.integers(-4, 5, len(names)), strict=True)}
    assert simplify(defect.subs(values)) == 0
    assert simplify(rest.subs(values)) != 0
