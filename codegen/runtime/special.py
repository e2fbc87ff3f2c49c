"""Functions that Python does not have: the polygamma functions, and the derivatives of sin(x)/x.

The polygamma functions are digamma psi(x) = (log gamma(x))' and its derivatives. The recurrence
psi_n(x) = psi_n(x + 1) - (-1)^n n!/x^(n + 1) leads to large arguments, where the asymptotic series has full accuracy.
Source: Abramowitz and Stegun (1972), 6.4.6 and 6.4.11.

The derivatives s_n of s(x) = sin(x)/x lose digits near zero if they are computed as quotients. Near zero they are
therefore sums of power series. Elsewhere they follow from x s_n = sin(x + n pi/2) - n s_(n-1), one after the other.
This recurrence is the derivative number n of x s(x) = sin(x).
"""

import math

from numba import njit

BERNOULLI = (1 / 6, -1 / 30, 1 / 42, -1 / 30, 5 / 66, -691 / 2730, 7 / 6, -3617 / 510, 43867 / 798, -174611 / 330)

FARTHEST = -1e4  # least argument of the polygamma functions: the recurrence takes about as many steps


@njit(cache=True, error_model="numpy")
def polygamma(n, x):
    """Return the derivative of order n >= 0 of the digamma function at x.

    The value is infinite at the poles 0, -1, ..., and NaN below FARTHEST.
    """
    if x < FARTHEST:
        return math.nan
    factorial, total = math.gamma(n + 1.0), 0.0
    sign = -1.0 if n % 2 == 0 else 1.0
    while x < 15.0 + n:
        total += sign * factorial / x ** (n + 1)
        x += 1.0
    if n == 0:
        return total + math.log(x) - 0.5 / x - asymptotic_sum(n, x)
    return total + sign * (factorial / (n * x**n) + 0.5 * factorial / x ** (n + 1) + asymptotic_sum(n, x))


@njit(cache=True, error_model="numpy")
def asymptotic_sum(n, x):
    """Return the sum of B_2k (2k + n - 1)!/((2k)! x^(2k + n)) over k = 1, 2, ..."""
    total, factor = 0.0, math.gamma(n + 2.0) / (2.0 * x ** (n + 2))
    for k in range(1, len(BERNOULLI) + 1):
        total += BERNOULLI[k - 1] * factor
        factor *= (2 * k + n) * (2 * k + n + 1) / ((2 * k + 1) * (2 * k + 2) * x * x)
    return total


@njit(cache=True, error_model="numpy")
def sinc_derivative(n, x):
    """Return the derivative of order n >= 0 of sin(x)/x at x, with sin(0)/0 = 1."""
    if abs(x) < 2.0 + 0.5 * n:
        return sinc_series(n, x)
    value = math.sin(x) / x
    for k in range(1, n + 1):
        turned = math.cos(x) if k % 2 else math.sin(x)
        value = ((turned if k % 4 < 2 else -turned) - k * value) / x
    return value


@njit(cache=True, error_model="numpy")
def sinc_series(n, x):
    """Return the derivative of order n of sin(x)/x by its power series.

    The series is the sum of (-1)^j x^(2j - n)/((2j + 1) (2j - n)!) over 2j >= n.
    """
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
