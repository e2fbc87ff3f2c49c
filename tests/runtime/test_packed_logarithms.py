"""Logarithms without branches against 60 digits, from the smallest numbers to the largest."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest

from codegen.runtime.arithmetic import packed_log1p, packed_log1p_minus_ratio, packed_x_minus_log1p

GENERATOR = np.random.default_rng(0)
NUMBERS = [
    0.0,
    *10.0 ** GENERATOR.uniform(-150, 299, 200),
    *10.0 ** GENERATOR.uniform(-6, 2, 400),
    *(np.sqrt(2.0) - 1.0 + 1e-15 * GENERATOR.normal(size=20)),  # where k passes from 0 to 1
    *(2.0 ** np.arange(1, 60) - 1.0),
    *-(10.0 ** GENERATOR.uniform(-12, -0.01, 200)),
]
EPSILON = 2.0**-52


@pytest.mark.parametrize(
    ("function", "exact", "allowed"),
    [
        (packed_log1p, mpmath.log1p, 1.0),
        (lambda x: packed_x_minus_log1p(x, np.nan), lambda x: x - mpmath.log1p(x), 8.0),
        (lambda x: packed_log1p_minus_ratio(x, np.nan), lambda x: mpmath.log1p(x) - x / (1 + x), 20.0),
    ],
)
def test_relative_error(function, exact, allowed):
    """In units of 2^-52; differences are 0.068 and 0.054, of parts as large as log 2, when 1 + x passes sqrt(2)."""
    with mpmath.workdps(400):
        for x in NUMBERS:
            wanted = exact(mpmath.mpf(float(x)))
            assert abs(mpmath.mpf(function(float(x))) - wanted) <= allowed * EPSILON * abs(wanted), x
