"""How large unknowns and equations are: the units in which a problem is solved, whatever those of its numbers are.

Every kind of unknown (a coordinate at all nodes, a control on all intervals, ...) has one size, taken from its guess,
which contains prescribed values, and from its bounds. What is zero there, and unbounded, has a size such that it
matters in the equations: each row of their Jacobian at the guess is applied to motions of the known sizes which are
constant, linear and quadratic in time, and the unknown balances the result. So v = x' has the size of x divided by the
duration. Equations are divided by the largest product of a derivative and a size, and the cost by how much it changes
at most when one unknown changes by its size. A change of units then changes nothing but the sizes.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_matrix, zero_vector
from codegen.runtime.unknowns.coupling import add_coupling_matrix
from codegen.runtime.kkt.elements import LOCAL_IS_MULTIPLIER
from codegen.runtime.kkt.ends_flat import note_ends
from codegen.runtime.stand_ins.example import (
    BODIES,
    COUPLINGS,
    ELEMENT,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    NODE,
    PHASE_LACKS,
    PHASES,
    ROOT,
    SHARED,
    STRIDE,
    SWITCH_LACKS,
    interval_hessian,
    metadata,
)
from codegen.runtime.unknowns.lagrangian import lagrangian_gradient
from codegen.runtime.unknowns.shared import read_shared

CHANGE = 8.0  # of the scaled cost, at most, when one unknown changes by its size
LOOSE = 1e-3  # a guess below this part of a bound says little about the size of an unknown
DUST = 1e-6  # the same beside the other terms of every equation
SAMPLES = 4  # intervals on which derivatives are looked at
CANCELLED = 1e-10  # part of the terms of a sum below which it counts as zero

KINDS = STRIDE + SHARED + COUPLINGS
# The kind of each unknown of an element, its time in lengths of an interval, and which kinds are multipliers.
KIND = np.concatenate([np.arange(STRIDE), np.arange(NODE), STRIDE + np.arange(SHARED)])
PLACE = np.concatenate([np.zeros(NODE), np.full(STRIDE - NODE, 0.5), np.ones(NODE), np.full(SHARED, 0.5)])
KIND_IS_MULTIPLIER = np.concatenate(
    [LOCAL_IS_MULTIPLIER[:STRIDE], LOCAL_IS_MULTIPLIER[ELEMENT:], np.ones(COUPLINGS, bool)]
)
# Sizes that the problem states, zero where it states none; free parameters are the last of the shared unknowns.
NAMES = *metadata["node"], *metadata["interval"], *[""] * (SHARED - len(metadata["free_parameters"]))
NAMES = *NAMES, *metadata["free_parameters"], *[""] * COUPLINGS
SCALE = metadata.get("scale", {})
GIVEN = np.array([SCALE.get(name, 0.0) for name in NAMES])


@njit(cache=True, error_model="numpy")
def fill_sizes(unknowns, lower, upper, kinds, steps, h, parameters, sizes):
    """Fill in the size of every unknown; return the weight of the cost, and how far from one weights and sizes are."""
    size, rest, tables = zero_vector(KINDS), zero_vector(KINDS), np.zeros((3, KINDS, KINDS))
    primal, slopes = np.zeros(kinds.size), np.empty(kinds.size)
    for i in range(kinds.size):
        if not KIND_IS_MULTIPLIER[kinds[i]]:
            primal[i] = unknowns[i]
            size[kinds[i]] = max(size[kinds[i]], abs(unknowns[i]))
    lagrangian_gradient(primal, steps, h, parameters, slopes)
    for i in range(kinds.size):
        if KIND_IS_MULTIPLIER[kinds[i]]:
            rest[kinds[i]] = max(rest[kinds[i]], abs(slopes[i]))
    fit_bounds(lower, upper, kinds, size)
    measure_intervals(primal, steps, h, parameters, tables)
    if COUPLINGS:
        matrix = zero_matrix(ROOT, ROOT)
        add_coupling_matrix(primal, parameters[0], 1.0, matrix)
        first = kinds.size - ROOT
        for i in range(ROOT):
            for j in range(i + 1):
                add_entry(kinds[first + i], kinds[first + j], abs(matrix[i, j]), tables)
    forget_dust(size, tables[1])
    for j in range(KINDS):
        if GIVEN[j] > 0.0:
            size[j] = GIVEN[j]
    spread(size, rest, tables[1])
    for j in range(KINDS):
        if not KIND_IS_MULTIPLIER[j]:
            size[j] = positive(size[j])
    weight = CHANGE / positive(change_of_cost(slopes, kinds, size, tables[2]))
    extreme = max(weight, 1.0 / weight)
    for i in range(KINDS):
        if KIND_IS_MULTIPLIER[i]:
            largest = 0.0
            for j in range(KINDS):
                if not KIND_IS_MULTIPLIER[j]:
                    largest = max(largest, tables[0, i, j] * size[j])
            largest = positive(largest)
            extreme = max(extreme, largest, 1.0 / largest)
            size[i] = 1.0 / (largest * weight)
        else:
            extreme = max(extreme, size[i], 1.0 / size[i])
    for i in range(kinds.size):
        sizes[i] = size[kinds[i]]
    return weight, extreme


@njit(error_model="numpy")
def positive(value):
    """A size, or one where there is none."""
    return value if 1e-150 < value < 1e150 else 1.0


@njit(error_model="numpy")
def fit_bounds(lower, upper, kinds, size):
    """Make sizes fit the largest finite bound, where there is one on either side: no less than a small part of it."""
    bound, between = zero_vector(KINDS), zero_vector(KINDS)
    for i in range(lower.size):
        below, above = abs(lower[i]), abs(upper[i])
        if max(below, above) < np.inf:
            between[kinds[i]] = max(between[kinds[i]], below, above)
        elif min(below, above) < np.inf:
            bound[kinds[i]] = max(bound[kinds[i]], min(below, above))
    for j in range(KINDS):
        if between[j] > 0.0 and size[j] > 0.0:
            size[j] = min(max(size[j], LOOSE * between[j]), between[j])
        elif size[j] == 0.0:
            size[j] = max(between[j], bound[j])


@njit(error_model="numpy")
def add_entry(row, column, value, tables):
    """Note the modulus of a derivative: of an equation by an unknown, or a curvature of the cost."""
    if KIND_IS_MULTIPLIER[row] and KIND_IS_MULTIPLIER[column]:
        return
    if KIND_IS_MULTIPLIER[column]:
        row, column = column, row
    if KIND_IS_MULTIPLIER[row]:
        tables[0, row, column] = max(tables[0, row, column], value)
        tables[1, row, column] = max(tables[1, row, column], value)
    else:
        tables[2, row, column] = max(tables[2, row, column], value)


@njit(error_model="numpy")
def measure_intervals(unknowns, steps, h, parameters, tables):
    """Fill three tables by kinds from some intervals.

    The first has the largest derivatives of equations, the second what equations make of motions, constant, linear and
    quadratic in time, of size one, the third the largest curvatures of the cost.
    """
    intervals, hessian, moments = steps, zero_vector(HESSIAN_ROWS.size), np.zeros((ELEMENT + SHARED, KINDS, 4))
    if PHASES:
        intervals = steps // PHASES
    stride = max(1, intervals // SAMPLES)
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        note_ends(unknowns, body, steps, h, parameters, tables)
        for k in range(steps):
            if k % intervals % stride > 0:
                continue
            first = body * (steps * STRIDE + NODE) + k * STRIDE
            interval_hessian(unknowns[first : first + ELEMENT], k * h, h, parameters[body], hessian)
            moments[:] = 0.0
            for j in range(HESSIAN_ROWS.size):
                row, column = HESSIAN_ROWS[j], HESSIAN_COLUMNS[j]
                if LOCAL_IS_MULTIPLIER[column]:
                    row, column = column, row
                if PHASES and is_lacking(row, k, steps):
                    continue
                if not LOCAL_IS_MULTIPLIER[row]:
                    add_entry(KIND[row], KIND[column], abs(hessian[j]), tables)
                elif not LOCAL_IS_MULTIPLIER[column]:
                    ahead = PLACE[column] - PLACE[row]
                    moments[row, KIND[column], 0] += hessian[j]
                    moments[row, KIND[column], 1] += hessian[j] * ahead
                    moments[row, KIND[column], 2] += hessian[j] * ahead * ahead / 2.0
                    moments[row, KIND[column], 3] += abs(hessian[j])
            fold(moments, intervals, tables)


@njit(error_model="numpy")
def fold(moments, intervals, tables):
    """Put the moments of one interval's equations into the tables.

    An equation of a node is a sum of two intervals' shares, each as large as what is equated: as a momentum, say.
    """
    total = zero_vector(4)
    for row in range(moments.shape[0]):
        if not LOCAL_IS_MULTIPLIER[row] or STRIDE <= row < ELEMENT:
            continue
        for column in range(KINDS):
            largest = moments[row, column, 3]
            for i in range(4):
                total[i] = moments[row, column, i]
            if row < NODE:
                for i in range(4):
                    total[i] += moments[STRIDE + row, column, i]
                largest = max(
                    change(moments[row, column], intervals, 1), change(moments[STRIDE + row, column], intervals, 1)
                )
            tables[0, KIND[row], column] = max(tables[0, KIND[row], column], largest)
            tables[1, KIND[row], column] = max(tables[1, KIND[row], column], change(total, intervals, 2))


@njit(error_model="numpy")
def change(moments, intervals, powers):
    """What an equation with these moments makes of motions of size one."""
    largest = abs(moments[0]) if abs(moments[0]) > CANCELLED * moments[3] else 0.0
    largest = max(largest, abs(moments[1]) / intervals)
    return max(largest, abs(moments[2]) / intervals**2) if powers == 2 else largest


@njit(error_model="numpy")
def forget_dust(size, effect):
    """Take away sizes that are negligible in all equations: a slack's guess may be nothing but rounding."""
    for j in range(KINDS):
        least = np.inf
        for i in range(KINDS):
            others = 0.0
            for k in range(KINDS):
                if k != j:
                    others = max(others, effect[i, k] * size[k])
            if effect[i, j] > 0.0:
                least = min(least, others / effect[i, j])
        if least < np.inf and size[j] < DUST * least:
            size[j] = 0.0


@njit(error_model="numpy")
def spread(size, rest, effect):
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
def change_of_cost(slopes, kinds, size, curvature):
    """By how much the cost changes, at most, when one unknown changes by its size."""
    largest = 0.0
    for i in range(kinds.size):
        if not KIND_IS_MULTIPLIER[kinds[i]]:
            largest = max(largest, abs(slopes[i]) * size[kinds[i]])
    for i in range(KINDS):
        for j in range(KINDS):
            largest = max(largest, curvature[i, j] * size[i] * size[j])
    return largest


if PHASES:

    @njit(error_model="numpy")
    def is_lacking(local, k, steps):
        """Whether interval k does not have an unknown; a one on the diagonal then stands for it."""
        phase, within = divmod(k, steps // PHASES)
        lacks = SWITCH_LACKS[phase - 1] if within == 0 and phase > 0 else PHASE_LACKS[phase]
        return NODE <= local < STRIDE and lacks[local - NODE]
