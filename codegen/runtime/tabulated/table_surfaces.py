"""Tables of two inputs: value and derivatives up to the third order, from numbers behind the parameters.

From `first` on there are `rows` breakpoints of the first input x and `columns` of the second y, then at each pair, y
running fastest, the value, and where cubics need it the slope by x, that by y, and the mixed second derivative. What is
returned is f, f_x, f_y, f_xx, f_xy, f_yy, f_xxx, f_xxy, f_xyy, f_yyy.
"""

from numba import njit

from codegen.runtime.tabulated.table_cells import cell_of, cubic, line


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
