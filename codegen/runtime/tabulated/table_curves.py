"""Tables of one input: value and three derivatives, from numbers behind the parameters.

From `first` on there are `count` breakpoints, then at each of them the value, and its slope where cubics need it.
"""

from numba import njit

from codegen.runtime.tabulated.table_cells import cell_of, cubic, line


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
