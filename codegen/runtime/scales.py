"""How large unknowns and equations are: the units in which the solver works, whatever those of the problem are.

Every kind of unknown (a coordinate at all nodes, a control on all intervals, ...) has one size, taken from its guess,
which contains prescribed values, and from its bounds. What is zero there, and unbounded, has a size such that it
matters in the equations: each row of their Jacobian at the guess is applied to motions of the known sizes which are
constant, linear and quadratic in time, and the unknown balances the result. So v = x' has the size of x divided by the
duration. Equations are divided by the largest product of a derivative and a size, and the cost by how much it changes
at most when one unknown changes by its size. A change of units then changes nothing but the sizes. Where all of them are
between 1/ORDINARY and ORDINARY, none is used.
"""

from functools import lru_cache

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_vector
from codegen.runtime.coupling import coupling_entries
from codegen.runtime.elements import LOCAL_IS_MULTIPLIER
from codegen.runtime.ends_flat import end_entries
from codegen.runtime.example import (
    BODIES,
    COUPLINGS,
    ELEMENT,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    INEQUALITIES,
    NODE,
    OWN,
    PHASE_LACKS,
    PHASES,
    SHARED,
    STRIDE,
    SWITCH_LACKS,
    interval_hessian,
    variable_bounds,
    with_pinned_values,
)
from codegen.runtime.messages import describe
from codegen.runtime.newton_filter import minimise
from codegen.runtime.point import evaluate
from codegen.runtime.shared import read_shared

ORDINARY = 1e3  # sizes between its inverse and it need no scaling
CHANGE = 1.0  # of the scaled cost, at most, when one unknown changes by its size
LOOSE = 1e-3  # a guess below this part of a bound says little about the size of an unknown
DUST = 1e-6  # the same beside the other terms of every equation
SAMPLES = 8  # intervals on which derivatives are looked at
CANCELLED = 1e-10  # part of the terms of a sum below which it counts as zero

KINDS = STRIDE + SHARED + COUPLINGS
# The kind of each unknown of an element, its time in lengths of an interval, and which kinds are multipliers.
KIND = np.concatenate([np.arange(STRIDE), np.arange(NODE), STRIDE + np.arange(SHARED)])
PLACE = np.concatenate([np.zeros(NODE), np.full(STRIDE - NODE, 0.5), np.ones(NODE), np.full(SHARED, 0.5)])
KIND_IS_MULTIPLIER = np.concatenate(
    [LOCAL_IS_MULTIPLIER[:STRIDE], LOCAL_IS_MULTIPLIER[ELEMENT:], np.ones(COUPLINGS, bool)]
)


def optimise(grid, unknowns, tolerance, max_iterations, warm, scaling, log):
    """Minimise in parts of sizes, unless `scaling` is "none"; return (status, message, point, iterations)."""
    if scaling not in ("auto", "none"):
        raise ValueError(f"scaling is {scaling!r}, expected 'auto' or 'none'")
    if scaling == "auto":
        grid = scaled_grid(grid, unknowns)
    start = unknowns / grid.sizes if grid.sizes.size else unknowns
    status, point, iterations = minimise(grid, start, tolerance, max_iterations, warm, log)
    return *describe(grid, start, point, status), in_units(grid, point), iterations


def scaled_grid(grid, unknowns):
    """The same grid with sizes of all unknowns and the weight of the cost, or as it is where all are ordinary."""
    primal, none = np.where(grid.is_multiplier, 0.0, unknowns), np.zeros(0)
    lower, upper = none, none
    if INEQUALITIES:
        lower, upper = variable_bounds(grid)
    rows, columns, values = end_entries(grid, primal)
    if COUPLINGS:
        further = coupling_entries(grid, primal)
        rows, columns, values = (np.concatenate(pair) for pair in zip((rows, columns, values), further, strict=True))
    slopes, sizes, kinds = evaluate(grid, primal).gradient, np.empty(primal.size), kinds_of(grid.steps)
    weight, extreme = fill_sizes(
        primal, slopes, lower, upper, np.zeros(KINDS), kinds, kinds[rows], kinds[columns], values,
        grid.steps, grid.h, grid.parameters, sizes,
    )  # fmt: skip
    return grid._replace(sizes=sizes, weight=weight) if extreme > ORDINARY else grid


@lru_cache(maxsize=4)
def kinds_of(steps):
    """The kind of every unknown: its place in a node with the interval after it, then the shared ones."""
    chain = np.tile(np.arange(steps * STRIDE + NODE) % STRIDE, BODIES)
    if SHARED:
        own, common = np.tile(np.arange(OWN), BODIES), np.arange(OWN, SHARED + COUPLINGS)
        return np.concatenate([chain, STRIDE + own, STRIDE + common])
    else:
        return chain


def in_units(grid, point):
    """A point in the problem's own units; its stationarity is the change of the cost with parts of sizes."""
    if not grid.sizes.size:
        return point
    stationarity = point.stationarity / grid.weight
    sizes, grid = grid.sizes, grid._replace(sizes=grid.sizes[:0], weight=1.0)
    point = evaluate(grid, with_pinned_values(grid, point.unknowns * sizes))
    return point._replace(stationarity=stationarity, error=max(point.residual, stationarity))


@njit(cache=True, error_model="numpy")
def fill_sizes(
    unknowns, slopes, lower, upper, given, kinds, rows, columns, values, steps, h, parameters, sizes
):
    """Fill in the size of every unknown; return the weight of the cost, and how far from one weights and sizes are.

    `rows`, `columns` and `values` are the entries of the KKT matrix, by kinds, that do not come from intervals.
    """
    size, rest, tables = zero_vector(KINDS), zero_vector(KINDS), np.zeros((3, KINDS, KINDS))
    for i in range(kinds.size):
        if KIND_IS_MULTIPLIER[kinds[i]]:
            rest[kinds[i]] = max(rest[kinds[i]], abs(slopes[i]))
        else:
            size[kinds[i]] = max(size[kinds[i]], abs(unknowns[i]))
    fit_bounds(lower, upper, kinds, size)
    for j in range(KINDS):
        if given[j] > 0.0:
            size[j] = given[j]
    measure_intervals(unknowns, steps, h, parameters, tables)
    for j in range(values.size):
        add_entry(rows[j], columns[j], abs(values[j]), tables)
    forget_dust(size, tables[1])
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
        found = zero_vector(KINDS)
        for i in range(KINDS):
            known = rest[i]
            for j in range(KINDS):
                known = max(known, effect[i, j] * size[j])
            for j in range(KINDS):
                if size[j] == 0.0 and effect[i, j] > 0.0 and known > 0.0:
                    balancing = known / effect[i, j]
                    found[j] = balancing if found[j] == 0.0 else min(found[j], balancing)
        if not found.max() > 0.0:
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
