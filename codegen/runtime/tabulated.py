"""Numbers behind the parameters, in kernels: tables of one or two inputs, and values at inner times.

A table of one input has `count` breakpoints from `first` on, then at each of them the value, and the slope for cubics.
It returns the value and three derivatives. A table of two inputs has `rows` breakpoints of x and `columns` of y. Then,
at each pair with y running fastest, it has the value, and for cubics the slopes by x and by y and the mixed second
derivative. It returns f, f_x, f_y, f_xx, f_xy, f_yy, f_xxx, f_xxy, f_xyy, f_yyy. Splines with two continuous
derivatives, and monotone ones, are both cubics in Hermite's form and differ in their slopes.
"""

import numpy as np
from numba import njit


@njit(error_model="numpy", forceinline=True)
def cell_of(numbers, first, count, x):
    """Return how many of `count` ascending breakpoints, in `numbers` from `first` on, come before the cell of x."""
    below, cells = first, count - 1
    while cells > 1:
        half = cells >> 1
        if numbers[below + half] <= x:
            below += half
        cells -= half
    return below - first


@njit(error_model="numpy", forceinline=True)
def cubic(f, df, f1, df1, x, length):
    """Return value and three derivatives of the cubic with these end values and slopes, at x from its beginning."""
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
    """Return value and slope of the straight line with these end values, at x from its beginning."""
    slope = (f1 - f) / length
    return f + slope * x, slope


@njit(error_model="numpy", forceinline=True)
def within(numbers, first, count, x):
    """Return the nearest point to x between the first and the last breakpoint, and 1 if that is x, else 0."""
    least, greatest = numbers[first], numbers[first + count - 1]
    if x < least:
        return least, 0.0
    if x > greatest:
        return greatest, 0.0
    return x, 1.0


@njit(error_model="numpy", forceinline=True)
def cubic_curve(numbers, first, count, x):
    """Evaluate cubics; the outermost cubics continue outside the breakpoints."""
    i = cell_of(numbers, first, count, x)
    left, at = numbers[first + i], first + count + 2 * i
    return cubic(
        numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3], x - left, numbers[first + i + 1] - left
    )


@njit(error_model="numpy", forceinline=True)
def linear_curve(numbers, first, count, x):
    """Evaluate straight lines; the outermost lines continue outside the breakpoints."""
    i = cell_of(numbers, first, count, x)
    left, at = numbers[first + i], first + count + i
    f, slope = line(numbers[at], numbers[at + 1], x - left, numbers[first + i + 1] - left)
    return f, slope, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def steps_curve(numbers, first, count, x):
    """Return the value at the last breakpoint up to x, or at the first breakpoint."""
    i = cell_of(numbers, first, count, x) if x < numbers[first + count - 1] else count - 1
    return numbers[first + count + i], 0.0, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def clamped_curve(inside, f, f_1, f_11, f_111):
    """Return value and derivatives; derivatives are zero where `inside` is 0; all are scalars."""
    return f, inside * f_1, inside * f_11, inside * f_111


@njit(error_model="numpy", forceinline=True)
def cubic_surface(numbers, first, rows, columns, x, y):
    """Evaluate products of cubics; the outermost cubics continue outside the grid."""
    i, j = cell_of(numbers, first, rows, x), cell_of(numbers, first + rows, columns, y)
    left, below = numbers[first + i], numbers[first + rows + j]
    across, up = x - left, y - below
    width, height = numbers[first + i + 1] - left, numbers[first + rows + j + 1] - below
    at = first + rows + columns + 4 * (i * columns + j)
    beyond = at + 4 * columns
    a, a_y, a_yy, a_yyy = cubic(numbers[at], numbers[at + 2], numbers[at + 4], numbers[at + 6], up, height)
    s, s_y, s_yy, s_yyy = cubic(numbers[at + 1], numbers[at + 3], numbers[at + 5], numbers[at + 7], up, height)
    b, b_y, b_yy, b_yyy = cubic(
        numbers[beyond], numbers[beyond + 2], numbers[beyond + 4], numbers[beyond + 6], up, height
    )
    r, r_y, r_yy, r_yyy = cubic(
        numbers[beyond + 1], numbers[beyond + 3], numbers[beyond + 5], numbers[beyond + 7], up, height
    )
    f, f_x, f_xx, f_xxx = cubic(a, s, b, r, across, width)
    f_y, f_xy, f_xxy, _ = cubic(a_y, s_y, b_y, r_y, across, width)
    f_yy, f_xyy, _, _ = cubic(a_yy, s_yy, b_yy, r_yy, across, width)
    f_yyy = cubic(a_yyy, s_yyy, b_yyy, r_yyy, across, width)[0]
    return f, f_x, f_y, f_xx, f_xy, f_yy, f_xxx, f_xxy, f_xyy, f_yyy


@njit(error_model="numpy", forceinline=True)
def linear_surface(numbers, first, rows, columns, x, y):
    """Evaluate products of straight lines; the outermost lines continue outside the grid."""
    i, j = cell_of(numbers, first, rows, x), cell_of(numbers, first + rows, columns, y)
    left, below = numbers[first + i], numbers[first + rows + j]
    across, up = x - left, y - below
    width, height = numbers[first + i + 1] - left, numbers[first + rows + j + 1] - below
    at = first + rows + columns + i * columns + j
    a, a_y = line(numbers[at], numbers[at + 1], up, height)
    b, b_y = line(numbers[at + columns], numbers[at + columns + 1], up, height)
    f, f_x = line(a, b, across, width)
    f_y, f_xy = line(a_y, b_y, across, width)
    return f, f_x, f_y, 0.0, f_xy, 0.0, 0.0, 0.0, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def clamped_surface(in_x, in_y, f, f_x, f_y, f_xx, f_xy, f_yy, f_xxx, f_xxy, f_xyy, f_yyy):
    """Return value and derivatives; derivatives by x, or y, are zero where `in_x`, or `in_y`, is 0."""
    both = in_x * in_y
    return (
        f, in_x * f_x, in_y * f_y, in_x * f_xx, both * f_xy, in_y * f_yy,
        in_x * f_xxx, both * f_xxy, both * f_xyy, in_y * f_yyy,
    )  # fmt: skip


def along(values, parameters, number, *at):
    """Return values of a table, or of its derivative of a number, at arrays that broadcast to one shape."""
    at = np.broadcast_arrays(*at)
    return values(parameters, number, *(np.ascontiguousarray(a, dtype=float).ravel() for a in at)).reshape(at[0].shape)


def table_numbers(problem, overrides):
    """Return the numbers of all tables, one after the other; `overrides` maps names of tables to other numbers.

    The numbers of a table, shape (n,), are breakpoints, then values. ValueError for an unknown table, for other numbers
    of breakpoints, and for breakpoints out of order.
    """
    overrides = overrides or {}
    for name in overrides:
        if name not in problem.tables:
            raise ValueError(f"there is no table {name!r}; there are: {', '.join(problem.tables)}")
    parts = []
    for name, default in problem.tables.items():
        numbers = overrides.get(name, default)
        if numbers is not default:
            numbers = np.array(numbers, dtype=float)
            if numbers.shape != default.shape:
                raise ValueError(
                    f"table {name} is of shape {numbers.shape}, and the module is made for {default.shape}"
                )
            if not np.isfinite(numbers).all():
                raise ValueError(f"table {name} has a number that is not finite")
            sizes = problem.metadata.tables[name].sizes
            for axis in np.split(numbers[: sum(sizes)], np.cumsum(sizes)[:-1]):
                if not (np.diff(axis) > 0.0).all():
                    raise ValueError(f"the breakpoints of table {name} do not ascend: {axis}")
        parts.append(numbers)
    return np.concatenate(parts)


@njit(error_model="numpy", forceinline=True)
def inner_number(parameters, first, count, number, t, h):
    """Return the number of the given index of the node at time t, before an interval of length h.

    Nodes at inner times have such numbers, other nodes have zeros. From `first` on `parameters` (P + SHARED,) hold
    the `count` inner times, then for every number its values at these times.
    """
    value = 0.0
    for i in range(first, first + count):
        value += parameters[i + (number + 1) * count] if abs(t - parameters[i]) < 1e-6 * h else 0.0
    return value
