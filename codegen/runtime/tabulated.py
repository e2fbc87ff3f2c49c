"""The numbers of a problem that follow its parameters, in kernels: tables of one or two inputs, values at inner times.

A table of one input has `count` breakpoints, which begin at index `first` of the numbers. Then follow, for each
breakpoint, the value, and for cubics also the slope. Functions of such a table return the value and three derivatives.

A table of two inputs has `rows` breakpoints of x and `columns` breakpoints of y. Then follows, for each pair with y
running fastest, the value. For cubics each value is followed by the slopes with respect to x and y, and by the mixed
second derivative. Functions of such a table return f, f_x, f_y, f_xx, f_xy, f_yy, f_xxx, f_xxy, f_xyy, f_yyy.

Splines with two continuous derivatives and monotone splines are both cubics in Hermite's form, with different slopes.
"""

import numpy as np
from numba import njit


@njit(error_model="numpy", forceinline=True)
def cell_of(numbers, first, count, x):
    """Return the index of the cell between breakpoints that contains x, or of the nearest cell.

    The `count` ascending breakpoints are in `numbers` and begin at index `first`.
    """
    below, cells = first, count - 1
    while cells > 1:
        half = cells >> 1
        if numbers[below + half] <= x:
            below += half
        cells -= half
    return below - first


@njit(error_model="numpy", forceinline=True)
def cubic(f, df, f1, df1, x, length):
    """Return the value and three derivatives of a cubic on an interval of the given length.

    `f` and `df` are value and slope at the beginning of the interval, `f1` and `df1` at its end. x is the distance from
    the beginning.
    """
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
    """Return value and slope of the straight line from `f` to `f1` on an interval, at distance x from its beginning."""
    slope = (f1 - f) / length
    return f + slope * x, slope


@njit(error_model="numpy", forceinline=True)
def within(numbers, first, count, x):
    """Return x, moved to the nearest breakpoint if outside, and 1.0 if x is inside, otherwise 0.0.

    The `count` ascending breakpoints are in `numbers` and begin at index `first`.
    """
    least, greatest = numbers[first], numbers[first + count - 1]
    if x < least:
        return least, 0.0
    if x > greatest:
        return greatest, 0.0
    return x, 1.0


@njit(error_model="numpy", forceinline=True)
def cubic_curve(numbers, first, count, x):
    """Return the value and three derivatives of a table with cubics at x.

    The table has `count` breakpoints and begins at index `first` of `numbers`. The outermost cubics continue outside
    the breakpoints.
    """
    i = cell_of(numbers, first, count, x)
    left, at = numbers[first + i], first + count + 2 * i
    return cubic(
        numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3], x - left, numbers[first + i + 1] - left
    )


@njit(error_model="numpy", forceinline=True)
def linear_curve(numbers, first, count, x):
    """Return the value and three derivatives of a table with straight lines at x.

    The table has `count` breakpoints and begins at index `first` of `numbers`. The outermost lines continue outside the
    breakpoints.
    """
    i = cell_of(numbers, first, count, x)
    left, at = numbers[first + i], first + count + i
    f, slope = line(numbers[at], numbers[at + 1], x - left, numbers[first + i + 1] - left)
    return f, slope, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def steps_curve(numbers, first, count, x):
    """Return the value of a table of a step function at x, and three zeros for its derivatives.

    The table has `count` breakpoints and begins at index `first` of `numbers`. Its value at x belongs to the last
    breakpoint up to x, or to the first breakpoint if x is below all breakpoints.
    """
    i = cell_of(numbers, first, count, x) if x < numbers[first + count - 1] else count - 1
    return numbers[first + count + i], 0.0, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def clamped_curve(inside, f, f_1, f_11, f_111):
    """Return the value and three derivatives of a table, with zero derivatives if `inside` is 0.

    `inside` is the second result of `within`. All arguments are numbers.
    """
    return f, inside * f_1, inside * f_11, inside * f_111


@njit(error_model="numpy", forceinline=True)
def cubic_surface(numbers, first, rows, columns, x, y):
    """Return the value and nine derivatives of a table with products of cubics at (x, y).

    The table has `rows` breakpoints of x and `columns` of y, and begins at index `first` of `numbers`. The outermost
    cubics continue outside the grid of breakpoints.
    """
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
    """Return the value and nine derivatives of a table with products of straight lines at (x, y).

    The table has `rows` breakpoints of x and `columns` of y, and begins at index `first` of `numbers`. The outermost
    lines continue outside the grid of breakpoints.
    """
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
    """Return value and nine derivatives of a table, with zero derivatives outside its range.

    Derivatives with respect to x are zero if `in_x` is 0, derivatives with respect to y if `in_y` is 0. Both are second
    results of `within`.
    """
    both = in_x * in_y
    return (
        f, in_x * f_x, in_y * f_y, in_x * f_xx, both * f_xy, in_y * f_yy,
        in_x * f_xxx, both * f_xxy, both * f_xyy, in_y * f_yyy,
    )  # fmt: skip


def along(values, parameters, number, *at):
    """Return the values of a table, or of its derivative with the index `number`, at arrays `at` of its inputs.

    The arrays broadcast to one shape. `values` is a function of the generated module: (parameters, number, flat arrays)
    -> flat array of values.
    """
    at = np.broadcast_arrays(*at)
    return values(parameters, number, *(np.ascontiguousarray(a, dtype=float).ravel() for a in at)).reshape(at[0].shape)


def table_numbers(problem, overrides):
    """Return the numbers of all tables, one table after the other, as one array.

    `overrides` maps names of tables to arrays that replace the default numbers. The numbers of a table, shape (n,), are
    breakpoints, then values. Raise ValueError for an unknown table, another shape, numbers that are not finite, and
    breakpoints that do not ascend.
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
    """Return the value with the index `number` that belongs to the inner time t, or zero if t is no inner time.

    t is the time of the node at the beginning of an interval of length h. The array `parameters` (P + shared,) holds
    `count` inner times from index `first` on. Then follow, for each number, the values at these times.
    """
    value = 0.0
    for i in range(first, first + count):
        value += parameters[i + (number + 1) * count] if abs(t - parameters[i]) < 1e-6 * h else 0.0
    return value
