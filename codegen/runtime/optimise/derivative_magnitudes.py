"""How steep equations and cost are: the largest derivatives by kinds of unknowns, from some intervals and both ends."""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.kkt.elements import LOCAL_IS_MULTIPLIER
from codegen.runtime.kkt.ends_linear import note_ends
from codegen.runtime.stand_ins.example import (
    BODIES,
    COUPLINGS,
    ELEMENT,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    INNER_FIRST,
    INNER_TIMES,
    INNER_UNKNOWNS,
    NODE,
    ONLY_AT_ENDS,
    PHASE_LACKS,
    PHASES,
    SHARED,
    STRIDE,
    SWITCH_LACKS,
    interval_hessian,
)
from codegen.runtime.unknowns.shared import read_shared
from codegen.runtime.unknowns.times import span

SAMPLES = 4  # intervals on which derivatives are looked at
OUTLYING = 1e6  # derivatives so many times as large as at most samples say more of a poor guess than of a solution
CANCELLED = 1e-10  # part of the terms of a sum below which it counts as zero

KINDS = STRIDE + SHARED + COUPLINGS
# The kind of each unknown of an element, its time in lengths of an interval, and which kinds are multipliers.
KIND = np.concatenate([np.arange(STRIDE), np.arange(NODE), STRIDE + np.arange(SHARED)])
ABSCISSA = np.concatenate([np.zeros(NODE), np.full(STRIDE - NODE, 0.5), np.ones(NODE), np.full(SHARED, 0.5)])
KIND_IS_MULTIPLIER = np.concatenate(
    [LOCAL_IS_MULTIPLIER[:STRIDE], LOCAL_IS_MULTIPLIER[ELEMENT:], np.ones(COUPLINGS, bool)]
)
IS_AT_ENDS = np.isin(np.arange(KINDS), ONLY_AT_ENDS)  # inner nodes have ones on their diagonal
if INNER_TIMES:
    IS_AT_ENDS |= np.isin(np.arange(KINDS), INNER_UNKNOWNS)  # and those that are at no inner time


@njit(error_model="numpy")
def add_entry(row, column, value, tables):
    """Note the modulus of a derivative: of an equation by an unknown, or a curvature of the cost, which add up."""
    if KIND_IS_MULTIPLIER[row] and KIND_IS_MULTIPLIER[column]:
        return
    if KIND_IS_MULTIPLIER[column]:
        row, column = column, row
    if KIND_IS_MULTIPLIER[row]:
        tables[0, row, column] = max(tables[0, row, column], value)
        tables[1, row, column] = max(tables[1, row, column], value)
    else:
        tables[2, row, column] += value


@njit(error_model="numpy")
def measure_intervals(unknowns, steps, h, nodes, parameters, tables):
    """Fill three `tables` (3, KINDS, KINDS) from some intervals.

    The first has the largest derivatives of equations, the second what equations make of motions, constant, linear and
    quadratic in time, of size one, the third the sums of the cost's curvatures. `unknowns` are (n,), `nodes` (N + 1,),
    `parameters` (BODIES, P + SHARED).
    """
    intervals, hessian, moments = steps, zero_vector(HESSIAN_ROWS.size), np.zeros((ELEMENT + SHARED, KINDS, 4))
    if PHASES:
        intervals = steps // PHASES
    stride = max(1, intervals // SAMPLES)
    steepest = typical_derivative(unknowns, steps, intervals, stride, h, nodes, parameters) * OUTLYING
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        note_ends(unknowns, body, steps, h, parameters, tables)
        for k in range(steps):
            if k % intervals % stride > 0:
                if INNER_TIMES:
                    t, length = span(nodes, k, h)
                    if not is_inner(parameters[body], t, length):
                        continue
                else:
                    continue
            first = body * (steps * STRIDE + NODE) + k * STRIDE
            t, length = span(nodes, k, h)
            interval_hessian(unknowns[first : first + ELEMENT], t, length, parameters[body], hessian)
            if largest_modulus(hessian) > steepest:
                continue
            part = nodes[k + 1] - nodes[k]  # of a mean length
            moments[:] = 0.0
            for j in range(HESSIAN_ROWS.size):
                row, column = HESSIAN_ROWS[j], HESSIAN_COLUMNS[j]
                if LOCAL_IS_MULTIPLIER[column]:
                    row, column = column, row
                if PHASES and is_lacking(row, k, steps):
                    continue
                if not LOCAL_IS_MULTIPLIER[row]:
                    if not IS_AT_ENDS[KIND[row]]:
                        add_entry(KIND[row], KIND[column], stride * abs(hessian[j]) / part, tables)
                elif not LOCAL_IS_MULTIPLIER[column]:
                    ahead = ABSCISSA[column] - ABSCISSA[row]
                    moments[row, KIND[column], 0] += hessian[j]
                    moments[row, KIND[column], 1] += hessian[j] * ahead
                    moments[row, KIND[column], 2] += hessian[j] * ahead * ahead / 2.0
                    moments[row, KIND[column], 3] += abs(hessian[j])
            fold(moments, intervals, part, tables)


@njit(error_model="numpy")
def typical_derivative(unknowns, steps, intervals, stride, h, nodes, parameters):
    """The median of the largest derivatives on the sampled intervals of the first body; arrays as there.

    Between phases, or across what a straight line passes, a guess may be where exponentials leave all measure: a
    straight line through a planet's atmosphere made one of four samples 1e18 times as steep as the others.
    """
    hessian, largest, count = zero_vector(HESSIAN_ROWS.size), zero_vector(steps), 0
    if SHARED:
        read_shared(unknowns, 0, parameters)
    for k in range(steps):
        if k % intervals % stride == 0:
            t, length = span(nodes, k, h)
            interval_hessian(unknowns[k * STRIDE : k * STRIDE + ELEMENT], t, length, parameters[0], hessian)
            largest[count] = largest_modulus(hessian)
            count += 1
    if count > 2:
        for i in range(count):  # a sort would take as long to compile as all else here
            lower = 0
            for j in range(count):
                if largest[j] < largest[i] or (largest[j] == largest[i] and j < i):
                    lower += 1
            if lower == (count - 1) // 2 and largest[i] > 0.0:
                return largest[i]
    return np.inf


@njit(error_model="numpy")
def largest_modulus(entries):
    """The largest modulus of a vector's entries (n,); NaN where one is none. A loop is soon compiled."""
    largest = 0.0
    for i in range(entries.size):
        if np.isnan(entries[i]):
            return np.nan
        largest = max(largest, abs(entries[i]))
    return largest


@njit(error_model="numpy")
def fold(moments, intervals, part, tables):
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
                    change(moments[row, column], intervals, part, 1),
                    change(moments[STRIDE + row, column], intervals, part, 1),
                )
            tables[0, KIND[row], column] = max(tables[0, KIND[row], column], largest)
            tables[1, KIND[row], column] = max(tables[1, KIND[row], column], change(total, intervals, part, 2))


@njit(error_model="numpy")
def change(moments, intervals, part, powers):
    """What an equation with these moments makes of motions of size one, on an interval that is `part` of a mean one."""
    largest = abs(moments[0]) if abs(moments[0]) > CANCELLED * moments[3] else 0.0
    largest = max(largest, abs(moments[1]) * part / intervals)
    return max(largest, abs(moments[2]) * part**2 / intervals**2) if powers == 2 else largest


if INNER_TIMES:

    @njit(error_model="numpy")
    def is_inner(parameters, t, h):
        """Whether the node at time t, before an interval of length h, is at an inner time."""
        found = False
        for i in range(INNER_FIRST, INNER_FIRST + INNER_TIMES):
            found = found or abs(t - parameters[i]) < 1e-6 * h
        return found


if PHASES:

    @njit(error_model="numpy")
    def is_lacking(local, k, steps):
        """Whether interval k does not have an unknown; a one on the diagonal then stands for it."""
        phase, within = divmod(k, steps // PHASES)
        lacks = SWITCH_LACKS[phase - 1] if within == 0 and phase > 0 else PHASE_LACKS[phase]
        return NODE <= local < STRIDE and lacks[local - NODE]
