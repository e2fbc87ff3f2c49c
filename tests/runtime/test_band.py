"""The factorisation of a matrix in a band against numpy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codegen.runtime.arithmetic import factor_band, factor_matrix, solve_band, solve_factored

pytestmark = pytest.mark.fast


@given(st.integers(1, 12), st.integers(0, 4), st.integers(0, 4), st.integers(0, 2**32 - 1))
def test_band(size, below, above, seed):
    generator = np.random.default_rng(seed)
    matrix = np.triu(np.tril(generator.normal(size=(size, size)), above), -below) + 3 * np.eye(size)
    right, pivots = generator.normal(size=size), np.zeros(size, dtype=np.int64)
    exact = np.linalg.solve(matrix, right)
    factors, solution = matrix.copy(), right.copy()
    assert factor_band(factors, pivots, below, above) == -1
    solve_band(factors, pivots, solution, below, above)
    scale = np.linalg.cond(matrix) * np.abs(exact).max()
    assert np.abs(solution - exact).max() <= 1e-14 * scale
    # The same operations on a full matrix give the same bits.
    full, dense = matrix.copy(), right.copy()
    assert factor_matrix(full, pivots) == -1
    solve_factored(full, pivots, dense)
    np.testing.assert_array_equal(dense, solution)


def test_first_column_without_a_pivot_is_returned():
    matrix, pivots = np.diag([1.0, 0.0, 2.0]), np.zeros(3, dtype=np.int64)
    assert factor_band(matrix, pivots, 0, 0) == 1
