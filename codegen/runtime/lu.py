"""LU factorisation with partial pivoting of a small dense matrix, and solving with its factors.

Source: Golub and Van Loan (2013), Matrix computations, algorithm 3.4.1.
"""

from numba import njit


@njit(cache=True, error_model="numpy")
def factor_matrix(matrix, pivots):
    """Factor `matrix` (m, m) in place, fill `pivots` (m,); -1, or the first column whose pivot is zero or NaN."""
    size = matrix.shape[0]
    for i in range(size):
        pivot = i
        for j in range(i + 1, size):
            if abs(matrix[j, i]) > abs(matrix[pivot, i]):
                pivot = j
        if not abs(matrix[pivot, i]) > 0.0:
            return i
        pivots[i] = pivot
        if pivot != i:
            for c in range(size):
                matrix[i, c], matrix[pivot, c] = matrix[pivot, c], matrix[i, c]
        inverse = 1.0 / matrix[i, i]
        for j in range(i + 1, size):
            multiplier = matrix[j, i] * inverse
            matrix[j, i] = multiplier
            if multiplier != 0.0:
                for c in range(i + 1, size):
                    matrix[j, c] -= multiplier * matrix[i, c]
    return -1


@njit(cache=True, error_model="numpy")
def solve_factored(matrix, pivots, right_hand_side):
    """Overwrite a right-hand side, shape (n,), by the solution, with the factors that `factor_matrix` left."""
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
