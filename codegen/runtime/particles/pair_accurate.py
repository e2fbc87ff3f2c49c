"""Sums of products to the last digit, for distances from a boundary that are small differences of large numbers.

Source: Ogita, Rump and Oishi (2005), Accurate sum and dot product, SIAM Journal on Scientific Computing 26, algorithm
5.3 (Dot2) with Veltkamp's and Dekker's product.
"""

from numba import njit


@njit(cache=True, error_model="numpy")
def accurate_dot(first, second):
    """Return the sum of first[k]*second[k], as if computed with twice the digits."""
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
    """Return the leading 26 bits of a number."""
    shifted = 134217729.0 * x
    return shifted - (shifted - x)
