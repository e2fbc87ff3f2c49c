"""Sensitivities: derivatives of a solution with respect to parameters, boundary values and a prescribed duration.

The optimality conditions G(y; p) = 0 remain satisfied as the data p change. The unknowns y therefore follow from K
dy/dp = -dG/dp with the KKT matrix K at the solution. The matrix is factored once, and each quantity takes one
substitution. The set of active bounds stays the same, and unknowns at active bounds move with these. The derivative of
the cost is the derivative of the Lagrangian (the envelope theorem). Sources: Fiacco (1983), Introduction to sensitivity
and stability analysis in nonlinear programming, chapter 3; Pirnay, Lopez-Negrete and Biegler (2012), Optimal
sensitivity based on IPOPT.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.addresses import call_system
from codegen.runtime.kkt.system import root_index
from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.grid import NONE, free_unknowns, plain_grid, views
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, filled_entries
from codegen.runtime.search.point import evaluate, fill, interval_parts
from codegen.runtime.search.scaling import scaled_grid
from codegen.runtime.search.solve import scaled_unknowns

# Pairs that are tried in turn: the scaled curvature that holds an unknown fixed, and the shift of the equations.
# Refinement corrects their effects. A larger curvature would hide that active bounds contradict equations.
ATTEMPTS = ((1e8, 0.0), (1e8, 1e-12), (1e6, 0.0))
LOOSE = 1e-12  # curvature of unknowns with inactive bounds, which makes the blocks of slacks regular
DOUBTFUL = 3e-5  # if the scaled multiplier and the scaled distance of a bound are both smaller, either may be zero
EXACT = 1e-10  # residual of the linear equations, relative to their terms, up to which no refinement is needed
LOST = 1e-8  # for a larger residual, there is no solution
SUBSTITUTIONS = 6  # largest number of substitutions for a quantity, including refinement
DEPENDENT = "equations, or active bounds, depend on each other at the solution"
SIGNS = np.where(np.random.default_rng(0).random(10_000) < 0.5, -1.0, 1.0)


class Sensitivities(NamedTuple):
    """Derivatives of a solution with respect to m quantities.

    Attributes
    ----------
    failure : str
        The reason why there are no derivatives, or "".
    cost, durations, times, unknowns : (m,), (m, D), (m, N + 1), (m, n)
        Derivatives of the cost, of the lengths of D phases, of the times of nodes, and of the unknowns.
    doubtful : array of int
        Indices of unknowns at bounds whose multipliers vanish.
    inaccuracy : float
        Residual of the linear equations relative to their terms.
    rates, grid_times : (m, bodies, P), (m, N + 1)
        Derivatives of the parameters, and of the times at which kernels are evaluated.
    """

    failure: str
    cost: np.ndarray
    durations: np.ndarray
    times: np.ndarray
    unknowns: np.ndarray
    doubtful: np.ndarray
    inaccuracy: float
    rates: np.ndarray
    grid_times: np.ndarray


def sensitivities(grid, unknowns, given=()):
    """Return the Sensitivities at a solution `unknowns` (n,).

    `given` are names of boundary values, or of the duration, that count as numbers of their own. Other boundary values
    follow parameters by the formulas of the problem. Raise ValueError for an unknown name.
    """
    grid, data, s = plain_grid(grid), grid.problem.data, grid.problem.structure
    for name in given:
        if name not in data.quantities:
            raise ValueError(f"{name!r} is none of {', '.join(data.quantities)}")
    scaled, (rates, duration) = scaled_grid(grid, unknowns), data.rates(grid, given)
    offsets, is_solved_for = data.pins(grid, rates), free_unknowns(grid).copy()
    is_held = is_bounded = np.zeros(unknowns.size, bool)
    doubtful = np.zeros(0, np.int64)
    if grid.problem.variable_bounds is not None:
        is_bounded, is_held, is_below, doubtful = active_bounds(grid, scaled, unknowns)
        is_solved_for &= ~is_held
        if data.bounds is not None:
            offsets[:, is_held] = 0.0
            for i in np.flatnonzero(rates[:, :, data.bounding].any(axis=(1, 2))):
                lower, upper = data.bounds(grid, rates[i])
                offsets[i, is_held] = np.where(is_below, lower, upper)[is_held]
    roots = np.sqrt(scaled.sizes * scaled.forces) if scaled.sizes.size else np.ones(unknowns.size)
    factors, times = np.where(is_solved_for, roots, 0.0), kernel_times(grid, rates, duration)
    moves = offsets.copy()
    follow_ties(s, grid.steps, offsets, moves)
    system = allocate_system(scaled)
    case = case_at(grid, unknowns, factors, system)
    changes, cost = changes_along(case, moves, rates, times)
    failure, best, inaccuracy = DEPENDENT, moves, np.inf
    for fast, shift in ATTEMPTS:
        diagonal = np.where(is_held, fast, np.where(is_bounded, LOOSE, np.where(grid.is_multiplier, -shift, 0.0)))
        excess = factor_kkt(scaled, scaled_unknowns(scaled, unknowns), 1.0, diagonal, system)
        if excess != 0:
            reason = "the solution is no strict local minimum" if excess is not None and excess > 0 else DEPENDENT
            failure = failure if inaccuracy <= LOST else reason
            continue
        solution, residual = solved_along(case, system, roots, offsets, (moves.copy(), rates, times), changes)
        if residual < inaccuracy:
            best, inaccuracy, failure = solution, residual, DEPENDENT if residual > LOST else ""
        if inaccuracy <= EXACT:
            break
    durations = data.durations(grid, unknowns, best, rates, duration)
    of_nodes = node_time_rates(grid, best, durations, times)
    return Sensitivities(failure, cost, durations, of_nodes, best, doubtful, inaccuracy, rates, times)


def active_bounds(grid, scaled, unknowns):
    """Return masks (n,) of unknowns with bounds, of unknowns at active bounds, and of unknowns at lower bounds.

    The fourth result is an array of indices of unknowns whose bound may or may not be active. A bound is active if its
    multiplier exceeds the distance to the bound, both scaled with the factors of the grid `scaled`.
    """
    sizes, forces = (scaled.sizes, scaled.forces) if scaled.sizes.size else (1.0, 1.0)
    is_primal, (lower, upper) = free_unknowns(grid) & ~grid.is_multiplier, bounds_of(grid)
    slope = np.where(is_primal, evaluate(grid, unknowns).gradient * forces, 0.0)
    below, above = (unknowns - lower) / sizes, (upper - unknowns) / sizes
    is_below, larger = slope > below, np.abs(slope)
    is_doubtful = np.minimum(np.maximum(larger, below), np.maximum(larger, above)) <= DOUBTFUL
    return np.minimum(below, above) < np.inf, is_below | (-slope > above), is_below, np.flatnonzero(is_doubtful)


def kernel_times(grid, rates, duration):
    """Return derivatives (m, N + 1) of the times at which kernels are evaluated.

    Nodes at inner times move with the inner times. `duration` (m,) has the derivatives of the duration.
    """
    s = grid.problem.structure
    if not s.inner_times:
        return duration[:, None] * (grid.nodes / grid.steps)
    nodes, times = [0, *grid.inner, grid.steps], np.zeros((len(duration), len(grid.inner) + 2))
    times[:, 1:-1], times[:, -1] = rates[:, 0, s.inner_first : s.inner_first + s.inner_times], duration
    return np.array([np.interp(grid.nodes, grid.nodes[nodes], row) for row in times])


def node_time_rates(grid, moves, durations, times):
    """Return derivatives (m, N + 1) of the times of all nodes; `times` is the result of `kernel_times`.

    `moves` (m, n) are derivatives of the unknowns, and `durations` (m, D) derivatives of the lengths of phases.
    """
    s, clock = grid.problem.structure, grid.problem.data.clock
    if clock is not None:
        return moves[:, clock : grid.steps * s.stride + s.node : s.stride]
    if s.inner_times:
        return times
    if s.phases:
        parts = grid.nodes / (grid.steps // s.phases) - np.arange(s.phases)[:, None]
        return durations @ np.clip(parts, 0.0, 1.0)
    return durations * (grid.nodes / grid.steps)


def follow_ties(s, steps, offsets, moves):
    """Set the derivatives `moves` (m, n) of those unknowns of end nodes that equal linking variables.

    They are the derivatives of the linking variables plus `offsets` (m, n).
    """
    pairs = s.ties(steps)
    if pairs.size:
        moves[:, pairs[:, 0]] = offsets[:, pairs[:, 0]] + moves[:, pairs[:, 1]]


class Case(NamedTuple):
    """Derivatives of the Lagrangian at a solution.

    Attributes
    ----------
    grid : Grid
        The grid in the problem's own units.
    factors : (n,)
        Scaling factors of derivatives of the gradient; zero for unknowns that are not solved for.
    gradient : (n,)
        The gradient of the Lagrangian, including prescribed unknowns.
    entries : array
        Second derivatives with respect to unknowns.
    filled : array
        The numbers that `DataDerivatives.loop` fills: derivatives with respect to data.
    begins : (N,)
        The number of the inner time at which each interval begins, or -1.
    """

    grid: NamedTuple
    factors: np.ndarray
    gradient: np.ndarray
    entries: np.ndarray
    filled: np.ndarray
    begins: np.ndarray


def case_at(grid, unknowns, factors, system):
    """Return the Case at `unknowns` (n,) in the problem's own units; `system` is storage for second derivatives."""
    s, data = grid.problem.structure, grid.problem.data
    of_interval, others = grid.problem.mixed[3]
    filled = np.empty(unknowns.size + grid.steps * of_interval + others)
    fill(data.loop.address, unknowns, grid.steps, grid.h, grid.nodes, grid.parameters, filled)
    # The loop fills the gradient of both ends and of conditions between linking variables.
    gradient, parts = filled[: unknowns.size], interval_parts(grid, unknowns)[:, :, :-1]
    nodes, intervals = views(grid, filled)
    nodes[:, :-1] += parts[:, :, : s.node]
    nodes[:, 1:] += parts[:, :, s.stride : s.element]
    intervals += parts[:, :, s.node : s.stride]
    if s.shared:
        np.add.at(gradient, gradient.size - s.root + s.root_indices(), parts[:, :, s.element :].sum(axis=1))
    begins = np.full(grid.steps, -1)
    begins[list(grid.inner)] = np.arange(len(grid.inner))
    return Case(grid, factors, gradient, filled_entries(grid, unknowns, system).copy(), filled, begins)


def changes_along(case, moves, rates, times):
    """Return derivatives of the gradient (m, n), times the factors of the case, and of the Lagrangian (m,).

    There is one derivative for each of m directions. In a direction, unknowns change by a row of `moves` (m, n),
    parameters by `rates` (m, bodies, P), and nodes by `times` (m, N + 1).
    """
    grid, data, s = case.grid, case.grid.problem.data, case.grid.problem.structure
    products, values = np.zeros_like(moves), moves @ case.gradient
    change_along(
        moves, rates, times, grid.steps, s.counts, case.entries, *s.entries, case.filled, *grid.problem.mixed[:3],
        data.acting, case.begins, products, values,
    )  # fmt: skip
    if s.couplings:
        first = moves.shape[1] - s.root
        by_data = case.filled[case.filled.size - (1 + s.root) * data.count :].reshape(1 + s.root, data.count)
        by_data = rates[:, 0] @ by_data[:, : data.parametric].T
        values += by_data[:, 0]
        matrix = case.entries[case.entries.size - s.root**2 :].reshape(s.root, s.root)
        products[:, first:] += moves[:, first:] @ matrix.T + by_data[:, 1:]
    pairs = s.ties(grid.steps)
    if pairs.size:
        np.add.at(products, (slice(None), pairs[:, 1]), products[:, pairs[:, 0]])
    multiply(products, case.factors)
    return products, values


@njit(cache=True, error_model="numpy", nogil=True)
def change_along(
    moves, rates, times, steps, system_counts, entries, entry_rows, entry_columns, filled, rows, columns, counts,
    acting, begins, products, values,
):  # fmt: skip
    """Add the changes of the gradient and of the Lagrangian in m directions to `products` (m, n) and `values` (m,).

    The contribution of an interval is read once for all directions. Most boundary values affect end intervals only. See
    `changes_along` and `DataDerivatives.tables` for the arguments.
    """
    bodies, element, stride, size = system_counts[0], system_counts[6], system_counts[7], moves.shape[1]
    node, count = element - stride, counts[0]
    moved, part = np.zeros(element + counts[2]), np.zeros(element + counts[2])
    data = np.zeros(count + node)
    place, at_data, first_entry, first_mixed = 0, size, 0, 0
    for kind in range(3):  # intervals, starts, ends
        width, mixed, slopes = system_counts[1 + kind], counts[5 + kind], count + (node if kind else 0)
        for body in range(bodies):
            for k in range(steps if kind == 0 else 1):
                interval = steps - 1 if kind == 2 else k
                first = body * (steps * stride + node) + interval * stride
                for d in range(len(moves)):
                    is_moved = read_moves(moves[d], first, body, system_counts, moved)
                    if kind == 0:
                        acts = read_data(rates[d, body], times[d, k], times[d, k + 1], counts, acting, begins[k], data)
                    else:
                        acts = read_end(rates[d, body], times[d, steps if kind == 2 else 0], counts, data)
                        for i in range(node):
                            data[count + i] = moved[stride + i if kind == 2 else i]
                    if not (is_moved or acts):
                        continue
                    add_changes(
                        entries, place, entry_rows, entry_columns, first_entry, width if is_moved else 0, filled,
                        at_data + slopes, rows, columns, first_mixed, mixed, moved, data, part,
                    )  # fmt: skip
                    for i in range(slopes):
                        values[d] += filled[at_data + i] * data[i]
                    for i in range(element):
                        products[d, first + i] += part[i]
                    for j in range(counts[2]):
                        index = size - system_counts[5] + root_index(system_counts[4], bodies, body, j)
                        products[d, index] += part[element + j]
                    part[:] = 0.0
                place += width
                at_data += slopes + mixed
        first_entry += width
        first_mixed += mixed


@njit(cache=True, error_model="numpy", nogil=True)
def multiply(products, factors):
    """Multiply `products` (m, n) by `factors` (n,).

    A factor of zero gives zero even if the product is not finite.
    """
    for d in range(len(products)):
        for i in range(factors.size):
            products[d, i] = factors[i] * products[d, i] if factors[i] != 0.0 else 0.0


@njit(error_model="numpy", forceinline=True)
def read_moves(vector, first, body, system_counts, moved):
    """Fill `moved` with the entries of `vector` (n,) for an element and for the linking variables of its body.

    The element begins at index `first`. Return True if any entry is nonzero.
    """
    element, is_moved = system_counts[6], False
    for i in range(element):
        moved[i] = vector[first + i]
        is_moved |= moved[i] != 0.0
    for j in range(moved.size - element):
        index = vector.size - system_counts[5] + root_index(system_counts[4], system_counts[0], body, j)
        moved[element + j] = vector[index]
        is_moved |= vector[index] != 0.0
    return is_moved


@njit(error_model="numpy", forceinline=True)
def read_data(rates, begin, end, counts, acting, inner, data):
    """Fill `data` of an interval with derivatives of parameters, of its time and length, and of values at inner times.

    `begin` and `end` are derivatives of the times of its nodes. `inner` is the number of the inner time at which the
    interval begins, or -1. Return True if any derivative is nonzero.
    """
    parametric, acts = counts[1], begin != 0.0 or end != 0.0
    for i in acting:
        data[i] = rates[i]
        acts = acts or data[i] != 0.0
    data[parametric] = begin
    data[parametric + 1] = end - begin
    for number in range(counts[0] - parametric - 2):
        data[parametric + 2 + number] = rates[counts[3] + (number + 1) * counts[4] + inner] if inner >= 0 else 0.0
        acts = acts or data[parametric + 2 + number] != 0.0
    return acts


@njit(error_model="numpy", forceinline=True)
def read_end(rates, time, counts, data):
    """Fill `data` of an end with derivatives of parameters and of the time of the end.

    Return True if any derivative is nonzero.
    """
    parametric, acts = counts[1], time != 0.0
    for i in range(parametric):
        data[i] = rates[i]
        acts = acts or data[i] != 0.0
    data[parametric] = time
    for i in range(parametric + 1, counts[0]):
        data[i] = 0.0
    return acts


@njit(error_model="numpy", forceinline=True)
def add_changes(
    entries, place, entry_rows, entry_columns, first_entry, width, filled, at_mixed, rows, columns, first_mixed, mixed,
    moved, data, part,
):  # fmt: skip
    """Add the change of an element's gradient to `part`.

    The change is the sum of second derivatives times the changes `moved` of unknowns, and mixed derivatives times the
    changes `data`. In `entries` and `filled`, both kinds of derivatives begin at `place` and `at_mixed`.
    """
    for j in range(width):
        row, column, value = entry_rows[first_entry + j], entry_columns[first_entry + j], entries[place + j]
        part[row] += value * moved[column]
        if row != column:
            part[column] += value * moved[row]
    for j in range(mixed):
        part[rows[first_mixed + j]] += filled[at_mixed + j] * data[columns[first_mixed + j]]


def solved_along(case, system, roots, offsets, directions, changes):
    """Return the derivatives of unknowns (m, n) for which the gradient does not change, and the relative residual.

    Substitutions are repeated until the change of the gradient is small relative to its terms. `directions` is a tuple
    of initial derivatives of the unknowns (m, n), of parameters and of times. `changes` (m, n) are the changes of the
    gradient for these. `offsets` see `follow_ties`; `roots` (n,) are the scaling factors of all unknowns.
    """
    moves, rates, times = directions
    s, steps, is_multiplier, inaccuracy = case.grid.problem.structure, case.grid.steps, case.grid.is_multiplier, np.inf
    solutions, sizes = np.empty_like(changes), np.empty((2, len(changes)))
    for _ in range(SUBSTITUTIONS):
        solve_all(
            system.address, steps, system.tables, changes, system.equations, system.factors, system.orders,
            system.inverses, system.counts, solutions,
        )  # fmt: skip
        add_steps(solutions, changes, roots, case.factors, is_multiplier, moves, sizes)
        follow_ties(s, steps, offsets, moves)
        # One scaled sum of all directions, with random signs, shows if any direction is inaccurate.
        weights = SIGNS[: len(moves)] / sizes[0]
        sums = [(weights @ each.reshape(len(each), -1)).reshape(1, *each.shape[1:]) for each in (moves, rates, times)]
        before, inaccuracy = inaccuracy, largest_residual(changes_along(case, *sums)[0][0], is_multiplier, sizes)
        if inaccuracy <= EXACT or not inaccuracy < 0.5 * before:
            break
        changes, _ = changes_along(case, moves, rates, times)
    return moves, inaccuracy


@njit(cache=True, error_model="numpy", nogil=True)
def solve_all(address, steps, tables, gradients, equations, factors, orders, inverses, counts, solutions):
    """Fill `solutions` (m, n) with the Newton steps for the `gradients` (m, n), with the factors of a linear system."""
    for d in range(len(gradients)):
        at = gradients[d].ctypes.data
        call_system(
            address, 0, counts[0], steps, inverses, tables.ctypes.data, at, at, at, equations, factors.ctypes.data,
            orders.ctypes.data, solutions[d].ctypes.data, 1,
        )  # fmt: skip


@njit(cache=True, error_model="numpy", nogil=True, fastmath={"nnan", "nsz", "reassoc"})
def add_steps(steps, changes, roots, factors, is_multiplier, moves, sizes):
    """Add `steps` (m, n) times `factors` (n,) to `moves` (m, n), and fill `sizes` (2, m) with the magnitudes of terms.

    The terms are the `changes` (m, n), and the moves divided by `roots` (n,). The first row of `sizes` has the largest
    term without multipliers, the second row the largest term with multipliers.
    """
    for d in range(len(moves)):
        largest, multiplier = 1e-300, 0.0
        for i in range(roots.size):
            moves[d, i] += factors[i] * steps[d, i]
            own, change = abs(moves[d, i] / roots[i]), abs(changes[d, i])
            primal, dual = (0.0, own) if is_multiplier[i] else (own, 0.0)
            largest = primal if primal > largest else largest
            largest = change if change > largest else largest
            multiplier = dual if dual > multiplier else multiplier
        sizes[0, d], sizes[1, d] = largest, max(largest, multiplier)


@njit(cache=True, error_model="numpy", nogil=True)
def largest_residual(residual, is_multiplier, sizes):
    """Return the largest modulus of a `residual` (n,) relative to `sizes` (2, m), or NaN if an entry is not finite.

    For equations, the residual is relative to terms without multipliers. Huge multipliers, as of contradictory
    equations, therefore do not hide a residual.
    """
    of_equations, remaining, ratio = 0.0, 0.0, 1.0
    for d in range(sizes.shape[1]):
        ratio = max(ratio, sizes[1, d] / sizes[0, d])
    for i in range(residual.size):
        if not abs(residual[i]) < np.inf:
            return np.nan
        if is_multiplier[i]:
            of_equations = max(of_equations, abs(residual[i]))
        else:
            remaining = max(remaining, abs(residual[i]))
    return max(of_equations, remaining / ratio)


def momentum_rates(grid, unknowns, derivatives, i):
    """Return derivatives (bodies, N + 1, ...) of the momenta at a solution with respect to quantity number i.

    `unknowns` (n,) is the solution, and `derivatives` are its Sensitivities. See `point.discrete_momenta`.
    """
    s, case = grid.problem.structure, case_at(grid, unknowns, NONE, allocate_system(grid))
    momenta = np.empty((s.bodies, grid.steps + 1, s.equations.size))
    momenta_along(
        derivatives.unknowns[i], derivatives.rates[i], derivatives.grid_times[i], grid.steps, s.counts, case.entries,
        *s.entries, case.filled, *grid.problem.mixed[:3], grid.problem.data.acting, case.begins, s.equations, momenta,
    )  # fmt: skip
    return momenta


@njit(cache=True, error_model="numpy", nogil=True)
def momenta_along(
    vector, rates, times, steps, system_counts, entries, entry_rows, entry_columns, filled, rows, columns, counts,
    acting, begins, equations, momenta,
):  # fmt: skip
    """Fill `momenta` (bodies, N + 1, m) with the derivatives of momenta in one direction.

    The direction is a change `vector` (n,) of unknowns, `rates` of parameters and `times` of nodes.
    """
    bodies, element, stride = system_counts[0], system_counts[6], system_counts[7]
    node, wide = element - stride, counts[0] + counts[5]
    moved, part, data = np.zeros(element + counts[2]), np.zeros(element + counts[2]), np.zeros(counts[0])
    for body in range(bodies):
        for k in range(steps):
            number = body * steps + k
            read_moves(vector, body * (steps * stride + node) + k * stride, body, system_counts, moved)
            read_data(rates[body], times[k], times[k + 1], counts, acting, begins[k], data)
            add_changes(
                entries, number * system_counts[1], entry_rows, entry_columns, 0, system_counts[1], filled,
                vector.size + number * wide + counts[0], rows, columns, 0, counts[5], moved, data, part,
            )  # fmt: skip
            for i in range(equations.size):
                momenta[body, k, i] = -part[equations[i]]
                momenta[body, k + 1, i] = part[stride + equations[i]]  # overwritten except for the last interval
            part[:] = 0.0
