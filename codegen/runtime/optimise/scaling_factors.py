"""How large unknowns and equations are: the units in which a problem is solved, whatever those of its numbers are.

Every kind of unknown (a coordinate at all nodes, a control on all intervals, ...) has one size, taken from its guess,
which contains prescribed values, and from its bounds. What is zero there, and unbounded, has a size such that it
matters in the equations: each row of their Jacobian at the guess is applied to motions of the known sizes which are
constant, linear and quadratic in time, and the unknown balances the result. So v = x' has the size of x divided by the
duration. An angle so found is one radian at most: a sine tells no more apart. What has no effect on any equation at the
guess, such as the rate of a reaction between substances that are not there yet, or the slack of a condition in squares,
is looked at beside it, where all that has a size differs by a part of it. Where a size that was so found is no ordinary
number, a rate may be flat at the guess, as those that a substrate inhibits are while there is much of it: then a motion
of a tenth of all values tells whether it has to be far larger. Equations are divided by the largest product
of a derivative and a size, and the cost by how much it changes at most when all unknowns of one kind change by their
size.

Sizes are rounded, since no more is known of them than their magnitude: to powers of a million where that makes all of
them ordinary numbers, and else, as a whole, to powers of a thousand, those of single unknowns to powers of a hundred as
well, and so is the cost where its first derivatives decide. So problems in ordinary numbers are solved as they are, and
a change of units by a power of a million changes nothing but the sizes.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_matrix, zero_vector
from codegen.runtime.unknowns.coupling import add_coupling_matrix
from codegen.runtime.stand_ins.example import (
    COUPLINGS,
    END_SHARED,
    END_TIED,
    INEQUALITIES,
    ROOT,
    SHARED,
    START_SHARED,
    START_TIED,
    STRIDE,
    TIED,
    metadata,
)
from codegen.runtime.optimise.derivative_magnitudes import KIND_IS_MULTIPLIER, KINDS, add_entry, measure_intervals

SMALL, LARGE = -1.5, 2.9  # ordinary sizes are between these powers of ten, which are no round numbers by intention
LEAST = 1e-150  # what is below, or above its inverse, is no size
LOOSE = 0.3  # a guess below this part of two bounds says little about the size of an unknown
NEGLIGIBLE = 1e-6  # the same beside the other terms of every equation
BESIDE = 0.1  # part of all sizes by which unknowns differ from the guess where it says nothing of some
ROUNDS = 4  # how often they do, each time with the sizes found before
LESSENED = 0.1  # part of all values at which rates that are flat at the guess may be steep
FAR_LARGER = 1e3  # times as large are sizes that are found there because the guess is flat, and not by their powers

# Sizes that the problem states, zero where it states none; free parameters are the last of the shared unknowns.
NAMES = *metadata["node"], *metadata["interval"], *[""] * (SHARED - len(metadata["free_parameters"]))
NAMES = *NAMES, *metadata["free_parameters"], *[""] * COUPLINGS
SCALE = metadata.get("scale", {})
GIVEN = np.array([SCALE.get(name, 0.0) for name in NAMES])
# One radian of an angle, which is all that a sine tells apart, and infinity for all else.
RADIAN = np.array([metadata.get("angles", {}).get(name, np.inf) for name in NAMES])
# Which kinds are a single unknown, such as a free duration, that no node equals.
IS_SINGLE = ~KIND_IS_MULTIPLIER & (np.arange(KINDS) >= STRIDE)
if TIED:
    IS_SINGLE[STRIDE + START_SHARED] = False
    IS_SINGLE[STRIDE + END_SHARED] = False
IS_SLACK = np.array([metadata["meanings"].get(name, "").startswith("slack of ") for name in NAMES])


@njit(cache=True, error_model="numpy")
def fill_sizes(primal, inside, slopes, lower, upper, kinds, steps, h, nodes, parameters, sizes):
    """Fill in the size of every unknown; return the weight of the cost, and whether any differs from one.

    `primal` are the unknowns without their multipliers, `inside` the same inside the bounds, and `slopes` the moduli of
    the gradient of the Lagrangian, the lesser of both.
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
def find_sizes(
    primal, inside, lower, upper, kinds, steps, h, nodes, parameters, rest, bound, between, size
):  # fmt: skip
    """Find what has no `size` yet, and return the tables of `measure_intervals` at the guess.

    Each look measures derivatives somewhere: at the guess, inside its bounds, beside it while it says nothing of some,
    and where all is less while it says something odd. `bound` becomes zero for what has a size of its own.
    """
    at_guess, looks_farther, tables = 1, False, np.zeros((3, KINDS, KINDS))
    if INEQUALITIES and (inside != primal).any():
        at_guess = 2
    is_known, before, where = np.zeros(KINDS, np.bool_), zero_vector(KINDS), primal
    for look in range(at_guess + ROUNDS + 1):
        here = np.zeros((3, KINDS, KINDS))
        measure_intervals(where, steps, h, nodes, parameters, here)  # once in this text: it takes long to compile
        if look < at_guess:
            tables = here if look == 0 else np.fmin(tables, here)
            where = inside
            if look + 1 < at_guess:
                continue
            if COUPLINGS:
                add_coupling_entries(inside, parameters, kinds, tables)
            drop_negligible_sizes(size, between, tables[1])
            for j in range(KINDS):
                if GIVEN[j] > 0.0:
                    size[j] = GIVEN[j]
                is_known[j] = size[j] > 0.0
                bound[j] = 0.0 if is_known[j] else bound[j]
            here = tables
        elif not np.isfinite(here[1]).all():
            break
        if looks_farther:
            for j in range(KINDS):
                before[j] = size[j]
                size[j] = size[j] if is_known[j] else 0.0
        balance_sizes(size, rest, here[1])
        limit_angles(size, is_known)
        if looks_farther:
            for j in range(KINDS):
                size[j] = size[j] if size[j] > FAR_LARGER * before[j] else before[j]
            break
        if lacks_sizes(size, bound) and look < at_guess + ROUNDS - 1:
            where = displaced(inside, lower, upper, kinds, size)
        elif has_odd_sizes(size, is_known):
            where, looks_farther = with_lessened_values(inside, lower, upper, kinds), True
        else:
            break
    return tables


if COUPLINGS:

    @njit(error_model="numpy")
    def add_coupling_entries(unknowns, parameters, kinds, tables):
        """Add the derivatives of conditions between bodies."""
        matrix, first = zero_matrix(ROOT, ROOT), kinds.size - ROOT
        add_coupling_matrix(unknowns, parameters[0], 1.0, matrix)
        for i in range(ROOT):
            for j in range(i + 1):
                add_entry(kinds[first + i], kinds[first + j], abs(matrix[i, j]), tables)


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
def fit_bounds(lower, upper, kinds, size):
    """Make sizes fit the largest finite bound, where there is one on either side: no less than a part of it.

    Return the largest of other bounds, where there are no such: the least sizes of what has none otherwise; and the
    largest of bounds on either side. Bounds of slacks say nothing about their size.
    """
    bound, between = zero_vector(KINDS), zero_vector(KINDS)
    for i in range(lower.size):
        if IS_SLACK[kinds[i]]:
            continue
        below, above = abs(lower[i]), abs(upper[i])
        if max(below, above) < np.inf:
            between[kinds[i]] = max(between[kinds[i]], below, above)
        elif min(below, above) < np.inf:
            bound[kinds[i]] = max(bound[kinds[i]], min(below, above))
    for j in range(KINDS):
        if between[j] > 0.0 and size[j] > 0.0:
            size[j] = min(max(size[j], LOOSE * between[j]), between[j])
        elif size[j] == 0.0:
            size[j] = between[j]
    return bound, between


@njit(error_model="numpy")
def drop_negligible_sizes(size, between, effect):
    """Take away sizes that are negligible in all equations: a guess of zero, or a slack's, may be one of rounding.

    Those that lie between two bounds are what these say. Others keep their size: a duration has no effect but rounding
    where the guess is at rest.
    """
    for j in range(KINDS):
        least = np.inf
        for i in range(KINDS):
            others = 0.0
            for k in range(KINDS):
                if k != j:
                    others = max(others, effect[i, k] * size[k])
            if effect[i, j] > 0.0:
                least = min(least, others / effect[i, j])
        may_be_rounding = IS_SLACK[j] or size[j] < NEGLIGIBLE
        if may_be_rounding and between[j] == 0.0 and least < np.inf and size[j] < NEGLIGIBLE * least:
            size[j] = 0.0


@njit(error_model="numpy")
def balance_sizes(size, rest, effect):
    """Give unknowns without a size the least one with which they balance an equation, until nothing is new."""
    for _ in range(KINDS):
        found, is_new = zero_vector(KINDS), False
        for i in range(KINDS):
            known = rest[i]
            for j in range(KINDS):
                known = max(known, effect[i, j] * size[j])
            for j in range(KINDS):
                if size[j] == 0.0 and effect[i, j] > 0.0 and known > 0.0:
                    balancing = known / effect[i, j]
                    found[j] = balancing if found[j] == 0.0 else min(found[j], balancing)
                    is_new = True
        if not is_new:
            return
        for j in range(KINDS):
            if size[j] == 0.0:
                size[j] = found[j]


@njit(error_model="numpy")
def limit_angles(size, is_known):
    """Let sizes that were found, and not known, be one radian at most."""
    for j in range(KINDS):
        if not is_known[j]:
            size[j] = min(size[j], RADIAN[j])


@njit(error_model="numpy")
def lacks_sizes(size, bound):
    """Whether there are unknowns without a size, and without a bound to stand for it."""
    found = False
    for j in range(KINDS):
        found = found or (size[j] == bound[j] == 0.0 and not KIND_IS_MULTIPLIER[j])
    return found


@njit(error_model="numpy")
def displaced(primal, lower, upper, kinds, size):
    """Unknowns that differ from the guess by a part of their sizes, upwards where a bound does not forbid it."""
    beside = primal.copy()
    for i in range(kinds.size):
        if not KIND_IS_MULTIPLIER[kinds[i]]:
            by = BESIDE * size[kinds[i]]
            if lower.size and beside[i] + by > upper[i]:
                by = max(-by, lower[i] - beside[i])
            beside[i] += by
    return beside


@njit(error_model="numpy")
def has_odd_sizes(size, is_known):
    """Whether sizes that were found, and not known, are beyond those of ordinary numbers."""
    found = False
    for j in range(KINDS):
        is_odd = size[j] > 0.0 and not 10.0**SMALL <= size[j] <= 10.0**LARGE
        found = found or (is_odd and not is_known[j])
    return found


@njit(error_model="numpy")
def with_lessened_values(primal, lower, upper, kinds):
    """A part of all unknowns but the shared ones, such as durations, inside their bounds."""
    lessened = primal.copy()
    for i in range(kinds.size):
        if kinds[i] < STRIDE:
            lessened[i] *= LESSENED
            if lower.size:
                lessened[i] = min(max(lessened[i], lower[i]), upper[i])
    return lessened


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
