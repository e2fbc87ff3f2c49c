"""Cells of tables, and cubics on them in Hermite's form.

Splines with two continuous derivatives, and monotone ones, are such cubics alike; they differ in their slopes.
"""

from numba import njit


@njit(error_model="numpy", forceinline=True)
def cell_of(numbers, first, count, x):
    """How many of `count` ascending breakpoints, in `numbers` from `first` on, come before the cell of x."""
    below, cells = first, count - 1
    while cells > 1:
        half = cells >> 1
        if numbers[below + half] <= x:
            below += half
        cells -= half
    return below - first


@njit(error_model="numpy", forceinline=True)
def cubic(f, df, f1, df1, x, length):
    """Return value and three derivatives, at x from its beginning, of the cubic with these values and slopes."""
    s, slope, slope1, rise = x / length, df * length, df1 * length, f1 - f
    second, third = 3.0 * rise - 2.0 * slope - slope1, slope + slope1 - 2.0 * rise
    return (
        f + s * (slope + s * (second + s * third)),
        (slope + s * (2.0 * second + 3.0 * s * third)) / length,
        (2.0 * second + 6.0 * s * third) / (length * length),
        6.0 * third / (length * length * length),
    )


@njit(error_model="numpy", forceinline=True)
def line(f, f1, x, length):
    """Return value and slope, at x from its beginning, of the straight line with given values at its ends."""
    slope = (f1 - f) / length
    return f + slope * x, slope


@njit(error_model="numpy", forceinline=True)
def within(numbers, first, count, x):
    """What is nearest to x between the first and the last breakpoint, and 1, or 0 where that is not x itself."""
    least, greatest = numbers[first], numbers[first + count - 1]
    if x < least:
        return least, 0.0
    if x > greatest:
        return greatest, 0.0
    return x, 1.0
