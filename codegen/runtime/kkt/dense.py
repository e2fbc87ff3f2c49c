"""Solving with the LU factors of a small dense matrix."""

from numba import njit


@njit(cache=True, error_model="numpy")
def solve_factored(matrix, pivots, right_hand_side):
    """Solve in place, `right_hand_side` (m,), with what `factor_matrix` left in `matrix` (m, m) and `pivots` (m,)."""
    size = matrix.shape[0]
    for i in range(size):
        pivot = pivots[i]
        value = right_hand_side[pivot]
        right_hand_side[pivot] = right_hand_side[i]
        right_hand_side[i] = value
    for i in range(1, size):
        for j in range(i):
            right_hand_side[i] -= matrix[i, j] * right_hand_side[j]
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, size):
            right_hand_side[i] -= matrix[i, j] * right_hand_side[j]
        right_hand_side[i] /= matrix[i, i]
