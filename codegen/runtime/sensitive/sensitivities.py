"""Sensitivities: derivatives of a solution by parameters, boundary values and a given duration.

The optimality conditions G(y; p) = 0 stay zero as data p change, so that unknowns y follow by K dy/dp = -dG/dp, with
the KKT matrix K at the solution: it is factored once, and each quantity takes one substitution. Bounds that hold are
held: their unknowns move as the bounds do, and the others as if the set of active bounds stayed the same. Sources:
Fiacco (1983), Introduction to sensitivity and stability analysis in nonlinear programming, chapter 3; Pirnay,
Lopez-Negrete and Biegler (2012), Optimal sensitivity based on IPOPT.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.kkt.system import factor_kkt
from codegen.runtime.kkt.unbordered import allocate_system
from codegen.runtime.optimise.scaled_solve import scaled_grid
from codegen.runtime.sensitive.directions import change_along, momenta_along
from codegen.runtime.sensitive.substitutions import LANES, substitute_all
from codegen.runtime.stand_ins.example import (
    BODIES, END_SHARED, END_TIED, EQUATIONS, INEQUALITIES, INNER_FIRST, INNER_TIMES, NODE, PHASES, ROOT, START_SHARED,
    START_TIED, STRIDE, TIED, variable_bounds,
)  # fmt: skip
from codegen.runtime.stand_ins.example_mixed import (
    BOUNDING, CLOCK, CLOCKED, MOVING, QUANTITIES, VARIATIONAL, bound_rates, data_rates, duration_rates, pinned_rates,
)  # fmt: skip
from codegen.runtime.unknowns.layout import free_unknowns
from codegen.runtime.unknowns.point import evaluate
from codegen.runtime.unknowns.shared import root_index
from codegen.runtime.unknowns.time_grid import plain_grid

# Curvatures, in parts of sizes, that hold an unknown, and shifts of equations: the first that do are taken. What they
# change is left to refinement. Larger curvatures would hide that active bounds contradict the equations.
ATTEMPTS = ((1e8, 0.0), (1e8, 1e-12), (1e6, 0.0))
LOOSE = 1e-12  # curvature of what has bounds that do not hold, which makes the blocks of slacks regular
DOUBTFUL = 3e-5  # in parts of sizes: where multiplier and distance of a bound are both below, either may be zero
EXACT = 1e-10  # what substitutions may leave of linear equations, in parts of their terms
LOST = 1e-8  # what tells that there is no solution
SUBSTITUTIONS = 6  # for a quantity at most: refinement, where one leaves more
DEPENDENT = "equations, or active bounds, depend on each other at the solution"
SIGNS = np.where(np.random.default_rng(0).random(10_000) < 0.5, -1.0, 1.0)


class Sensitivities(NamedTuple):
    """Derivatives by all m QUANTITIES, if there is no `failure`, which says why there are none.

    Of the `cost` (m,), the `durations` (m, D) of D phases, the `times` (m, N + 1) and `unknowns` (m, n). `doubtful` are
    indices of unknowns at bounds whose multipliers vanish; `inaccuracy` is what is left of the linear equations, in
    parts of their terms. Data follow by `rates` (m, BODIES, PARAMETRIC) of parameters and `grid_times` (m, N + 1).
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
    """Sensitivities at a solution `unknowns` (n,); quantities that are `given` by name follow no others.

    ValueError where a name is none of QUANTITIES.
    """
    for name in given:
        if name not in QUANTITIES:
            raise ValueError(f"{name!r} is none of {', '.join(QUANTITIES)}")
    grid = plain_grid(grid)
    scaled, (rates, duration) = scaled_grid(grid, unknowns), data_rates(grid, given)
    moves, is_solved_for = pinned_rates(grid, rates), free_unknowns(grid).copy()
    is_held = is_bounded = np.zeros(unknowns.size, bool)
    doubtful = np.zeros(0, np.int64)
    if INEQUALITIES:
        is_bounded, is_held, is_below, doubtful = active_bounds(grid, scaled, unknowns)
        is_solved_for = is_solved_for & ~is_held
        if MOVING:
            moves[:, is_held] = 0.0
            for i in np.flatnonzero(rates[:, :, BOUNDING].any(axis=(1, 2))):
                lower, upper = bound_rates(grid, rates[i])
                moves[i, is_held] = np.where(is_below, lower, upper)[is_held]
    offsets = moves.copy()
    if TIED:
        follow_ties(grid.steps, offsets, moves)
    roots = np.sqrt(scaled.sizes * scaled.forces) if scaled.sizes.size else np.ones(unknowns.size)
    parts, times = np.where(is_solved_for, roots, 0.0), kernel_times(grid, rates, duration)
    case = Case(grid, scaled, unknowns, roots, parts, offsets, rates, times)
    changes, cost = np.zeros((padded_count(len(moves)), unknowns.size)), np.empty(len(moves))
    fill_changes(case, moves, rates, times, changes, cost)
    failure, best, inaccuracy = DEPENDENT, moves, np.inf
    for fast, shift in ATTEMPTS:
        system = allocate_system(grid)
        diagonal = np.where(is_held, fast, np.where(is_bounded, LOOSE, np.where(grid.is_multiplier, -shift, 0.0)))
        reason = factored(scaled, unknowns, diagonal, system)
        if reason:
            failure = failure if inaccuracy <= LOST else reason
            continue
        found, left = solved_along(case, system, moves.copy(), changes)
        if left < inaccuracy:
            best, inaccuracy, failure = found, left, DEPENDENT if left > LOST else ""
        if inaccuracy <= EXACT:
            break
    durations = duration_rates(grid, unknowns, best, rates, duration)
    times = node_time_rates(grid, best, durations, case.times)
    return Sensitivities(failure, cost, durations, times, best, doubtful, inaccuracy, rates, case.times)


class Case(NamedTuple):
    """A solution `unknowns` (n,) on a grid, and on the same one with sizes; and how data move.

    The scaled system has its unknowns and rows in parts of `roots` (n,), as in `parts`, which are zero by what is not
    solved for. Data move by `rates` (m, BODIES, PARAMETRIC) of parameters, `times` (m, N + 1) of nodes, `offsets`
    (m, n) of what is given or held.
    """

    grid: NamedTuple
    scaled: NamedTuple
    unknowns: np.ndarray
    roots: np.ndarray
    parts: np.ndarray
    offsets: np.ndarray
    rates: np.ndarray
    times: np.ndarray


def padded_count(count):
    """How many right-hand sides are solved for, to have so many."""
    return -(-count // LANES) * LANES


def fill_changes(case, moves, rates, times, changes, values):
    """Fill derivatives of the gradient, `changes` (>= m, n), in the scaled system, and of the Lagrangian, `values`."""
    grid = case.grid
    data = case.unknowns, grid.steps, grid.h, grid.nodes, grid.parameters
    change_along(*data, moves, rates, times, case.parts, changes, values)


def solved_along(case, system, moves, changes):
    """What follows data, `moves` (m, n), by substitutions until the changes of the gradient vanish, at first `changes`.

    The second result is what is left of these, in parts of their terms.
    """
    steps, sizes, is_multiplier = np.empty_like(changes), np.empty((2, len(moves))), case.grid.is_multiplier
    sum_of_changes, value, inaccuracy = np.empty((1, case.roots.size)), np.empty(1), np.inf
    for substitution in range(SUBSTITUTIONS):
        substitute_all(changes, case.grid.steps, system[0], steps)
        add_steps(steps, changes, case.roots, case.parts, is_multiplier, moves, sizes)
        if TIED:
            follow_ties(case.grid.steps, case.offsets, moves)
        # One sum of all, in parts of their sizes and with signs at random, tells whether any is inaccurate.
        weights, every = SIGNS[: len(moves)] / sizes[0], (moves, case.rates, case.times)
        sums = [(weights @ each.reshape(len(moves), -1)).reshape(1, *each.shape[1:]) for each in every]
        fill_changes(case, *sums, sum_of_changes, value)
        before, inaccuracy = inaccuracy, largest_left(sum_of_changes[0], is_multiplier, sizes)
        if inaccuracy <= EXACT or not inaccuracy < 0.5 * before:
            break
        if substitution == 0:
            changes = np.zeros_like(changes)  # the first ones are those of other factors, too
        fill_changes(case, moves, case.rates, case.times, changes, np.empty(len(moves)))
    return moves, inaccuracy


@njit(cache=True, error_model="numpy", fastmath={"nnan", "nsz", "reassoc"})
def add_steps(steps, changes, roots, parts, is_multiplier, moves, sizes):
    """Add `steps` (>= m, n) times `parts` (n,) to `moves` (m, n); fill `sizes` (2, m) of what adds up in rows.

    They are those of the largest of the `changes` (>= m, n) and of moves, in parts of `roots` (n,), without and with
    multipliers.
    """
    for d in range(len(moves)):
        largest, multiplier = 1e-300, 0.0
        for i in range(roots.size):
            moves[d, i] += parts[i] * steps[d, i]
            own, change = abs(moves[d, i] / roots[i]), abs(changes[d, i])
            primal, dual = (0.0, own) if is_multiplier[i] else (own, 0.0)
            largest = primal if primal > largest else largest
            largest = change if change > largest else largest
            multiplier = dual if dual > multiplier else multiplier
        sizes[0, d], sizes[1, d] = largest, max(largest, multiplier)


@njit(cache=True, error_model="numpy")
def largest_left(left, is_multiplier, sizes):
    """The largest modulus of what is `left` (n,), in parts of `sizes` (2, m); NaN where any is.

    Multipliers without limit, as of equations that contradict each other, take no part in equations.
    """
    of_equations, remaining, ratio = 0.0, 0.0, 1.0
    for d in range(sizes.shape[1]):
        ratio = max(ratio, sizes[1, d] / sizes[0, d])
    for i in range(left.size):
        if not abs(left[i]) < np.inf:
            return np.nan
        if is_multiplier[i]:
            of_equations = max(of_equations, abs(left[i]))
        else:
            remaining = max(remaining, abs(left[i]))
    return max(of_equations, remaining / ratio)


def node_time_rates(grid, moves, durations, times):
    """Derivatives (m, N + 1) of the times of all nodes; `times` are those that inner times tell."""
    if CLOCKED:
        return moves[:, CLOCK : grid.steps * STRIDE + NODE : STRIDE]
    if INNER_TIMES:
        return times
    if PHASES:
        parts = grid.nodes / (grid.steps // PHASES) - np.arange(PHASES)[:, None]
        return durations @ np.clip(parts, 0.0, 1.0)
    return durations * (grid.nodes / grid.steps)


def factored(scaled, unknowns, diagonal, system):
    """Factor the KKT matrix with a diagonal added; return why there are no factors, or nothing."""
    excess = factor_kkt(scaled, unknowns / scaled.sizes if scaled.sizes.size else unknowns, 1.0, diagonal, system)
    if excess is None or excess < 0:
        return DEPENDENT
    return "the solution is no strict local minimum" if excess > 0 else ""


if INEQUALITIES:

    def active_bounds(grid, scaled, unknowns):
        """Masks (n,) of unknowns with bounds, of those that these hold, also from below, and indices of doubtful ones.

        A bound holds where its multiplier is larger than the distance from it, both in parts of sizes.
        """
        ones = np.ones(unknowns.size)
        sizes, forces = (scaled.sizes, scaled.forces) if scaled.sizes.size else (ones, ones)
        gradient, masks = evaluate(grid, unknowns).gradient, np.zeros((4, unknowns.size), bool)
        is_chosen = free_unknowns(grid) & ~grid.is_multiplier
        compare_with_bounds(unknowns, gradient, *variable_bounds(grid), sizes, forces, is_chosen, masks)
        is_bounded, is_held, is_below, is_doubtful = masks
        return is_bounded, is_held, is_below, np.flatnonzero(is_doubtful)

    @njit(cache=True, error_model="numpy")
    def compare_with_bounds(unknowns, gradient, lower, upper, sizes, forces, is_chosen, masks):
        """Fill `masks` (4, n): of what has bounds, of what is held, of what is held from below, of what is doubtful."""
        for i in range(unknowns.size):
            slope = gradient[i] * forces[i] if is_chosen[i] else 0.0
            below, above = (unknowns[i] - lower[i]) / sizes[i], (upper[i] - unknowns[i]) / sizes[i]
            masks[0, i] = min(below, above) < np.inf
            masks[1, i] = slope > below or -slope > above
            masks[2, i] = slope > below
            masks[3, i] = min(max(abs(slope), below), max(abs(slope), above)) <= DOUBTFUL


if TIED:

    @njit(cache=True, error_model="numpy")
    def follow_ties(steps, offsets, moves):
        """Let unknowns of the ends move with the shared ones that they equal, but for `offsets` (m, n)."""
        shared = moves.shape[1] - ROOT
        for body in range(BODIES):
            first = body * (steps * STRIDE + NODE)
            last = first + steps * STRIDE
            for d in range(len(moves)):
                for i in range(START_SHARED.size):
                    own = moves[d, shared + root_index(body, START_SHARED[i])]
                    moves[d, first + START_TIED[i]] = offsets[d, first + START_TIED[i]] + own
                for i in range(END_SHARED.size):
                    own = moves[d, shared + root_index(body, END_SHARED[i])]
                    moves[d, last + END_TIED[i]] = offsets[d, last + END_TIED[i]] + own


def kernel_times(grid, rates, duration):
    """Derivatives (m, N + 1) of the times of nodes, of which those at inner times move as these do."""
    if INNER_TIMES:
        nodes, times = [0, *grid.inner, grid.steps], np.zeros((len(duration), len(grid.inner) + 2))
        times[:, 1:-1], times[:, -1] = rates[:, 0, INNER_FIRST : INNER_FIRST + INNER_TIMES], duration
        return np.array([np.interp(grid.nodes, grid.nodes[nodes], row) for row in times])
    return duration[:, None] * (grid.nodes / grid.steps)


if VARIATIONAL:

    def momentum_rates(grid, unknowns, found, i):
        """Derivatives (BODIES, N + 1, ...) by quantity i of the momenta at a solution `unknowns` (n,)."""
        momenta = np.empty((BODIES, grid.steps + 1, EQUATIONS.size))
        data = unknowns, grid.steps, grid.h, grid.nodes, grid.parameters
        momenta_along(*data, found.unknowns[i], found.rates[i], found.grid_times[i], momenta)
        return momenta
