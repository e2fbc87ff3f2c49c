"""How large unknowns and equations are: the units in which a problem is solved, whatever those of its numbers are.

Every kind of unknown (a coordinate at all nodes, a control on all intervals, ...) has one size, taken from its guess,
which contains prescribed values, and from its bounds, or found from the equations (`measured_sizes`). Equations are
divided by the largest product of a derivative and a size, and the cost by how much it changes at most when all unknowns
of one kind change by their size.

Sizes are rounded, since no more is known of them than their magnitude: to powers of a million where that makes all of
them ordinary numbers, and else, as a whole, to powers of a thousand, those of single unknowns to powers of a hundred as
well, and so is the cost where its first derivatives decide. So problems in ordinary numbers are solved as they are, and
a change of units by a power of a million changes nothing but the sizes.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.stand_ins.example import END_SHARED, END_TIED, SHARED, START_SHARED, START_TIED, STRIDE, TIED
from codegen.runtime.optimise.derivative_magnitudes import KIND_IS_MULTIPLIER, KINDS
from codegen.runtime.optimise.measured_sizes import GIVEN, LARGE, SMALL, find_sizes, fit_bounds

LEAST = 1e-150  # what is below, or above its inverse, is no size

# Which kinds are a single unknown, such as a free duration, that no node equals.
IS_SINGLE = ~KIND_IS_MULTIPLIER & (np.arange(KINDS) >= STRIDE)
if TIED:
    IS_SINGLE[STRIDE + START_SHARED] = False
    IS_SINGLE[STRIDE + END_SHARED] = False


@njit(cache=True, error_model="numpy")
def fill_sizes(primal, inside, slopes, lower, upper, kinds, steps, h, nodes, parameters, sizes):
    """Fill in the `sizes` (n,) of all unknowns; return the weight of the cost, and whether any differs from one.

    `primal` (n,) are the unknowns without their multipliers, `inside` (n,) the same inside the bounds `lower` and
    `upper`, which are (n,) or empty, and `slopes` (n,) the moduli of the gradient of the Lagrangian, the lesser of
    both; `kinds` (n,) are those of the unknowns, `nodes` (N + 1,), `parameters` (BODIES, P + SHARED).
    """
    size, rest = zero_vector(KINDS), zero_vector(KINDS)
    for i in range(kinds.size):
        if KIND_IS_MULTIPLIER[kinds[i]]:
            rest[kinds[i]] = max(rest[kinds[i]], slopes[i])
        else:
            size[kinds[i]] = max(size[kinds[i]], abs(primal[i]))
    bound, between = fit_bounds(lower, upper, kinds, size)
    tables = find_sizes(
        primal, inside, lower, upper, kinds, steps, h, nodes, parameters, rest, bound, between, size
    )  # fmt: skip
    for j in range(KINDS):
        size[j] = max(size[j], bound[j])
    if TIED:
        equate_tied(size)
    for i in range(KINDS):
        if KIND_IS_MULTIPLIER[i]:
            size[i] = size_of_equation(i, size, tables[0])
            if size[i] == 0.0:
                size[i] = rest[i]  # which is flat at the guess
    if TIED:
        equate_tied(size)
    digits = digits_of(size)
    slope, curvature = slope_of_cost(slopes, kinds, size), curvature_of_cost(size, tables[2])
    is_steep = slope >= curvature  # then first steps follow the slope, and could throw unknowns onto bounds
    weight = 1.0 / rounded(max(slope, curvature), digits if is_steep else 6.0, is_steep)
    is_scaled = weight != 1.0
    for i in range(KINDS):
        if not GIVEN[i] > 0.0:
            size[i] = rounded(size[i], digits, IS_SINGLE[i])
        is_scaled = is_scaled or size[i] != 1.0
        if KIND_IS_MULTIPLIER[i]:
            size[i] = 1.0 / (size[i] * weight)
    for i in range(kinds.size):
        sizes[i] = size[kinds[i]]
    return weight, is_scaled


@njit(error_model="numpy")
def digits_of(size):
    """How many powers of ten sizes are apart: six where all are ordinary, but for powers of a million, else three."""
    for i in range(KINDS):
        if LEAST < size[i] < 1.0 / LEAST and not GIVEN[i] > 0.0:
            above = np.log10(size[i]) - SMALL
            if above - 6.0 * np.floor(above / 6.0) > LARGE - SMALL:
                return 3.0
    return 6.0


@njit(error_model="numpy")
def rounded(value, digits, finer):
    """The highest power of a million (`digits` are six) or a thousand below some thirty sizes, or one without a size.

    `finer` has 1, 100 and 10000 times a power of a million in place of powers of a thousand.
    """
    if not LEAST < value < 1.0 / LEAST:
        return 1.0
    above = np.log10(value) - SMALL
    if finer and digits == 3.0:
        million = np.floor(above / 6.0)
        above -= 6.0 * million
        return 10.0 ** (6.0 * million + (0.0 if above < 3.0 else 2.0 if above < 5.0 else 4.0))
    return 10.0 ** (digits * np.floor(above / digits))


@njit(error_model="numpy")
def size_of_equation(row, size, slopes):
    """The largest product of a derivative of an equation and the size of an unknown."""
    largest = 0.0
    for j in range(KINDS):
        if not KIND_IS_MULTIPLIER[j]:
            largest = max(largest, slopes[row, j] * size[j])
    return largest


if TIED:

    @njit(error_model="numpy")
    def equate_tied(size):
        """Give unknowns at the ends and the shared ones that they equal one size, the largest."""
        for _ in range(SHARED):
            for i in range(START_SHARED.size):
                level(START_TIED[i], STRIDE + START_SHARED[i], size)
            for i in range(END_SHARED.size):
                level(END_TIED[i], STRIDE + END_SHARED[i], size)

    @njit(error_model="numpy")
    def level(one, other, size):
        """Give two kinds the larger one of their sizes."""
        size[one] = size[other] = max(size[one], size[other])


@njit(error_model="numpy")
def slope_of_cost(slopes, kinds, size):
    """By how much the cost changes, at most, when all unknowns of one kind change by its size, by first derivatives.

    It does not depend on the number of intervals as the share of a single one does.
    """
    largest, total = 0.0, zero_vector(KINDS)
    for i in range(kinds.size):
        if not KIND_IS_MULTIPLIER[kinds[i]]:
            total[kinds[i]] += slopes[i]
    for i in range(KINDS):
        largest = max(largest, total[i] * size[i])
    return largest


@njit(error_model="numpy")
def curvature_of_cost(size, curvature):
    """The same by second derivatives: what controls cost is often flat at the guess."""
    largest = 0.0
    for i in range(KINDS):
        for j in range(KINDS):
            largest = max(largest, curvature[i, j] * size[i] * size[j])
    return largest
