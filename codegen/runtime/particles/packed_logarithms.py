"""log(1 + x), and two differences that it makes, without branches and calls: for several numbers at once.

1 + x = 2^k (1 + f) with 1 + f between 1/sqrt(2) and sqrt(2), and with r = f/(2 + f)

    log(1 + f) = 2 atanh(r) = 2 r + 2 r S = f - f r + 2 r S,   S = r^2/3 + r^4/5 + ...,

where S/r^2 is a polynomial that interpolates the series in r^2 at Chebyshev points, with a relative error of 5e-16
(1.3e-17 of the logarithm). Where k = 0, f is x itself, and what would cancel is left out exactly. The C library's
functions are called for one number after the other. Source: Muller (2016), Elementary functions, chapters 4 and 11.
For numbers below 1e300; up to -1 there is no logarithm, and NaN.
"""

import numpy as np
from numba import njit

ODD_SERIES = (
    0.3333333333333335,
    0.1999999999994962,
    0.14285714313047945,
    0.1111110555757208,
    0.09091445278347801,
    0.0766583701508393,
    0.07308518774395825,
)
LOG_2_HIGH, LOG_2_LOW = (
    0.6931471803691238,
    1.9082149292705877e-10,
)  # the first has few digits, so that k times it is exact
ROOT_HALF, ONE = 0x3FE6A09E667F3BCD, 0x3FF0000000000000  # the bits of sqrt(1/2) and of 1.0
HUGE, HUGE_BITS = 4503599627370496.0, 0x4330000000000000  # 2^52 and its bits, to which smaller integers add


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def logarithm_parts(x):
    """Return the numbers k, f, r and S of 1 + x."""
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
    """Return log(1 + x)."""
    k, f, r, series = logarithm_parts(x)
    return k * LOG_2_HIGH + (f - (f * r - 2.0 * r * series - k * LOG_2_LOW))


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def packed_x_minus_log1p(x, log):
    """Return x - log(1 + x); `log`, which is log(1 + x), is not needed."""
    k, f, r, series = logarithm_parts(x)
    return ((x - f) - k * LOG_2_HIGH) + (f * r - 2.0 * r * series - k * LOG_2_LOW)


@njit(cache=True, error_model="numpy", fastmath={"contract"})
def packed_log1p_minus_ratio(x, log):
    """Return log(1 + x) - x/(1 + x); `log`, which is log(1 + x), is not needed."""
    k, f, r, series = logarithm_parts(x)
    rest = ((f - x) + r * f * (1.0 + x)) / ((1.0 + f) * (1.0 + x))
    return k * LOG_2_HIGH + (rest + 2.0 * r * series + k * LOG_2_LOW)
