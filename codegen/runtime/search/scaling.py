"""Autoscaling: scaling factors of unknowns, equations and cost, from values and derivatives at the initial guess.

Every quantity (a state at all nodes and stages, a control on all intervals, ...) has one scaling factor. A stage value
has the factor of its state. The equations of all stages have the factor of the equation for the step of this state. The
factors therefore depend neither on the scheme nor on the number of intervals.

1. If the author states a scale, this is the factor. Otherwise the factor is the largest modulus at the guess, which
   contains prescribed values. If a quantity has a lower and an upper bound, these limit the factor. An inequality in
   the square of an unknown without a factor, such as u^2 + w^2 <= 1, counts as two bounds. The guess of a slack does
   not count.
2. An unknown without a factor from rule 1 gets the least factor with which it balances an equation. For that, each
   equation is linearised at the guess and applied to a smooth motion of each quantity. For example, v = x' gives v the
   factor of x divided by the duration. An angle has a factor of at most one radian. If the unknown has a single bound,
   the factor is at least the modulus of this bound. If there is still no factor, the factor is one.
3. For equation i, |J_ij| times the factor of a quantity is summed over all unknowns j of this quantity, where J is the
   Jacobian. The largest of these sums is the factor of the equation.
4. The cost is divided by its largest change, of first or second order, when one quantity changes by its factor.
5. Factors are rounded to powers of a million if scaled numbers are then between 10^-1.5 and 10^2.9, otherwise to
   powers of a thousand. A problem whose factors are all one is not scaled.

Betts (2010), Practical methods for optimal control, section 4.8, recommends rule 1, and the same factor for a state and
its equation.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.grid import NONE
from codegen.runtime.search.point import fill

SAMPLES = 4  # number of intervals, in each phase, whose derivatives are used
SMALL, LARGE = -1.5, 2.9  # scaled numbers are between these powers of ten; these exponents avoid round numbers
LEAST_OF_BOUNDS = 0.3  # least factor of a quantity with two bounds, relative to the larger modulus of both
NO_SIZE = 1e-14  # numbers of the guess below this part of the largest number count as zero
CANCELLED = 1e-14  # a sum below this part of its absolute terms counts as a rounding error
LEAST = 1e-150  # factors are above LEAST and below 1 / LEAST


class Quantities(NamedTuple):
    """The quantities of a problem, which have numbers, and the number of the quantity of each unknown.

    Attributes
    ----------
    kind, multiplies : array
        The number of the quantity, and True for a multiplier. Both are for the unknowns of a node and an interval, then
        for the linking variables.
    local_kind, local_multiplies : array
        The same for the unknowns of an element, then for the linking variables.
    abscissa, only_at_ends : array
        For the same unknowns: the time in lengths of the interval, and True if only end nodes or nodes at inner times
        have the unknown.
    is_equation : array
        True for quantities that are multipliers.
    stated, radian : array
        The scale of each quantity that the author states, or zero; the value of one radian, or infinity for no angle.
    slacks, inequalities : array
        Slacks of an interval and the multipliers of their equations, numbered as the unknowns of an interval.
    is_slack, is_single : array
        True for slacks, and for linking variables that no unknown of a node equals, such as a free duration.
    tied : (k, 2)
        Pairs of quantities that equal each other at an end.
    rows, columns, start_rows, start_columns, end_rows, end_columns : array
        Rows and columns of the second derivatives of an interval and of both ends.
    start_filling : array
        One for each second derivative of the start that subtracts a filling one, see `Structure.fillings`; otherwise
        zero.
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
    slacks: np.ndarray
    inequalities: np.ndarray
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
    """Return the Quantities of a problem."""
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
        s.slacks.astype(np.int64), s.slack_multipliers.astype(np.int64), is_slack, is_single, tied.astype(np.int64),
        s.rows, s.columns, of_end(s.start_rows), of_end(s.start_columns),
        filling.astype(float), of_end(s.end_rows), of_end(s.end_columns),
    )  # fmt: skip


class Room(NamedTuple):
    """The work space of `fill_scaling_factors`, for n unknowns of k quantities.

    Attributes
    ----------
    of_unknowns : (6, n)
        Rows of numbers for all unknowns.
    of_kinds : (6, k or more)
        Rows of numbers for all quantities; at least five numbers a row.
    tables : (6, k, k)
        Derivatives, see `measure_derivatives`: terms, effect and curvature at one point, then at another.
    sums : (2, element + shared, k)
        Sums of derivatives in one interval.
    """

    of_unknowns: np.ndarray
    of_kinds: np.ndarray
    tables: np.ndarray
    sums: np.ndarray


def room_for(quantities, n):
    """Return the Room for a problem with these Quantities and `n` unknowns."""
    k = quantities.stated.size
    return Room(
        np.empty((6, n)), np.empty((6, max(k, 5))), np.empty((6, k, k)), np.empty((2, quantities.local_kind.size, k))
    )


def scaled_grid(grid, unknowns, is_solution=False):
    """Return `grid` with scaling factors of unknowns and cost, or without scaling factors if all are one.

    The `unknowns` (n,) are a guess, or with `is_solution` a solution, whose residuals are rounding errors. If a guess
    violates bounds, derivatives are evaluated at the guess and at the guess moved onto the bounds, and the smaller ones
    count. A model may be invalid outside its bounds, and the bounds may be far from the solution.
    """
    problem, s = grid.problem, grid.problem.structure
    if s.linear_quadratic:
        return grid
    steps, h, nodes, _, parameters, is_multiplier, *_ = grid
    q, bounds = quantities_of(problem), (NONE, NONE)
    kinds, places, lacks, counts = sampled(problem, steps, grid.inner)
    if problem.variable_bounds is not None:
        bounds = bounds_of(grid)
    factors = np.empty(unknowns.size)
    entries = np.zeros(s.entry_count(steps))  # loops do not fill the matrix of linking variables if it has no terms
    weight, is_scaled = fill_scaling_factors(
        q, problem.gradient.address, problem.hessians.address, steps, h, nodes, parameters, is_multiplier, unknowns,
        *bounds, s.ties(steps), kinds, counts, places, lacks, is_solution, entries,
        room_for(q, unknowns.size), factors,
    )  # fmt: skip
    if not is_scaled:
        return grid
    if problem.variable_bounds is None:
        return grid._replace(sizes=factors, forces=weight * factors, weight=weight)
    # Bounds of slacks below zero, which allow for rounding errors, are numbers without a unit.
    units = np.where(q.is_slack[kinds], 1.0, factors) if q.is_slack.any() else factors
    bounds = bounds[0] / units, bounds[1] / units
    return grid._replace(sizes=factors, forces=weight * factors, weight=weight, bounds=bounds)


def slacks(grid):
    """Return a mask (n,) of the unknowns of a grid that are slacks."""
    return quantities_of(grid.problem).is_slack[sampled(grid.problem, grid.steps, grid.inner)[0]]


@lru_cache(maxsize=8)
def sampled(problem, steps, inner):
    """Return data for the scaling factors on a grid with nodes at `inner` times: kinds, places, lacks, counts.

    `kinds` (n,) are the numbers of the quantities of all unknowns. `places` are the indices of the intervals whose
    derivatives are used: some of each phase, and those after inner times. `lacks` (places, element + shared) masks the
    unknowns that these intervals lack. `counts` are six numbers that the compiled functions read.
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
    places, lacks, is_solution, entries, room, factors,
):  # fmt: skip
    """Fill the `factors` (n,) of all unknowns; return the weight of the cost, and True unless all factors are one.

    `gradient` and `hessians` are the addresses of loops. `lower` and `upper` are (n,), or empty without bounds. `kinds`
    (n,) are the numbers of quantities. `counts` are numbers of bodies, intervals, phases and linking variables, then
    stride and node. `places` are the indices of the sampled intervals, and `lacks` (places, element + shared) masks the
    unknowns that these lack. `entries`, for all second derivatives, and `room` are work space.
    """
    primal, inside, slopes = room.of_unknowns[0], room.of_unknowns[1], room.of_unknowns[2]
    count, largest, is_moved = q.stated.size, 0.0, False
    size, rest, bound = room.of_kinds[0, :count], room.of_kinds[1, :count], room.of_kinds[2, :count]
    for j in range(count):
        size[j] = rest[j] = 0.0
    for i in range(kinds.size):
        primal[i] = inside[i] = 0.0 if is_multiplier[i] else unknowns[i]
        largest = max(largest, abs(primal[i]))
        if lower.size:
            inside[i] = min(max(primal[i], lower[i]), upper[i])
    for j in range(ties.shape[0] if lower.size else 0):
        inside[ties[j, 0]] += inside[ties[j, 1]] - primal[ties[j, 1]]
    fill(gradient, primal, steps, h, nodes, parameters, slopes)
    for i in range(kinds.size if q.slacks.size else 0):
        room.of_unknowns[3, i] = slopes[i]
    for i in range(kinds.size):
        slopes[i] = 0.0 if is_solution and is_multiplier[i] else abs(slopes[i])
        is_moved = is_moved or inside[i] != primal[i]
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
    limit_by_bounds(q, lower, upper, kinds, size, bound, room.of_kinds[3, :count])
    for j in range(count):
        if q.stated[j] > 0.0:
            size[j] = q.stated[j]
        elif q.slacks.size and size[j] == 0.0 and not (q.is_equation[j] or q.is_slack[j]):
            limit_by_squares(
                q, counts, places, lacks, gradient, steps, h, nodes, parameters, primal, room.of_unknowns[3:6], kinds,
                factors, size, rest, j,
            )  # fmt: skip
            if size[j] > 0.0:
                bound[j] = 0.0
    terms, effect, curvature = room.tables[0], room.tables[1], room.tables[2]
    fill(hessians, primal, steps, h, nodes, parameters, entries)
    measure_derivatives(q, counts, nodes, places, lacks, entries, room, terms, effect, curvature)
    if is_moved:
        fill(hessians, inside, steps, h, nodes, parameters, entries)
        measure_derivatives(
            q, counts, nodes, places, lacks, entries, room, room.tables[3], room.tables[4], room.tables[5]
        )
        for table in range(3):
            lessen(room.tables[table], room.tables[3 + table])
    add_couplings(q, counts, kinds, entries, terms, effect)
    balance(q, size, rest, effect, room.of_kinds[3, :count])
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
    for j in range(count):
        if size[j] == 0.0 and not q.is_equation[j]:
            size[j] = 1.0  # by rule 2; the cost may depend on this unknown alone
    digits = digits_of(q, size)
    slope, curved = change_of_cost(q, slopes, kinds, size, curvature, room.of_kinds[3, :count])
    is_steep = slope >= curved  # then the first steps follow the slope, and could end on bounds
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
def limit_by_bounds(q, lower, upper, kinds, size, bound, between):
    """Limit the factor `size` of each quantity with two bounds by these, or set it if it is zero.

    For each quantity with one bound and without a factor, `bound` takes the modulus of the bound. It takes zero for
    others. `between` is work space.
    """
    for j in range(size.size):
        bound[j] = between[j] = 0.0
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


@njit(error_model="numpy")
def limit_by_squares(
    q, counts, places, lacks, gradient, steps, h, nodes, parameters, primal, rows, kinds, point, size, rest, j
):  # fmt: skip
    """Set the factor `size` of quantity j, which is zero at the guess, by inequalities in its square.

    An inequality g <= 0 that holds at the guess, and whose second derivative by the quantity is c > 0, limits the
    quantity to sqrt(-2 g / c). The factor is the smallest limit of all inequalities, each with its largest limit in the
    sampled intervals. It stays zero without a limit. The value of g is the magnitude of the slack, and counts as a
    residual of the guess in `rest`.

    The second derivative is the second difference of gradients at which the quantity is zero and plus or minus the
    `probe`. The first of the `rows` (3, n) is the gradient at `primal`. The other rows and `point` (n,) are work space.
    """
    bodies, probe, smallest = counts[0], 0.0, np.inf
    for pair in range(q.slacks.size):
        for body in range(bodies):
            for sample in range(places.size):
                _, margin = margin_of(q, counts, places, lacks, primal, rows[0], pair, body, sample)
                probe = max(probe, np.sqrt(margin))
    if probe == 0.0:
        return
    for side in range(2):
        for i in range(primal.size):
            point[i] = primal[i] + (probe * (1.0 - 2.0 * side) if kinds[i] == j else 0.0)
        fill(gradient, point, steps, h, nodes, parameters, rows[1 + side])
    for pair in range(q.slacks.size):
        largest = 0.0
        for body in range(bodies):
            for sample in range(places.size):
                i, margin = margin_of(q, counts, places, lacks, primal, rows[0], pair, body, sample)
                bend = rows[1, i] + rows[2, i] - 2.0 * rows[0, i]
                if margin > 0.0 and bend > CANCELLED * margin:
                    largest = max(largest, probe * np.sqrt(2.0 * margin / bend))
                    rest[kinds[i]] = max(rest[kinds[i]], margin)
        if largest > 0.0:
            smallest = min(smallest, largest)
    if smallest < np.inf:
        size[j] = smallest


@njit(error_model="numpy")
def margin_of(q, counts, places, lacks, primal, residuals, pair, body, sample):
    """Return the index of the equation of an inequality g <= 0 in a sampled interval, and max(0, -g) at the guess."""
    steps, stride, node, k = counts[1], counts[4], counts[5], places[sample]
    first = (body * steps + k) * stride + body * node
    i, slack = first + q.inequalities[pair], first + q.slacks[pair]
    margin = primal[slack] - residuals[i]
    return i, margin if margin > 0.0 and not lacks[sample, q.inequalities[pair]] else 0.0


@njit(error_model="numpy")
def balance(q, size, rest, effect, balanced):
    """Give each unknown without a factor the least factor with which it balances an equation.

    The rule is repeated until no more unknowns get a factor. `size` are the factors of quantities, zero for none.
    `rest` are the residuals of the guess, and `effect` (kinds, kinds) the changes of equations by smooth motions.
    `balanced` is work space.
    """
    for _ in range(size.size):
        is_new = False
        for j in range(size.size):
            balanced[j] = 0.0
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
def measure_derivatives(q, counts, nodes, places, lacks, entries, room, terms, effect, curvature):
    """Fill tables (kinds, kinds) of derivatives from sampled intervals and from both ends.

    Entry (i, j) of `terms` is the largest sum of |J_ij| in one equation of kind i, over the unknowns of quantity j.
    Entry (i, j) of `effect` is the largest change of an equation by the motion exp(t / T) of quantity j, which is
    neither constant nor linear. `curvature` has the sums of the cost's second derivatives.

    The equation of a node is a sum of contributions of two intervals. Both are taken from the same interval. Each
    contribution, such as a momentum, counts as one term: its change by the motion does not depend on the length of the
    interval. The same holds for the equation of a stage with the factor of such an equation.
    """
    bodies, steps, stride, node = counts[0], counts[1], counts[4], counts[5]
    intervals, count, element = steps // counts[2], q.rows.size, stride + node
    weight = max(1, intervals // SAMPLES)
    moduli, sums, is_of_node, growth = room.sums[0], room.sums[1], room.of_kinds[4], room.of_kinds[5]
    starts, ends = q.start_rows.size, q.end_rows.size
    for i in range(terms.shape[0]):
        is_of_node[i] = 0.0
        for j in range(terms.shape[0]):
            terms[i, j] = effect[i, j] = curvature[i, j] = 0.0
    for row in range(node):
        is_of_node[q.local_kind[row]] = 1.0 if q.local_multiplies[row] else 0.0
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
            place, part = (body * steps + k) * count, nodes[k + 1] - nodes[k]  # length in mean lengths
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
                    if is_of_node[kind] == 0.0 and not is_right:
                        terms[kind, of] = max(terms[kind, of], modulus)
                    elif abs(change) > CANCELLED * modulus:
                        terms[kind, of] = max(terms[kind, of], abs(change))
                    if row < node:
                        change += sums[stride + row, of]
                        modulus += moduli[stride + row, of]
                    if abs(change) > CANCELLED * modulus and (row < node or not (is_right or is_of_node[kind] > 0.0)):
                        effect[kind, of] = max(effect[kind, of], abs(change))


@njit(error_model="numpy")
def add_entry(q, row, column, value, terms, effect, curvature):
    """Add the modulus `value` of one second derivative of an end to the tables of `measure_derivatives`.

    The two unknowns `row` and `column` are numbered as in a node, an interval and the linking variables.
    """
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
    """Add the derivatives of conditions between linking variables to the tables of `measure_derivatives`.

    The conditions are linear in their multipliers.
    """
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
    """Replace each entry of `table` by the smaller entry of both tables, or by the entry that is not NaN."""
    for i in range(table.shape[0]):
        for j in range(table.shape[1]):
            if other[i, j] < table[i, j] or np.isnan(table[i, j]):
                table[i, j] = other[i, j]


@njit(error_model="numpy")
def equate_tied(tied, size):
    """Set the factors of quantities that equal each other at an end to the largest of these factors."""
    for _ in range(tied.shape[0]):
        for i in range(tied.shape[0]):
            one, other = tied[i, 0], tied[i, 1]
            size[one] = size[other] = max(size[one], size[other])


@njit(error_model="numpy")
def change_of_cost(q, slopes, kinds, size, curvature, total):
    """Return the largest changes of the cost, of first and of second order, if one quantity changes by its factor.

    The quantity changes at all nodes or intervals. Both changes are sums over all intervals, and do not depend on the
    number of intervals. Controls without a slope of the cost at the guess count only for the second order. `total` is
    work space.
    """
    slope, curved = 0.0, 0.0
    for j in range(size.size):
        total[j] = 0.0
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
    """Return 6.0 if all factors can be rounded to powers of a million, otherwise 3.0 for powers of a thousand.

    Powers of a million suffice if the factors divided by them are below 10^LARGE.
    """
    for i in range(size.size):
        if LEAST < size[i] < 1.0 / LEAST and not q.stated[i] > 0.0:
            above = np.log10(size[i]) - SMALL
            if above - 6.0 * np.floor(above / 6.0) > LARGE - SMALL:
                return 3.0
    return 6.0


@njit(error_model="numpy")
def rounded(value, digits, finer):
    """Return the highest power of a million or of a thousand below about 30 times `value`, or one for extreme values.

    `digits` is 6.0 for powers of a million and 3.0 for powers of a thousand. With `finer` and 3.0, the result is 1, 100
    or 10000 times a power of a million.
    """
    if not LEAST < value < 1.0 / LEAST:
        return 1.0
    above = np.log10(value) - SMALL
    if finer and digits == 3.0:
        million = np.floor(above / 6.0)
        above -= 6.0 * million
        return 10.0 ** (6.0 * million + (0.0 if above < 3.0 else 2.0 if above < 5.0 else 4.0))
    return 10.0 ** (digits * np.floor(above / digits))
