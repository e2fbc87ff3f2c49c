"""Sizes of the kinds of unknowns that the guess tells none of: found where they matter in the equations.

A coordinate at all nodes, a control on all intervals, ... is a kind each. What is zero at the guess, and unbounded, has
a size such that it matters in the equations: each row of their Jacobian at the guess is applied to motions of the known
sizes which are constant, linear and quadratic in time, and the unknown balances the result. So v = x' has the size of x
divided by the duration. An angle so found is one radian at most: a sine tells no more apart. What has no effect on any
equation at the guess, such as the rate of a reaction between substances that are not there yet, or the slack of a
condition in squares, is looked at beside it, where all that has a size differs by a part of it. Where a size that was
so found is no ordinary number, a rate may be flat at the guess, as those that a substrate inhibits are while there is
much of it: then a motion of a tenth of all values tells whether it has to be far larger.

Of n unknowns of K kinds, `primal`, `inside`, `lower` and `upper`, which may be empty, and `kinds` are (n,); `size`,
`known`, `rest`, `bound` and `between` are (K,), zero where there is none; the tables of derivatives are (3, K, K), and
`effect` (K, K) is the second of them.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_matrix, zero_vector
from codegen.runtime.unknowns.coupling import add_coupling_matrix
from codegen.runtime.stand_ins.example import COUPLINGS, INEQUALITIES, ROOT, SHARED, STRIDE, metadata
from codegen.runtime.optimise.derivative_magnitudes import KIND_IS_MULTIPLIER, KINDS, add_entry, measure_intervals

SMALL, LARGE = -1.5, 2.9  # ordinary sizes are between these powers of ten, which are no round numbers by intention
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
IS_SLACK = np.array([metadata["meanings"].get(name, "").startswith("slack of ") for name in NAMES])


@njit(error_model="numpy")
def find_sizes(
    primal, inside, lower, upper, kinds, steps, h, nodes, parameters, rest, bound, between, size
):  # fmt: skip
    """Find what has no `size` yet, and return the tables of `measure_intervals` at the guess.

    Each look measures derivatives somewhere: at the guess, inside its bounds, beside it while it says nothing of some,
    and where all is less while it says something odd. `bound` becomes zero for what has a size of its own.
    """
    at_guess, looks_farther, tables = 1, False, np.zeros((3, KINDS, KINDS))
    if INEQUALITIES and differ(inside, primal):
        at_guess = 2
    known, before, where = zero_vector(KINDS), zero_vector(KINDS), primal
    for look in range(at_guess + ROUNDS + 1):
        here = np.zeros((3, KINDS, KINDS))
        measure_intervals(where, steps, h, nodes, parameters, here)  # once in this text: it takes long to compile
        if look < at_guess:
            if INEQUALITIES and look == 1:
                lessen(tables, here)
            else:
                tables = here
            where = inside
            if INEQUALITIES and look + 1 < at_guess:
                continue
            if COUPLINGS:
                add_coupling_entries(inside, parameters, kinds, tables)
            drop_negligible_sizes(size, between, tables[1])
            for j in range(KINDS):
                if GIVEN[j] > 0.0:
                    size[j] = GIVEN[j]
                known[j] = size[j] if size[j] > 0.0 else 0.0
                bound[j] = 0.0 if known[j] > 0.0 else bound[j]
            here = tables
        elif not is_finite(here[1]):
            break
        if looks_farther:
            for j in range(KINDS):
                before[j] = size[j]
                size[j] = known[j]
        balance_sizes(size, rest, here[1])
        limit_angles(size, known)
        if looks_farther:
            for j in range(KINDS):
                size[j] = size[j] if size[j] > FAR_LARGER * before[j] else before[j]
            break
        if lacks_sizes(size, bound) and look < at_guess + ROUNDS - 1:
            where = displaced(inside, lower, upper, kinds, size)
        elif has_odd_sizes(size, known):
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
def limit_angles(size, known):
    """Let sizes that were found, and not known, be one radian at most."""
    for j in range(KINDS):
        if known[j] == 0.0:
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
def has_odd_sizes(size, known):
    """Whether sizes that were found, and not known, are beyond those of ordinary numbers."""
    found = False
    for j in range(KINDS):
        is_odd = size[j] > 0.0 and not 10.0**SMALL <= size[j] <= 10.0**LARGE
        found = found or (is_odd and known[j] == 0.0)
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


if INEQUALITIES:

    @njit(error_model="numpy")
    def differ(one, other):
        """Whether two vectors (n,) differ. This and the next two are loops, which are compiled ten times as fast."""
        found = False
        for i in range(one.size):
            found = found or one[i] != other[i]
        return found

    @njit(error_model="numpy")
    def lessen(tables, others):
        """Give the entries of `tables` (3, K, K) the lesser value of both, or the one that is a number."""
        for i in range(3):
            for j in range(KINDS):
                for k in range(KINDS):
                    if others[i, j, k] < tables[i, j, k] or np.isnan(tables[i, j, k]):
                        tables[i, j, k] = others[i, j, k]


@njit(error_model="numpy")
def is_finite(matrix):
    """Whether all entries of a matrix (K, K) are numbers."""
    found = True
    for i in range(KINDS):
        for j in range(KINDS):
            found = found and abs(matrix[i, j]) < np.inf
    return found
