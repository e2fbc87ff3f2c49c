"""Scaling factors of unknowns, equations and cost, from one look at the guess.

Every quantity (a state at all nodes and stages, a control on all intervals, ...) has one scaling factor. A stage value
has the factor of its state, and the equations of all stages have the factor of the state's step. The factors then do
not depend on the scheme, nor on the number of intervals.

1. A stated scale is the factor. Otherwise the factor is the largest modulus at the guess, which contains prescribed
   values. Two bounds limit that factor. A slack has no factor from its guess.
2. An unknown without a factor has the least factor with which it balances an equation. Each equation of the guess is
   linearised and applied to a smooth motion of each quantity. So v = x' has the factor of x divided by the duration.
   An angle has a factor of one radian at most. An unknown without effect has its bound as its factor, or one.
3. An equation has the largest sum |J_ij| times the factor of unknown j.
4. The cost is divided by its largest change, of first or second order, when one quantity changes by its factor.
5. Factors are rounded to powers of a million if scaled numbers are then between 10^-1.5 and 10^2.9, otherwise to
   powers of a thousand. A problem whose factors are all one is not scaled.

Betts (2010), Practical methods for optimal control, section 4.8, recommends 1 and the same factor for a state and its
equation.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.grid import NONE
from codegen.runtime.search.point import fill

SAMPLES = 4  # intervals on which derivatives are evaluated
SMALL, LARGE = -1.5, 2.9  # scaled numbers are between these powers of ten, which are not round on purpose
LEAST_OF_BOUNDS = 0.3  # part of the larger of two bounds that a factor has at least
NO_SIZE = 1e-14  # part of the largest number of the guess below which a number counts as zero
CANCELLED = 1e-14  # part of its terms below which a sum counts as rounding error
LEAST = 1e-150  # a factor is above it, and below its inverse


class Quantities(NamedTuple):
    """The quantities of a problem, numbered, and the quantity of each unknown.

    `kind` and `multiplies` are those of the unknowns of a node and an interval, then of the linking variables.
    `local_kind`, `local_multiplies`, `abscissa` (time in lengths of the interval) and `only_at_ends` are those of an
    element. Each quantity has `is_equation`, `stated` scale (zero for none), one `radian`, `is_slack`, and `is_single`
    (such as a free duration, which no node equals). `tied` (k, 2) are quantities that equal each other at an end.
    """

    kind: np.ndarray
    multiplies: np.ndarray
    local_kind: np.ndarray
    local_multiplies: np.ndarray
    abscissa: np.ndarray
    only_at_ends: np.ndarray
    is_equation: np.ndarray
    stated: np.ndarray
    radian: np.ndarray
    is_slack: np.ndarray
    is_single: np.ndarray
    tied: np.ndarray
    rows: np.ndarray
    columns: np.ndarray
    start_rows: np.ndarray
    start_columns: np.ndarray
    start_filling: np.ndarray
    end_rows: np.ndarray
    end_columns: np.ndarray


@lru_cache(maxsize=64)
def quantities_of(problem):
    """Return the quantities of a problem."""
    s, metadata = problem.structure, problem.metadata
    names = [*metadata.node, *metadata.interval, *[f"shared {i}" for i in range(s.shared + s.couplings)]]
    free = metadata.free_parameters
    for i, name in enumerate(free, s.stride + s.shared - len(free)):
        names[i] = name
    is_multiplier = s.local_is_multiplier
    multiplies = np.concatenate(
        [is_multiplier[: s.stride], is_multiplier[s.element :], np.ones(s.couplings, bool)]
    )  # fmt: skip
    stages = metadata.stages
    pairs = [(stages.get(name, name), bool(m)) for name, m in zip(names, multiplies, strict=True)]
    kinds = list(dict.fromkeys(pairs))
    numbers = {pair: number for number, pair in enumerate(kinds)}
    kind = np.array([numbers[pair] for pair in pairs])
    is_slack, is_single = np.zeros(len(kinds), bool), np.zeros(len(kinds), bool)
    is_slack[kind] = [metadata.is_slack(name) for name in names]
    is_single[kind[s.stride :]] = ~multiplies[s.stride :]
    tied = np.concatenate(
        [
            np.stack([kind[s.start_tied], kind[s.stride + s.start_shared]], axis=1),
            np.stack([kind[s.end_tied], kind[s.stride + s.end_shared]], axis=1),
        ]
    )
    is_single[tied[:, 1]] = False
    local = np.concatenate([np.arange(s.stride), np.arange(s.node), s.stride + np.arange(s.shared)])
    halves = np.full(s.stride - s.node, 0.5), np.full(s.shared, 0.5)
    abscissa = np.concatenate([np.zeros(s.node), halves[0], np.ones(s.node), halves[1]])
    only_at_ends = np.isin(local, s.only_at_ends) | np.isin(local, s.inner_unknowns)
    filling = (s.start_rows == s.start_columns) & np.isin(s.start_rows, s.only_at_ends)

    def of_end(indices):
        return np.where(indices < s.node, indices, s.stride + indices - s.node).astype(np.int64)

    return Quantities(
        kind, multiplies, kind[local], is_multiplier.copy(), abscissa, only_at_ends,
        np.array([multiplier for _, multiplier in kinds]),
        np.array([float(metadata.scale.get(name, 0.0)) for name, _ in kinds]),
        np.array([float(metadata.angles.get(name, np.inf)) for name, _ in kinds]),
        is_slack, is_single, tied.astype(np.int64), s.rows, s.columns, of_end(s.start_rows), of_end(s.start_columns),
        filling.astype(float), of_end(s.end_rows), of_end(s.end_columns),
    )  # fmt: skip


def scaled_grid(grid, unknowns, is_solution=False):
    """Return the same grid with scaling factors of unknowns and cost, or without if all are one.

    The `unknowns` (n,) are a guess, or a solution, whose residuals are rounding errors. If a guess violates bounds,
    derivatives are evaluated there and on the bounds, and the smaller ones count. A model may be invalid outside its
    bounds, and the bounds may be far from the solution.
    """
    problem, s = grid.problem, grid.problem.structure
    if s.linear_quadratic:
        return grid
    steps, h, nodes, _, parameters, is_multiplier, *_ = grid
    q, bounds = quantities_of(problem), (NONE, NONE)
    kinds, places, lacks, counts = sampled(problem, steps, grid.inner)
    if problem.variable_bounds is not None:
        bounds = bounds_of(grid)
    factors, work = np.empty(unknowns.size), np.empty((3, unknowns.size))
    entries = np.zeros(s.entry_count(steps))  # loops leave out a root matrix without terms
    weight, is_scaled = fill_scaling_factors(
        q, problem.gradient.address, problem.hessians.address, steps, h, nodes, parameters, is_multiplier, unknowns,
        *bounds, s.ties(steps), kinds, counts, places, lacks, is_solution, entries, work, factors,
    )  # fmt: skip
    if not is_scaled:
        return grid
    if problem.variable_bounds is None:
        return grid._replace(sizes=factors, forces=weight * factors, weight=weight)
    # Bounds of slacks below zero, by rounding or where equations determine them, are numbers without a unit.
    units = np.where(q.is_slack[kinds], 1.0, factors) if q.is_slack.any() else factors
    bounds = bounds[0] / units, bounds[1] / units
    return grid._replace(sizes=factors, forces=weight * factors, weight=weight, bounds=bounds)


@lru_cache(maxsize=8)
def sampled(problem, steps, inner):
    """Return data for the scaling factors of a grid with nodes at `inner` times: kinds, places, lacks, counts.

    `kinds` (n,) are the numbers of the quantities of all unknowns. Derivatives are evaluated on the intervals at
    `places`: some of each phase, and those after inner times. `lacks` (places, element + shared) masks the unknowns
    that an interval lacks.
    """
    s = problem.structure
    intervals = steps // (s.phases or 1)
    k = np.arange(steps)
    is_sample = k % intervals % max(1, intervals // SAMPLES) == 0
    if inner:
        is_sample |= np.isin(k, inner)
    places = np.flatnonzero(is_sample)
    counts = np.array([s.bodies, steps, s.phases or 1, s.root, s.stride, s.node])
    lacks = np.zeros((places.size, s.element + s.shared), bool)
    if s.phases:
        phase, within = np.divmod(places, intervals)
        lacks[:, s.node : s.stride] = s.phase_lacks[phase]
        is_first = (within == 0) & (phase > 0)
        lacks[is_first, s.node : s.stride] = s.switch_lacks[phase[is_first] - 1]
    return quantities_of(problem).kind[s.kinds(steps)], places, lacks, counts


@njit(cache=True, error_model="numpy")
def fill_scaling_factors(
    q, gradient, hessians, steps, h, nodes, parameters, is_multiplier, unknowns, lower, upper, ties, kinds, counts,
    places, lacks, is_solution, entries, work, factors,
):  # fmt: skip
    """Fill the `factors` (n,) of all unknowns; return the weight of the cost, and True unless all are one.

    `gradient` and `hessians` are the addresses of loops, `lower` and `upper` (n,) or empty, `kinds` (n,) the numbers of
    quantities. `counts` are bodies, steps, phases, linking variables, stride and node. `places` are the sampled
    intervals, `lacks` (places, element + shared) masks the unknowns that these lack. `entries` takes all second
    derivatives, `work` (3, n) vectors.
    """
    primal, inside, slopes, count, largest, is_moved = work[0], work[1], work[2], q.stated.size, 0.0, False
    for i in range(kinds.size):
        primal[i] = inside[i] = 0.0 if is_multiplier[i] else unknowns[i]
        largest = max(largest, abs(primal[i]))
        if lower.size:
            inside[i] = min(max(primal[i], lower[i]), upper[i])
    for j in range(ties.shape[0] if lower.size else 0):
        inside[ties[j, 0]] = inside[ties[j, 1]]
    fill(gradient, primal, steps, h, nodes, parameters, slopes)
    for i in range(kinds.size):
        slopes[i] = 0.0 if is_solution and is_multiplier[i] else abs(slopes[i])
        is_moved = is_moved or inside[i] != primal[i]
    size, rest = np.zeros(count), np.zeros(count)
    if is_moved:
        fill(gradient, inside, steps, h, nodes, parameters, factors)
        for i in range(kinds.size):
            if abs(factors[i]) < slopes[i] or np.isnan(slopes[i]):
                slopes[i] = abs(factors[i])
    for i in range(kinds.size):
        if q.is_equation[kinds[i]]:
            rest[kinds[i]] = max(rest[kinds[i]], slopes[i])
        elif not q.is_slack[kinds[i]] and abs(primal[i]) > NO_SIZE * largest:
            size[kinds[i]] = max(size[kinds[i]], abs(primal[i]))
    bound = limit_by_bounds(q, lower, upper, kinds, size)
    for j in range(count):
        if q.stated[j] > 0.0:
            size[j] = q.stated[j]
    tables = np.zeros((3, count, count))
    terms, effect, curvature = tables[0], tables[1], tables[2]
    fill(hessians, primal, steps, h, nodes, parameters, entries)
    measure_derivatives(q, counts, nodes, places, lacks, entries, terms, effect, curvature)
    if is_moved:
        other = np.zeros((3, count, count))
        fill(hessians, inside, steps, h, nodes, parameters, entries)
        measure_derivatives(q, counts, nodes, places, lacks, entries, other[0], other[1], other[2])
        for table in range(3):
            lessen(tables[table], other[table])
    add_couplings(q, counts, kinds, entries, terms, effect)
    balance(q, size, rest, effect)
    for j in range(count):
        size[j] = max(size[j], bound[j])
    equate_tied(q.tied, size)
    for i in range(count):
        if q.is_equation[i]:
            size[i] = 0.0
            for j in range(count):
                if not q.is_equation[j]:
                    size[i] = max(size[i], terms[i, j] * size[j])
            if size[i] == 0.0:
                size[i] = rest[i]
    equate_tied(q.tied, size)
    digits = digits_of(q, size)
    slope, curved = change_of_cost(q, slopes, kinds, size, curvature)
    is_steep = slope >= curved  # the first steps follow the slope, and could end on bounds
    weight = 1.0 / rounded(max(slope, curved), digits if is_steep else 6.0, is_steep)
    is_scaled = weight != 1.0
    for j in range(count):
        if not q.stated[j] > 0.0:
            size[j] = rounded(size[j], digits, q.is_single[j])
        is_scaled = is_scaled or size[j] != 1.0
        if q.is_equation[j]:
            size[j] = 1.0 / (size[j] * weight)
    for i in range(kinds.size):
        factors[i] = size[kinds[i]]
    return weight, is_scaled


@njit(error_model="numpy")
def limit_by_bounds(q, lower, upper, kinds, size):
    """Limit each `size` by two bounds; return the largest bounds of quantities that have one bound and no size."""
    bound, between = np.zeros(size.size), np.zeros(size.size)
    for i in range(lower.size):
        if not q.is_slack[kinds[i]]:
            smaller, larger = min(abs(lower[i]), abs(upper[i])), max(abs(lower[i]), abs(upper[i]))
            if larger < np.inf:
                between[kinds[i]] = max(between[kinds[i]], larger)
            elif smaller < np.inf:
                bound[kinds[i]] = max(bound[kinds[i]], smaller)
    for j in range(size.size):
        if between[j] > 0.0:
            size[j] = min(max(size[j], LEAST_OF_BOUNDS * between[j]), between[j]) if size[j] > 0.0 else between[j]
        if size[j] > 0.0 or q.stated[j] > 0.0:
            bound[j] = 0.0
    return bound


@njit(error_model="numpy")
def balance(q, size, rest, effect):
    """Give each unknown without a size the least size with which it balances an equation, until no more get one.

    `rest` are the residuals of the guess, `effect` (kinds, kinds) the changes of equations by smooth motions.
    """
    for _ in range(size.size):
        balanced, is_new = np.zeros(size.size), False
        for i in range(size.size):
            largest = rest[i]
            for j in range(size.size):
                largest = max(largest, effect[i, j] * size[j])
            for j in range(size.size):
                if size[j] == 0.0 and effect[i, j] > 0.0 and largest > 0.0:
                    balancing = min(largest / effect[i, j], q.radian[j])
                    balanced[j] = balancing if balanced[j] == 0.0 else min(balanced[j], balancing)
                    is_new = True
        if not is_new:
            return
        for j in range(size.size):
            if size[j] == 0.0:
                size[j] = balanced[j]


@njit(error_model="numpy")
def measure_derivatives(q, counts, nodes, places, lacks, entries, terms, effect, curvature):
    """Fill tables (kinds, kinds) of derivatives, from some intervals and from both ends.

    `terms` are the largest sums of moduli in one equation, by one quantity. `effect` is the largest change of an
    equation by the motion exp(t / T) of one quantity, which is neither constant nor linear. `curvature` are the sums of
    the cost's second derivatives. An equation of a node is a sum of shares of two intervals, both taken from the same
    interval. Each share, such as a momentum, is a term: its change by the motion does not depend on the interval's
    length.
    """
    bodies, steps, stride, node = counts[0], counts[1], counts[4], counts[5]
    intervals, count, element = steps // counts[2], q.rows.size, stride + node
    weight = max(1, intervals // SAMPLES)
    moduli, sums = np.zeros((q.local_kind.size, terms.shape[0])), np.zeros((q.local_kind.size, terms.shape[0]))
    starts, ends, growth = q.start_rows.size, q.end_rows.size, np.empty(5)
    for body in range(bodies):
        place = bodies * steps * count + body * starts
        for j in range(starts):
            value = abs(entries[place + j] + q.start_filling[j])
            add_entry(q, q.start_rows[j], q.start_columns[j], value, terms, effect, curvature)
        place = bodies * (steps * count + starts) + body * ends
        for j in range(ends):
            value = abs(entries[place + j])
            add_entry(q, q.end_rows[j], q.end_columns[j], value, terms, effect, curvature)
        for sample in range(places.size):
            k = places[sample]
            place, part = (body * steps + k) * count, nodes[k + 1] - nodes[k]  # of a mean length
            for i in range(5):  # abscissae are multiples of a half
                growth[i] = np.exp((0.5 * i - 1.0) * part / intervals)
            for i in range(moduli.shape[0]):
                for j in range(moduli.shape[1]):
                    moduli[i, j] = sums[i, j] = 0.0
            for j in range(count):
                row, column, value = q.rows[j], q.columns[j], entries[place + j]
                if q.local_multiplies[column]:
                    row, column = column, row
                if lacks[sample, row]:
                    continue
                of = q.local_kind[column]
                if q.local_multiplies[row] and not q.local_multiplies[column]:
                    moduli[row, of] += abs(value)
                    sums[row, of] += value * growth[int(2.0 * (q.abscissa[column] - q.abscissa[row])) + 2]
                elif not q.local_multiplies[row] and not q.only_at_ends[row]:
                    curvature[q.local_kind[row], of] += weight * abs(value) / part
            for row in range(q.local_kind.size):
                if not q.local_multiplies[row]:
                    continue
                kind, is_right = q.local_kind[row], stride <= row < element
                for of in range(terms.shape[0]):
                    change, modulus = sums[row, of], moduli[row, of]
                    if not (row < node or is_right):
                        terms[kind, of] = max(terms[kind, of], modulus)
                    elif abs(change) > CANCELLED * modulus:
                        terms[kind, of] = max(terms[kind, of], abs(change))
                    if row < node:
                        change += sums[stride + row, of]
                        modulus += moduli[stride + row, of]
                    if abs(change) > CANCELLED * modulus and not is_right:
                        effect[kind, of] = max(effect[kind, of], abs(change))


@njit(error_model="numpy")
def add_entry(q, row, column, value, terms, effect, curvature):
    """Add the modulus of a derivative by two unknowns, numbered as in a node, an interval and the linking variables."""
    if q.multiplies[column]:
        row, column = column, row
    if q.multiplies[column]:
        return
    kind, of = q.kind[row], q.kind[column]
    if q.multiplies[row]:
        terms[kind, of] = max(terms[kind, of], value)
        effect[kind, of] = max(effect[kind, of], value)
    else:
        curvature[kind, of] += value


@njit(error_model="numpy")
def add_couplings(q, counts, kinds, entries, terms, effect):
    """Add the derivatives of conditions between linking variables, which are linear in their multipliers."""
    root = counts[3]
    first, place = kinds.size - root, entries.size - root * root
    for i in range(root):
        for j in range(root):
            kind, of, value = kinds[first + i], kinds[first + j], abs(entries[place + i * root + j])
            if q.is_equation[kind] and not q.is_equation[of]:
                terms[kind, of] = max(terms[kind, of], value)
                effect[kind, of] = max(effect[kind, of], value)


@njit(error_model="numpy")
def lessen(table, other):
    """Fill `table` with the smaller of both entries, or with the entry that is not NaN."""
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            if other[i, j] < table[i, j] or np.isnan(table[i, j]):
                table[i, j] = other[i, j]


@njit(error_model="numpy")
def equate_tied(tied, size):
    """Give unknowns at the ends and the linking variables that they equal the largest of their sizes."""
    for _ in range(tied.shape[0]):
        for i in range(tied.shape[0]):
            one, other = tied[i, 0], tied[i, 1]
            size[one] = size[other] = max(size[one], size[other])


@njit(error_model="numpy")
def change_of_cost(q, slopes, kinds, size, curvature):
    """Return the largest changes of the cost, of first and of second order, by the size of one quantity everywhere.

    Both are sums over all intervals, and do not depend on the number of intervals. Controls without a slope of the cost
    at the guess count only for the second order.
    """
    slope, curved, total = 0.0, 0.0, np.zeros(size.size)
    for i in range(kinds.size):
        total[kinds[i]] += slopes[i]
    for i in range(size.size):
        if not q.is_equation[i]:
            slope = max(slope, total[i] * size[i])
            for j in range(size.size):
                curved = max(curved, curvature[i, j] * size[i] * size[j])
    return slope, curved


@njit(error_model="numpy")
def digits_of(q, size):
    """Return 6.0 if sizes divided by powers of a million are below 10^LARGE, otherwise 3.0."""
    for i in range(size.size):
        if LEAST < size[i] < 1.0 / LEAST and not q.stated[i] > 0.0:
            above = np.log10(size[i]) - SMALL
            if above - 6.0 * np.floor(above / 6.0) > LARGE - SMALL:
                return 3.0
    return 6.0


@njit(error_model="numpy")
def rounded(value, digits, finer):
    """Return the highest power of a million (`digits` are six) or of a thousand below about 30 times `value`, or one.

    With `finer` and three digits, 1, 100 and 10000 times a power of a million replace powers of a thousand.
    """
    if not LEAST < value < 1.0 / LEAST:
        return 1.0
    above = np.log10(value) - SMALL
    if finer and digits == 3.0:
        million = np.floor(above / 6.0)
        above -= 6.0 * million
        return 10.0 ** (6.0 * million + (0.0 if above < 3.0 else 2.0 if above < 5.0 else 4.0))
    return 10.0 ** (digits * np.floor(above / digits))
