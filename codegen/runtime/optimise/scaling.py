"""Scaling factors of unknowns, equations and cost, from one look at the guess.

Every quantity (a state at all nodes and stages, a control on all intervals, ...) has one scaling factor. A stage value
has the factor of its state, and the equations of all stages have the factor of the state's step. The factors then do
not depend on the scheme, nor on the number of intervals.

1. A stated scale is the factor. Otherwise the factor is the largest modulus at the guess, which contains prescribed
   values. Two bounds limit that factor. A slack has no factor from its guess.
2. An unknown without a factor has the least factor with which it balances an equation. Each equation of the guess is
   linearised and applied to a smooth motion of each quantity. So v = x' has the factor of x divided by the duration.
   An angle that is found so has one radian at most. What has no effect has its bound, or one.
3. An equation has the largest sum |J_ij| times the factor of unknown j.
4. The cost is divided by its largest change, of first or second order, when one quantity changes by its factor.
5. Factors are rounded to powers of a million if these leave ordinary numbers, otherwise to powers of a thousand.
   Problems in ordinary numbers are then solved as they are.

Betts (2010), Practical methods for optimal control, section 4.8, recommends 1 and the same factor for a state and its
equation.
"""

import numpy as np
from numba import njit

from codegen.runtime.arrays import zero_matrix, zero_vector
from codegen.runtime.kkt.elements import LOCAL_IS_MULTIPLIER
from codegen.runtime.kkt.ends_linear import add_end_entries
from codegen.runtime.stand_ins.example import (
    BODIES,
    COUPLINGS,
    ELEMENT,
    END_SHARED,
    END_TIED,
    HESSIAN_COLUMNS,
    HESSIAN_ROWS,
    INEQUALITIES,
    INNER_FIRST,
    INNER_TIMES,
    INNER_UNKNOWNS,
    NODE,
    ONLY_AT_ENDS,
    PHASE_LACKS,
    PHASES,
    ROOT,
    SHARED,
    START_SHARED,
    START_TIED,
    STRIDE,
    SWITCH_LACKS,
    TIED,
    interval_hessian,
    metadata,
)
from codegen.runtime.unknowns.coupling import add_coupling_matrix
from codegen.runtime.unknowns.shared import read_shared
from codegen.runtime.unknowns.times import span

SAMPLES = 4  # intervals on which derivatives are evaluated
SMALL, LARGE = -1.5, 2.9  # powers of ten between which numbers are ordinary; none is round, by intention
LEAST_OF_BOUNDS = 0.3  # part of the larger of two bounds that a factor has at least
NO_SIZE = 1e-14  # part of the largest number of the guess below which a number is a zero
CANCELLED = 1e-14  # part of its terms below which a sum is rounding
LEAST = 1e-150  # what is below, or above its inverse, is no factor

# The quantity of each unknown of a node and of the interval after it, then of each shared one, as a number.
NAMES = [*metadata["node"], *metadata["interval"], *[f"shared {i}" for i in range(SHARED + COUPLINGS)]]
for i, name in enumerate(metadata["free_parameters"], STRIDE + SHARED - len(metadata["free_parameters"])):
    NAMES[i] = name
MULTIPLIES = np.concatenate([LOCAL_IS_MULTIPLIER[:STRIDE], LOCAL_IS_MULTIPLIER[ELEMENT:], np.ones(COUPLINGS, bool)])
PAIRS = [(metadata.get("stages", {}).get(name, name), bool(m)) for name, m in zip(NAMES, MULTIPLIES, strict=True)]
KIND_NAMES = list(dict.fromkeys(PAIRS))
KIND = np.array([KIND_NAMES.index(pair) for pair in PAIRS])
KINDS = len(KIND_NAMES)
IS_EQUATION = np.array([is_multiplier for _, is_multiplier in KIND_NAMES])
STATED = np.array([metadata.get("scale", {}).get(name, 0.0) for name, _ in KIND_NAMES])  # zero where there is none
RADIAN = np.array([metadata.get("angles", {}).get(name, np.inf) for name, _ in KIND_NAMES])  # of what is no angle
IS_SLACK = np.zeros(KINDS, bool)
IS_SLACK[KIND] = [metadata["meanings"].get(name, "").startswith("slack of ") for name in NAMES]
IS_SINGLE = np.zeros(KINDS, bool)  # such as a free duration, which no node equals
IS_SINGLE[KIND[STRIDE:]] = ~MULTIPLIES[STRIDE:]
if TIED:
    IS_SINGLE[KIND[STRIDE + START_SHARED]] = False
    IS_SINGLE[KIND[STRIDE + END_SHARED]] = False

# Of the unknowns of an element: the quantity, the time in lengths of the interval, and if inner nodes lack it.
LOCAL = np.concatenate([np.arange(STRIDE), np.arange(NODE), STRIDE + np.arange(SHARED)])
LOCAL_KIND = KIND[LOCAL]
ABSCISSA = np.concatenate([np.zeros(NODE), np.full(STRIDE - NODE, 0.5), np.ones(NODE), np.full(SHARED, 0.5)])
IS_AT_ENDS = np.isin(LOCAL, ONLY_AT_ENDS)  # inner nodes have ones on their diagonal
if INNER_TIMES:
    IS_AT_ENDS |= np.isin(LOCAL, INNER_UNKNOWNS)


@njit(cache=True, error_model="numpy")
def fill_scaling_factors(primal, inside, slopes, lower, upper, kinds, steps, h, nodes, parameters, factors):
    """Fill the `factors` (n,) of all unknowns; return the weight of the cost, and True unless all are one.

    `primal` (n,) is the guess without multipliers, `inside` (n,) the same inside the bounds `lower` and `upper`, which
    are (n,) or empty. `slopes` (n,) are the moduli of the gradient of the Lagrangian there, the smaller of both.
    `kinds` (n,) are the numbers of quantities, `nodes` (N + 1,), `parameters` (BODIES, P + SHARED).
    """
    size, rest, largest = zero_vector(KINDS), zero_vector(KINDS), 0.0
    for i in range(kinds.size):
        largest = max(largest, abs(primal[i]))
    for i in range(kinds.size):
        if IS_EQUATION[kinds[i]]:
            rest[kinds[i]] = max(rest[kinds[i]], slopes[i])
        elif not IS_SLACK[kinds[i]] and abs(primal[i]) > NO_SIZE * largest:
            size[kinds[i]] = max(size[kinds[i]], abs(primal[i]))
    bound = limit_by_bounds(lower, upper, kinds, size)
    for j in range(KINDS):
        if STATED[j] > 0.0:
            size[j] = STATED[j]
    terms, effect, curvature = zero_matrix(KINDS, KINDS), zero_matrix(KINDS, KINDS), zero_matrix(KINDS, KINDS)
    measure_derivatives(primal, steps, h, nodes, parameters, terms, effect, curvature)
    if INEQUALITIES:
        moved = False
        for i in range(primal.size):
            moved = moved or inside[i] != primal[i]
        if moved:  # outside its bounds a model may mean nothing, and at a bound it may be far from a solution
            others = zero_matrix(KINDS, KINDS), zero_matrix(KINDS, KINDS), zero_matrix(KINDS, KINDS)
            measure_derivatives(inside, steps, h, nodes, parameters, *others)
            lessen(terms, others[0])
            lessen(effect, others[1])
            lessen(curvature, others[2])
    if COUPLINGS:
        add_couplings(inside, parameters, kinds, terms, effect)
    balance(size, rest, effect)
    for j in range(KINDS):
        size[j] = max(size[j], bound[j])
    if TIED:
        equate_tied(size)
    for i in range(KINDS):
        if IS_EQUATION[i]:
            size[i] = 0.0
            for j in range(KINDS):
                if not IS_EQUATION[j]:
                    size[i] = max(size[i], terms[i, j] * size[j])
            if size[i] == 0.0:
                size[i] = rest[i]
    if TIED:
        equate_tied(size)
    digits = digits_of(size)
    slope, curved = change_of_cost(slopes, kinds, size, curvature)
    is_steep = slope >= curved  # then first steps follow the slope, and could throw unknowns onto bounds
    weight = 1.0 / rounded(max(slope, curved), digits if is_steep else 6.0, is_steep)
    is_scaled = weight != 1.0
    for j in range(KINDS):
        if not STATED[j] > 0.0:
            size[j] = rounded(size[j], digits, IS_SINGLE[j])
        is_scaled = is_scaled or size[j] != 1.0
        if IS_EQUATION[j]:
            size[j] = 1.0 / (size[j] * weight)
    for i in range(kinds.size):
        factors[i] = size[kinds[i]]
    return weight, is_scaled


@njit(error_model="numpy")
def limit_by_bounds(lower, upper, kinds, size):
    """Limit each `size` by two bounds; return the largest bounds (KINDS,) of what has one bound and no size."""
    bound, between = zero_vector(KINDS), zero_vector(KINDS)
    for i in range(lower.size):
        if not IS_SLACK[kinds[i]]:
            smaller, larger = min(abs(lower[i]), abs(upper[i])), max(abs(lower[i]), abs(upper[i]))
            if larger < np.inf:
                between[kinds[i]] = max(between[kinds[i]], larger)
            elif smaller < np.inf:
                bound[kinds[i]] = max(bound[kinds[i]], smaller)
    for j in range(KINDS):
        if between[j] > 0.0:
            size[j] = min(max(size[j], LEAST_OF_BOUNDS * between[j]), between[j]) if size[j] > 0.0 else between[j]
        if size[j] > 0.0 or STATED[j] > 0.0:
            bound[j] = 0.0
    return bound


@njit(error_model="numpy")
def balance(size, rest, effect):
    """Give unknowns without a size the least one with which they balance an equation, until nothing is new.

    `rest` (KINDS,) are the residuals of the guess, `effect` (KINDS, KINDS) the changes of equations by smooth motions.
    """
    for _ in range(KINDS):
        found, is_new = zero_vector(KINDS), False
        for i in range(KINDS):
            largest = rest[i]
            for j in range(KINDS):
                largest = max(largest, effect[i, j] * size[j])
            for j in range(KINDS):
                if size[j] == 0.0 and effect[i, j] > 0.0 and largest > 0.0:
                    balancing = min(largest / effect[i, j], RADIAN[j])
                    found[j] = balancing if found[j] == 0.0 else min(found[j], balancing)
                    is_new = True
        if not is_new:
            return
        for j in range(KINDS):
            if size[j] == 0.0:
                size[j] = found[j]


@njit(error_model="numpy")
def measure_derivatives(unknowns, steps, h, nodes, parameters, terms, effect, curvature):
    """Fill tables (KINDS, KINDS) of derivatives, from some intervals and from both ends.

    `terms` are the largest sums of moduli in one equation, by one quantity. `effect` is the largest change of an
    equation by the motion exp(t / T) of one quantity, which is neither constant nor linear. `curvature` are the sums of
    the cost's second derivatives. An equation of a node is a sum of shares of two intervals, which the same interval
    gives. Each share, such as a momentum, is a term: its change by the motion does not depend on the interval's length.
    """
    intervals = steps
    if PHASES:
        intervals = steps // PHASES
    stride = max(1, intervals // SAMPLES)
    hessian = zero_vector(HESSIAN_ROWS.size)
    moduli, sums = zero_matrix(LOCAL.size, KINDS), zero_matrix(LOCAL.size, KINDS)
    for body in range(BODIES):
        if SHARED:
            read_shared(unknowns, body, parameters)
        add_end_entries(unknowns, body, steps, h, parameters, terms, effect, curvature)
        for k in range(steps):
            t, length = span(nodes, k, h)
            is_sample = k % intervals % stride == 0
            if INNER_TIMES:
                is_sample = is_sample or is_inner(parameters[body], t, length)
            if not is_sample:
                continue
            first, part = body * (steps * STRIDE + NODE) + k * STRIDE, nodes[k + 1] - nodes[k]  # of a mean length
            interval_hessian(unknowns[first : first + ELEMENT], t, length, parameters[body], hessian)
            moduli[:] = 0.0
            sums[:] = 0.0
            for j in range(HESSIAN_ROWS.size):
                row, column = HESSIAN_ROWS[j], HESSIAN_COLUMNS[j]
                if LOCAL_IS_MULTIPLIER[column]:
                    row, column = column, row
                if PHASES and is_lacking(row, k, steps):
                    continue
                of = LOCAL_KIND[column]
                if LOCAL_IS_MULTIPLIER[row] and not LOCAL_IS_MULTIPLIER[column]:
                    moduli[row, of] += abs(hessian[j])
                    sums[row, of] += hessian[j] * np.exp((ABSCISSA[column] - ABSCISSA[row]) * part / intervals)
                elif not LOCAL_IS_MULTIPLIER[row] and not IS_AT_ENDS[row]:
                    curvature[LOCAL_KIND[row], of] += stride * abs(hessian[j]) / part
            for row in range(LOCAL.size):
                if not LOCAL_IS_MULTIPLIER[row]:
                    continue
                kind = LOCAL_KIND[row]
                for of in range(KINDS):
                    change, modulus = sums[row, of], moduli[row, of]
                    is_of_node = row < NODE or STRIDE <= row < ELEMENT
                    if not is_of_node:
                        terms[kind, of] = max(terms[kind, of], modulus)
                    elif abs(change) > CANCELLED * modulus:
                        terms[kind, of] = max(terms[kind, of], abs(change))
                    if row < NODE:
                        change += sums[STRIDE + row, of]
                        modulus += moduli[STRIDE + row, of]
                    if abs(change) > CANCELLED * modulus and not STRIDE <= row < ELEMENT:
                        effect[kind, of] = max(effect[kind, of], abs(change))


if COUPLINGS:

    @njit(error_model="numpy")
    def add_couplings(unknowns, parameters, kinds, terms, effect):
        """Add the derivatives of conditions between shared unknowns, which are linear in their multipliers."""
        matrix, first = zero_matrix(ROOT, ROOT), kinds.size - ROOT
        add_coupling_matrix(unknowns, parameters[0], 1.0, matrix)
        for i in range(ROOT):
            for j in range(ROOT):
                kind, of, value = kinds[first + i], kinds[first + j], abs(matrix[max(i, j), min(i, j)])
                if IS_EQUATION[kind] and not IS_EQUATION[of]:
                    terms[kind, of] = max(terms[kind, of], value)
                    effect[kind, of] = max(effect[kind, of], value)


if INEQUALITIES:

    @njit(error_model="numpy")
    def lessen(table, other):
        """Give the entries of a table (KINDS, KINDS) the smaller value of both, or the one that is a number."""
        for i in range(KINDS):
            for j in range(KINDS):
                if other[i, j] < table[i, j] or np.isnan(table[i, j]):
                    table[i, j] = other[i, j]


if TIED:

    @njit(error_model="numpy")
    def equate_tied(size):
        """Give unknowns at the ends and the shared ones that they equal one size, the largest."""
        for _ in range(SHARED):
            for i in range(START_SHARED.size):
                level(KIND[START_TIED[i]], KIND[STRIDE + START_SHARED[i]], size)
            for i in range(END_SHARED.size):
                level(KIND[END_TIED[i]], KIND[STRIDE + END_SHARED[i]], size)

    @njit(error_model="numpy")
    def level(one, other, size):
        """Give two quantities the larger one of their sizes."""
        size[one] = size[other] = max(size[one], size[other])


@njit(error_model="numpy")
def change_of_cost(slopes, kinds, size, curvature):
    """Return the largest changes of the cost, of first and of second order, by the size of one quantity everywhere.

    Both are sums over all intervals, and do not depend on the number of intervals. The second one alone counts controls
    that cost nothing at the guess.
    """
    slope, curved, total = 0.0, 0.0, zero_vector(KINDS)
    for i in range(kinds.size):
        total[kinds[i]] += slopes[i]
    for i in range(KINDS):
        if not IS_EQUATION[i]:
            slope = max(slope, total[i] * size[i])
            for j in range(KINDS):
                curved = max(curved, curvature[i, j] * size[i] * size[j])
    return slope, curved


@njit(error_model="numpy")
def digits_of(size):
    """Return 6.0 if dividing by powers of a million leaves ordinary numbers, otherwise 3.0."""
    for i in range(KINDS):
        if LEAST < size[i] < 1.0 / LEAST and not STATED[i] > 0.0:
            above = np.log10(size[i]) - SMALL
            if above - 6.0 * np.floor(above / 6.0) > LARGE - SMALL:
                return 3.0
    return 6.0


@njit(error_model="numpy")
def rounded(value, digits, finer):
    """Return the highest power of a million (`digits` are six) or a thousand below some thirty values, or one.

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


if INNER_TIMES:

    @njit(error_model="numpy")
    def is_inner(parameters, t, h):
        """Return True if the node at time t, before an interval of length h, is at an inner time."""
        found = False
        for i in range(INNER_FIRST, INNER_FIRST + INNER_TIMES):
            found = found or abs(t - parameters[i]) < 1e-6 * h
        return found


if PHASES:

    @njit(error_model="numpy")
    def is_lacking(local, k, steps):
        """Return True if interval k does not have an unknown; a one on the diagonal then stands for it."""
        phase, within = divmod(k, steps // PHASES)
        lacks = SWITCH_LACKS[phase - 1] if within == 0 and phase > 0 else PHASE_LACKS[phase]
        return NODE <= local < STRIDE and lacks[local - NODE]
