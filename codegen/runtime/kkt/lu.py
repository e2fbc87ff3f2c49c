"""LU factorisation with partial pivoting of a small dense matrix.

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
