"""What Newton's equations of the barrier are given."""

import numpy as np
import pytest

from codegen.runtime.optimise.barrier import add_barrier


def test_residuals_of_rounding_size_lead_nowhere():
    """Only those of equations: a slope stays however small it is, and so does the residual of a large error."""
    gradient, is_multiplier = np.array([3e-16, -3e-16, 2e-14, 1.0]), np.array([False, True, True, True])
    indices, side, distance, duals = np.array([0]), np.array([1.0]), np.array([2.0]), np.array([4.0])
    right, diagonal = np.empty(4), np.empty(4)
    add_barrier.py_func(gradient, is_multiplier, indices, side, distance, duals, 1e-20, 0.5, 0.25, right, diagonal)
    assert right == pytest.approx([3e-16, 0.0, 2e-14, 1.0], rel=1e-4, abs=1e-30)
    assert diagonal == pytest.approx([0.5 + 4.0 / 2.0, -0.25, -0.25, -0.25])
