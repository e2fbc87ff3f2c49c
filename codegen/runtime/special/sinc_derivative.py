"""The derivatives of sin(x)/x, also where quotients lose their digits.

Near zero they are summed as power series; elsewhere x s_n = sin(x + n pi/2) - n s_(n-1), which follows from n
derivatives of x s(x) = sin(x), gives one from the other.
"""

import math

from numba import njit


@njit(cache=True, error_model="numpy")
def sinc_derivative(n, x):
    """Return the derivative number n >= 0 of sin(x)/x, which is one at x = 0."""
    if abs(x) < 2.0 + 0.5 * n:
        return sinc_series(n, x)
    value = math.sin(x) / x
    for k in range(1, n + 1):
        turned = math.cos(x) if k % 2 else math.sin(x)
        value = ((turned if k % 4 < 2 else -turned) - k * value) / x
    return value


@njit(cache=True, error_model="numpy")
def sinc_series(n, x):
    """Sum of (-1)^j x^(2j - n)/((2j + 1) (2j - n)!) over 2j >= n."""
    j = (n + 1) // 2
    power, total, before = x if n % 2 else 1.0, 0.0, 1.0
    sign = -1.0 if j % 2 else 1.0
    while total != before:
        before = total
        total += sign * power / (2 * j + 1)
        j += 1
        power *= x * x / ((2 * j - n - 1.0) * (2 * j - n))
        sign = -sign
        if x == 0.0:
            break
    return total
