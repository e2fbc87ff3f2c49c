"""Solving for several right-hand sides at once with the LU factors of a dense matrix."""

from numba import njit


@njit(cache=True, error_model="numpy")
def solve_columns(matrix, pivots, vectors):
    """Solve in place for several right-hand sides, shape (n, m), with the factors that `factor_matrix` left."""
    size, columns = vectors.shape
    for k in range(size):
        for c in range(columns):
            vectors[k, c], vectors[pivots[k], c] = vectors[pivots[k], c], vectors[k, c]
    for k in range(size):
        for column in range(k):
            factor = matrix[k, column]
            for c in range(columns):
                vectors[k, c] -= factor * vectors[column, c]
    for k in range(size - 1, -1, -1):
        for column in range(k + 1, size):
            factor = matrix[k, column]
            for c in range(columns):
                vectors[k, c] -= factor * vectors[column, c]
        for c in range(columns):
            vectors[k, c] /= matrix[k, k]
