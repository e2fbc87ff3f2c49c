"""Tables in kernels: splines through numbers that stand behind the parameters.

Cells of tables, and cubics on them in Hermite's form.

Splines with two continuous derivatives, and monotone ones, are such cubics alike; they differ in their slopes.

Tables of one input: value and three derivatives, from numbers behind the parameters.

From `first` on there are `count` breakpoints, then at each of them the value, and its slope where cubics need it.

Tables of two inputs: value and derivatives up to the third order, from numbers behind the parameters.

From `first` on there are `rows` breakpoints of the first input x and `columns` of the second y, then at each pair, y
running fastest, the value, and where cubics need it the slope by x, that by y, and the mixed second derivative. What is
returned is f, f_x, f_y, f_xx, f_xy, f_yy, f_xxx, f_xxy, f_xyy, f_yyy.

Tables in guesses, which are arrays.

The numbers of tables: those of the problem, or others instead.

Numbers of the nodes at inner times: each has one for every such time, and other nodes have zeros.
"""

import numpy as np
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


@njit(error_model="numpy", forceinline=True)
def cubic_curve(numbers, first, count, x):
    """Cubics; outside the breakpoints the outermost ones go on."""
    i = cell_of(numbers, first, count, x)
    left, at = numbers[first + i], first + count + 2 * i
    return cubic(
        numbers[at], numbers[at + 1], numbers[at + 2], numbers[at + 3], x - left, numbers[first + i + 1] - left
    )


@njit(error_model="numpy", forceinline=True)
def linear_curve(numbers, first, count, x):
    """Straight lines; outside the breakpoints the outermost ones go on."""
    i = cell_of(numbers, first, count, x)
    left, at = numbers[first + i], first + count + i
    f, slope = line(numbers[at], numbers[at + 1], x - left, numbers[first + i + 1] - left)
    return f, slope, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def steps_curve(numbers, first, count, x):
    """Return the value at the breakpoint before x, at the first one where there is none."""
    i = cell_of(numbers, first, count, x) if x < numbers[first + count - 1] else count - 1
    return numbers[first + count + i], 0.0, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def clamped_curve(inside, f, f_1, f_11, f_111):
    """Return the same where `inside` is 1; where it is 0, the value alone; scalars all."""
    return f, inside * f_1, inside * f_11, inside * f_111


@njit(error_model="numpy", forceinline=True)
def cubic_surface(numbers, first, rows, columns, x, y):
    """Products of cubics; outside the grid the outermost ones go on."""
    i, j = cell_of(numbers, first, rows, x), cell_of(numbers, first + rows, columns, y)
    left, below = numbers[first + i], numbers[first + rows + j]
    across, up, width, height = (
        x - left,
        y - below,
        numbers[first + i + 1] - left,
        numbers[first + rows + j + 1] - below,
    )
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
    """Products of straight lines; outside the grid the outermost ones go on."""
    i, j = cell_of(numbers, first, rows, x), cell_of(numbers, first + rows, columns, y)
    left, below = numbers[first + i], numbers[first + rows + j]
    across, up, width, height = (
        x - left,
        y - below,
        numbers[first + i + 1] - left,
        numbers[first + rows + j + 1] - below,
    )
    at = first + rows + columns + i * columns + j
    a, a_y = line(numbers[at], numbers[at + 1], up, height)
    b, b_y = line(numbers[at + columns], numbers[at + columns + 1], up, height)
    f, f_x = line(a, b, across, width)
    f_y, f_xy = line(a_y, b_y, across, width)
    return f, f_x, f_y, 0.0, f_xy, 0.0, 0.0, 0.0, 0.0, 0.0


@njit(error_model="numpy", forceinline=True)
def clamped_surface(in_x, in_y, f, f_x, f_y, f_xx, f_xy, f_yy, f_xxx, f_xxy, f_xyy, f_yyy):
    """Return the same where `in_x` and `in_y` are 1; where one of them is 0, without derivatives by that input."""
    both = in_x * in_y
    return (
        f, in_x * f_x, in_y * f_y, in_x * f_xx, both * f_xy, in_y * f_yy,
        in_x * f_xxx, both * f_xxy, both * f_xyy, in_y * f_yyy,
    )  # fmt: skip


def along(values, parameters, number, *at):
    """Return values of a table, or of its derivative of a number, at arrays that fit each other."""
    at = np.broadcast_arrays(*at)
    return values(parameters, number, *(np.ascontiguousarray(a, dtype=float).ravel() for a in at)).reshape(at[0].shape)


def table_numbers(problem, given):
    """Return the numbers of all tables, one after the other, of those in `given` as they stand there.

    ValueError for an unknown table, for other numbers of breakpoints, and for breakpoints out of order.
    """
    for name in given or {}:
        if name not in problem.tables:
            raise ValueError(f"there is no table {name!r}; there are: {', '.join(problem.tables)}")
    return np.concatenate(
        [checked_table(problem, name, (given or {}).get(name, own)) for name, own in problem.tables.items()]
    )


def checked_table(problem, name, numbers):
    """Return the numbers of a table, shape (n,): breakpoints, then what stands at them."""
    own, sizes = problem.tables[name], problem.metadata.tables[name].sizes
    if numbers is own:
        return own
    numbers = np.array(numbers, dtype=float)
    if numbers.shape != own.shape:
        raise ValueError(f"table {name} is of shape {numbers.shape}, and the module is made for {own.shape}")
    if not np.isfinite(numbers).all():
        raise ValueError(f"table {name} has a number that is not finite")
    for axis in np.split(numbers[: sum(sizes)], np.cumsum(sizes)[:-1]):
        if not (np.diff(axis) > 0.0).all():
            raise ValueError(f"the breakpoints of table {name} do not ascend: {axis}")
    return numbers


@njit(error_model="numpy", forceinline=True)
def inner_number(parameters, first, count, number, t, h):
    """Return the number of the given index of the node at time t, before an interval of length h.

    From `first` on `parameters` (P + SHARED,) hold the `count` inner times, then for every number its values at these.
    """
    found = 0.0
    for i in range(first, first + count):
        found += parameters[i + (number + 1) * count] if abs(t - parameters[i]) < 1e-6 * h else 0.0
    return found
