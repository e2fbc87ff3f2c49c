"""Linear equation in one unknown, in the form of a one by one matrix."""

from numba import njit


@njit(cache=True, error_model="numpy")
def factor_matrix(matrix, pivots):
    """Return -1, or 0 when the coefficient is zero or NaN."""
    return -1 if abs(matrix[0, 0]) > 0.0 else 0


@njit(cache=True, error_model="numpy")
def solve_factored(matrix, pivots, right_hand_side):
    """Divide in place."""
    right_hand_side[0] /= matrix[0, 0]
