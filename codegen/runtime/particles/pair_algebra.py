"""Linear algebra of many particles: Cholesky factors, products with symmetric matrices, norms.

Inner loops run along rows, so that they are vectorised. Source: Golub and Van Loan (2013), Matrix computations,
algorithm 4.2.2.
"""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def mirror_lower_triangle(matrix):
    """Copy what is below the diagonal of a matrix, shape (n, n), to above it."""
    for row in range(matrix.shape[0]):
        for column in range(row):
            matrix[column, row] = matrix[row, column]


@njit(cache=True, error_model="numpy")
def symmetric_product(matrix, vectors, products):
    """Fill `products` with a symmetric matrix, shape (n, n), times vectors, both of shape (n, m)."""
    size, columns = vectors.shape
    for row in range(size):
        for c in range(columns):
            products[row, c] = 0.0
    if columns == 1:
        total, vector = products.reshape(-1), vectors.reshape(-1)
        for row in range(size):
            factor = vector[row]
            if factor != 0.0:
                for column in range(size):
                    total[column] += factor * matrix[row, column]
        return
    for row in range(size):
        for column in range(size):
            factor = matrix[row, column]
            if factor != 0.0:
                for c in range(columns):
                    products[row, c] += factor * vectors[column, c]


@njit(cache=True, error_model="numpy")
def cholesky(matrix):
    """Replace a symmetric matrix, shape (n, n), by the upper factor L' of matrix = L L'; return whether it has one."""
    size = matrix.shape[0]
    for k in range(size):
        if not matrix[k, k] > 0.0:
            return False
        root = np.sqrt(matrix[k, k])
        for column in range(k, size):
            matrix[k, column] /= root
        for row in range(k + 1, size):
            factor = matrix[k, row]
            for column in range(row, size):
                matrix[row, column] -= factor * matrix[k, column]
    return True


@njit(cache=True, error_model="numpy")
def solve_cholesky(factor, vectors):
    """Solve in place for several right-hand sides, shape (n, m), with the factor that `cholesky` left."""
    size, columns = vectors.shape
    for k in range(size):
        for c in range(columns):
            vectors[k, c] /= factor[k, k]
            value = vectors[k, c]
            for row in range(k + 1, size):
                vectors[row, c] -= factor[k, row] * value
    for k in range(size - 1, -1, -1):
        for c in range(columns):
            total = vectors[k, c]
            for column in range(k + 1, size):
                total -= factor[k, column] * vectors[column, c]
            vectors[k, c] = total / factor[k, k]


@njit(cache=True, error_model="numpy")
def largest(values):
    """Return max-norm of a vector, shape (n,); infinite when an entry is not a number."""
    size = 0.0
    for k in range(values.size):
        if not abs(values[k]) < np.inf:
            return np.inf
        size = max(size, abs(values[k]))
    return size


@njit(cache=True, error_model="numpy")
def copy_state(source, target):
    """Copy a state of shape (2, n, d); return whether it is finite."""
    finite = True
    for s in range(2):
        for i in range(source.shape[1]):
            for a in range(source.shape[2]):
                target[s, i, a] = source[s, i, a]
                finite = finite and abs(source[s, i, a]) < np.inf
    return finite
