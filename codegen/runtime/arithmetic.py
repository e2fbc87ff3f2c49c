"""Arithmetic of time steps and kernels: factorisations of small dense matrices, accurate sums, accurate logarithms.

The innermost loops over matrices run along rows, so that the compiler vectorises them. Sources: Golub and Van Loan
(2013), Matrix computations, algorithms 3.4.1 (LU with partial pivoting) and 4.2.2 (Cholesky).

`accurate_dot` sums products to the last digit. Distances from a boundary are small differences of large numbers.
Source: Ogita, Rump and Oishi (2005), Accurate sum and dot product, SIAM Journal on Scientific Computing 26, algorithm
5.3 (Dot2) with the products of Veltkamp and Dekker.

x - log(1 + x) and log(1 + x) - x/(1 + x) are computed without cancellation. With r = x/(2 + x) the logarithm is
log(1 + x) = 2 (r + r^3/3 + r^5/5 + ...). Both differences are then sums of terms of one sign for small positive x.

The functions `packed_...` have no branches and no calls, so that one instruction computes several numbers at once.
The integer k is such that 1 + x = 2^k (1 + f), with 1 + f between 1/sqrt(2) and sqrt(2). With r = f/(2 + f),

    log(1 + f) = 2 atanh(r) = 2 r + 2 r S = f - f r + 2 r S,   S = r^2/3 + r^4/5 + ...

A polynomial replaces S/r^2: it interpolates the series in r^2 at Chebyshev points, with a relative error of 5e-16
(1.3e-17 of the logarithm). For k = 0, f is x itself, and terms that would cancel are left out exactly. The packed
functions take arguments below 1e300, and return NaN for arguments up to -1. Source: Muller (2016), Elementary
functions, chapters 4 and 11.
"""

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy")
def mirror_lower_triangle(matrix):
    """Copy the lower triangle of a `matrix` (n, n) to its upper triangle."""
    for row in range(matrix.shape[0]):
        for column in range(row):
            matrix[column, row] = matrix[row, column]


@njit(cache=True, error_model="numpy")
def symmetric_product(matrix, vectors, products):
    """Fill `products` (n, m) with the product of a symmetric `matrix` (n, n) and `vectors` (n, m)."""
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
    """Overwrite the upper triangle of a symmetric `matrix` (n, n) by L', with L L' = matrix.

    Return False if the matrix is not positive definite.
    """
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
    """Overwrite right-hand sides `vectors` (n, m) by the solutions, with the `factor` (n, n) from `cholesky`."""
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
def max_norm(values):
    """Return the max-norm of `values` (n,), or infinity if an entry is not finite."""
    size = 0.0
    for k in range(values.size):
        if not abs(values[k]) < np.inf:
            return np.inf
        size = max(size, abs(values[k]))
    return size


@njit(cache=True, error_model="numpy")
def copy_state(source, target):
    """Copy a state of shape (2, n, d); return True if all its numbers are finite."""
    finite = True
    for s in range(2):
        for i in range(source.shape[1]):
            for a in range(source.shape[2]):
                target[s, i, a] = source[s, i, a]
                finite = finite and abs(source[s, i, a]) < np.inf
    return finite


@njit(cache=True, error_model="numpy")
def factor_matrix(matrix, pivots):
    """Factor `matrix` (m, m) into L U in place, and fill `pivots` (m,) with the row exchanges.

    Return -1, or the first column with a zero or NaN pivot.
    """
    return factor_band(matrix, pivots, matrix.shape[0], matrix.shape[0])


@njit(cache=True, error_model="numpy")
def factor_band(matrix, pivots, below, above):
    """Factor a matrix with `below` diagonals under, and `above` diagonals over the main diagonal, as `factor_matrix`.

    The entries outside the band are zero. Exchanges of rows widen the upper part of the band by `below`.
    """
    size = matrix.shape[0]
    for i in range(size):
        last, right = min(size, i + below + 1), min(size, i + below + above + 1)
        pivot = i
        for j in range(i + 1, last):
            if abs(matrix[j, i]) > abs(matrix[pivot, i]):
                pivot = j
        if not abs(matrix[pivot, i]) > 0.0:
            return i
        pivots[i] = pivot
        if pivot != i:
            for c in range(i, right):
                matrix[i, c], matrix[pivot, c] = matrix[pivot, c], matrix[i, c]
        inverse = 1.0 / matrix[i, i]
        for j in range(i + 1, last):
            multiplier = matrix[j, i] * inverse
            matrix[j, i] = multiplier
            if multiplier != 0.0:
                for c in range(i + 1, right):
                    matrix[j, c] -= multiplier * matrix[i, c]
    return -1


@njit(cache=True, error_model="numpy")
def solve_factored(matrix, pivots, right_hand_side):
    """Overwrite a right-hand side (n,) by the solution, with `matrix` and `pivots` from `factor_matrix`."""
    solve_band(matrix, pivots, right_hand_side, matrix.shape[0], matrix.shape[0])


@njit(cache=True, error_model="numpy")
def solve_band(matrix, pivots, right_hand_side, below, above):
    """Overwrite a right-hand side (n,) by the solution, with `matrix` and `pivots` from `factor_band`."""
    size = matrix.shape[0]
    for i in range(size):
        pivot = int(pivots[i])
        value = right_hand_side[pivot]
        right_hand_side[pivot] = right_hand_side[i]
        right_hand_side[i] = value
        for j in range(i + 1, min(size, i + below + 1)):
            right_hand_side[j] -= matrix[j, i] * value
    for i in range(size - 1, -1, -1):
        for j in range(i + 1, min(size, i + below + above + 1)):
            right_hand_side[i] -= matrix[i, j] * right_hand_side[j]
        right_hand_side[i] /= matrix[i, i]


@njit(cache=True, error_model="numpy")
def accurate_dot(first, second):
    """Return the sum of first[k] second[k] over k, as if computed with twice the digits."""
    total, lost = 0.0, 0.0
    for k in range(len(first)):
        a, b = first[k], second[k]
        product = a * b
        a_high, b_high = upper_half(a), upper_half(b)
        a_low, b_low = a - a_high, b - b_high
        lost += a_low * b_low - (((product - a_high * b_high) - a_low * b_high) - a_high * b_low)
        before = total
        total = before + product
        part = total - before
        lost += (before - (total - part)) + (product - part)
    return total + lost


@njit(cache=True, error_model="numpy")
def upper_half(x):
    """Return x rounded to its leading 26 bits."""
    shifted = 134217729.0 * x
    return shifted - (shifted - x)


@njit(cache=True, error_model="numpy")
def x_minus_log1p(x, log):
    """Return x - log(1 + x), where `log` is log(1 + x)."""
    if abs(x) > 0.5:
        return x - log
    r = x / (2.0 + x)
    return x * r - 2.0 * r * odd_series(r * r)


@njit(cache=True, error_model="numpy")
def log1p_minus_ratio(x, log):
    """Return log(1 + x) - x/(1 + x), where `log` is log(1 + x)."""
    if abs(x) > 0.5:
        return log - x / (1.0 + x)
    r = x / (2.0 + x)
    return 2.0 * r * r / (1.0 + r) + 2.0 * r * odd_series(r * r)


@njit(cache=True, error_model="numpy")
def odd_series(s):
    """Return s/3 + s^2/5 + s^3/7 + ..., for 0 <= s <= 1/9, to the last digit."""
    total = 0.0
    for k in range(17, 0, -1):
        total = s * (total + 1.0 / (2 * k + 1))
    return total


ODD_SERIES = (
    0.3333333333333335, 0.1999999999994962, 0.14285714313047945, 0.1111110555757208, 0.09091445278347801,
    0.0766583701508393, 0.07308518774395825,
)  # fmt: skip
LOG_2_HIGH, LOG_2_LOW = 0.6931471803691238, 1.9082149292705877e-10  # k LOG_2_HIGH is exact: the factor has few digits
ROOT_HALF, ONE = 0x3FE6A09E667F3BCD, 0x3FF0000000000000  # the bits of sqrt(1/2) and of 1.0
HUGE, HUGE_BITS = 4503599627370496.0, 0x4330000000000000  # 2^52 and its bits; adding an integer gives 2^52 + n


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def logarithm_parts(x):
    """Return the numbers k, f, r and S of 1 + x, as defined in the docstring of this module."""
    total = np.float64(1.0 + x if x > -1.0 else np.nan)
    bits = np.uint64(total.view(np.int64) + np.int64(ONE - ROOT_HALF)) >> np.uint64(52)  # k + 1023
    k = np.uint64(bits | np.uint64(HUGE_BITS)).view(np.float64) - (HUGE + 1023.0)
    scale = np.int64((np.int64(2046) - np.int64(bits)) << np.int64(52)).view(np.float64)  # 2^-k
    f = (total * scale - 1.0) + (x - (total - 1.0)) * scale
    r = f / (2.0 + f)
    square = r * r
    series = ODD_SERIES[6]
    series = series * square + ODD_SERIES[5]
    series = series * square + ODD_SERIES[4]
    series = series * square + ODD_SERIES[3]
    series = series * square + ODD_SERIES[2]
    series = series * square + ODD_SERIES[1]
    series = series * square + ODD_SERIES[0]
    return k, f, r, series * square


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def packed_log1p(x):
    """Return log(1 + x), without branches."""
    k, f, r, series = logarithm_parts(x)
    return k * LOG_2_HIGH + (f - (f * r - 2.0 * r * series - k * LOG_2_LOW))


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def packed_x_minus_log1p(x, log):
    """Return x - log(1 + x), without branches; `log`, which is log(1 + x), is not used."""
    k, f, r, series = logarithm_parts(x)
    return ((x - f) - k * LOG_2_HIGH) + (f * r - 2.0 * r * series - k * LOG_2_LOW)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def packed_log1p_minus_ratio(x, log):
    """Return log(1 + x) - x/(1 + x), without branches; `log`, which is log(1 + x), is not used."""
    k, f, r, series = logarithm_parts(x)
    rest = ((f - x) + r * f * (1.0 + x)) / ((1.0 + f) * (1.0 + x))
    return k * LOG_2_HIGH + (rest + 2.0 * r * series + k * LOG_2_LOW)
