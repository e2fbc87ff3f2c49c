"""Two differences of functions without cancellation of digits.

With r = x/(2 + x) the logarithm is log(1 + x) = 2 (r + r^3/3 + r^5/5 + ...), so that both differences are sums of terms
of one sign for small positive x. Source: Muller (2016), Elementary functions, section 4.3 (the series).
"""

from numba import njit


@njit(cache=True, error_model="numpy")
def x_minus_log1p(x, log):
    """X - log(1 + x), where `log` is log(1 + x)."""
    if abs(x) > 0.5:
        return x - log
    r = x / (2.0 + x)
    return x * r - 2.0 * r * odd_series(r * r)


@njit(cache=True, error_model="numpy")
def log1p_minus_ratio(x, log):
    """log(1 + x) - x/(1 + x), where `log` is log(1 + x)."""
    if abs(x) > 0.5:
        return log - x / (1.0 + x)
    r = x / (2.0 + x)
    return 2.0 * r * r / (1.0 + r) + 2.0 * r * odd_series(r * r)


@njit(cache=True, error_model="numpy")
def odd_series(s):
    """s/3 + s^2/5 + s^3/7 + ..., for 0 <= s <= 1/9, to the last digit."""
    total = 0.0
    for k in range(17, 0, -1):
        total = s * (total + 1.0 / (2 * k + 1))
    return total
