"""Many problems of one module that differ in their numbers only: one compiled call solves one after the other.

The compiled function `solve_cases` holds no lock of the Python interpreter. Threads that each solve a block of cases
therefore work side by side. For each case, it does what `solve.optimise_from` does for a search that succeeds at once:
scaling factors, Newton's steps, the tests of the solution, and the corrected cost. A case that needs more, such as a
restoration, other scaling factors or another guess, is marked. It is then solved from the beginning by `solve_on`.

`solve_cases` calls `descent.descend` and other large functions by the addresses of their machine code. Their code would
otherwise be compiled a second time as part of this function.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import config, njit, types

from codegen.runtime.addresses import address_of_compiled, calling_compiled
from codegen.runtime.kernels import is_kept
from codegen.runtime.search import descent, direction, first_iterate, optimality, workspace
from codegen.runtime.search.cascade import WORSE, clip
from codegen.runtime.search.grid import NONE, layout_of, least_duration
from codegen.runtime.search.iterates import FROM_GUESS, count_bounds, fill_bounds, keep_storage, search_on
from codegen.runtime.search.linear_system import factor_at, fill_entry_factors, solve_at
from codegen.runtime.search.messages import describe
from codegen.runtime.search.optimality import is_small_compiled
from codegen.runtime.search.point import Point, fill, measured_gradient
from codegen.runtime.search.scaling import Quantities, Room, fill_scaling_factors, quantities_of, room_for, sampled
from codegen.runtime.search.shooting import kept_unknowns, like_unknowns, shooting_grid
from codegen.runtime.search.solve import (
    LARGE_CORRECTION,
    LOOSE,
    NEGLIGIBLE,
    ROUNDED,
    ROUNDINGS,
    SLOW,
    STEEP,
    STEEPER,
    STEEPER_COST,
    correction,
    optimise,
)
from codegen.runtime.search.stacks import LONGEST_STATUS, SOLVED, Optima, Optimum, Stack
from codegen.runtime.search.termination import GROWTH
from codegen.runtime.search.workspace import (
    COST,
    DISTANCE,
    DUALS,
    ERROR,
    IS_COSTLESS,
    ITERATIONS,
    RESIDUAL,
    SCALED,
    STAGE,
    STATIONARITY,
    VIOLATION,
    G,
    X,
)

SHORTEST, FUNNEL = FROM_GUESS.shortest, FROM_GUESS.funnel
VERIFIED = 10.0  # largest residual and stationarity of a solution that is evaluated again, relative to the tolerance


class Common(NamedTuple):
    """The common data of all cases of a batch: of the search, and of the problem with stages.

    Attributes
    ----------
    problem, with_stages : tuple of int
        Addresses of the loops for gradient and second derivatives and of the linear system, of the problem that is
        searched. Addresses of the loops for gradient and second derivatives of the problem with stages, and of the loop
        that computes stages. The last is zero if the search has the stages itself.
    quantities : Quantities
        See `scaling`.
    steps : int
        The number of intervals.
    nodes : (N + 1,)
        Times of the nodes in mean lengths of an interval.
    is_multiplier, all_are_multiplier : (n,), (m,)
        Masks of multipliers, among the n unknowns of the search and among all m unknowns with stages.
    ties, all_ties, is_free, fillings, durations : array
        See `iterates.arguments_of`.
    kinds, counts, places, lacks : array
        See `scaling.sampled`.
    is_slack : (m,)
        Mask of slacks.
    kept, like : (n,), (m,)
        Indices of the unknowns of the search among all unknowns, and for each of all unknowns the index of one of the
        search with the same quantity. Both are 0, 1, 2, ... if the search has the stages itself.
    local_is_multiplier, without_cost : array
        See `linear_system.with_entry_factors`.
    is_linear, is_costless, is_scaled : bool
        True for a linear-quadratic problem, for a problem without a cost, and for automatic scaling factors.
    """

    problem: tuple[int, int, int]
    with_stages: tuple[int, int, int]
    quantities: Quantities
    steps: int
    nodes: np.ndarray
    is_multiplier: np.ndarray
    all_are_multiplier: np.ndarray
    ties: np.ndarray
    all_ties: np.ndarray
    is_free: np.ndarray
    fillings: np.ndarray
    durations: np.ndarray
    kinds: np.ndarray
    counts: np.ndarray
    places: np.ndarray
    lacks: np.ndarray
    is_slack: np.ndarray
    kept: np.ndarray
    like: np.ndarray
    local_is_multiplier: np.ndarray
    without_cost: np.ndarray
    is_linear: bool
    is_costless: bool
    is_scaled: bool


class Numbers(NamedTuple):
    """The numbers of k cases.

    Attributes
    ----------
    h : (k,)
        Mean lengths of an interval.
    parameters : (k, bodies, P)
        Parameters, see `Grid`.
    guesses : (k, n)
        The guesses of a search, in the problem's own units.
    lower, upper : (k, m)
        Least and greatest values of all unknowns; (k, 0) without bounds.
    """

    h: np.ndarray
    parameters: np.ndarray
    guesses: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


class Space(NamedTuple):
    """The work space of a batch.

    Attributes
    ----------
    system : tuple
        Storage of the linear system, see `descent.descend`.
    reals, integers, vectors, barriers, pairs, refinement, log : array
        See `descent.descend`; `refinement` is (0, n).
    entries, factors, room : array, (3, m), Room
        Space for all second derivatives with stages, for scaling factors, and for their computation.
    own : (4, n)
        Space for sizes, forces, least and greatest values of the unknowns of the search.
    entry_factors : (2, ..)
        Space for scaling factors of second derivatives.
    bound_indices, bounds : (b,), (3, b)
        Space for all b finite bounds.
    """

    system: tuple[object, ...]
    reals: np.ndarray
    integers: np.ndarray
    vectors: np.ndarray
    barriers: np.ndarray
    pairs: np.ndarray
    refinement: np.ndarray
    log: np.ndarray
    entries: np.ndarray
    factors: np.ndarray
    room: Room
    own: np.ndarray
    entry_factors: np.ndarray
    bound_indices: np.ndarray
    bounds: np.ndarray


class Found(NamedTuple):
    """The results of a batch for k cases.

    Attributes
    ----------
    is_found : (k,)
        True if the case is solved, False if it has to be solved by itself. Before the search: True for usable numbers.
    unknowns : (k, n)
        The unknowns of the search, in the problem's own units.
    sizes, weights : (k, m), (k,)
        Scaling factors of all unknowns and of the cost; sizes are ones for a case without scaling factors.
    costs, stationarities : (k,)
        The cost, corrected to first order for the residuals, and the stationarity. The stationarity is the change of
        the cost if unknowns change by their scaling factors.
    iterations : (k,)
        Numbers of iterations.
    """

    is_found: np.ndarray
    unknowns: np.ndarray
    sizes: np.ndarray
    weights: np.ndarray
    costs: np.ndarray
    stationarities: np.ndarray
    iterations: np.ndarray


_FIVE = types.UniTuple(types.float64, 5)
call_descend = calling_compiled(types.int64)
call_begin_beside = calling_compiled(types.none)
call_scaling = calling_compiled(types.Tuple((types.float64, types.boolean)))
call_clip = calling_compiled(_FIVE)
call_terms = calling_compiled(types.UniTuple(types.float64, 2))


@njit(cache=True, error_model="numpy", nogil=True)
def solve_cases(calls, common, numbers, tolerance, limit, is_warm, space, found):
    """Solve all cases in turn, and fill `found`.

    Parameters
    ----------
    calls : tuple of int
        Addresses of `descend`, `begin_beside`, `fill_scaling_factors`, `clip` and `terms`.
    common, numbers, space, found : Common, Numbers, Space, Found
        The common data of the cases, their numbers, work space, and the results.
    tolerance, limit, is_warm : float, int, bool
        Tolerance, largest number of iterations of a case, and True if guesses are solutions of similar problems.
    """
    for case in range(numbers.h.size):
        found.is_found[case] = found.is_found[case] and is_case_solved(
            case, calls, common, numbers, tolerance, limit, is_warm, space, found
        )


@njit(error_model="numpy")
def is_case_solved(case, calls, common, numbers, tolerance, limit, is_warm, space, found):
    """Solve one case and fill its row of `found`; return False if the case has to be solved by itself."""
    reals, integers, vectors, system, sizes = (
        space.reals,
        space.integers,
        space.vectors,
        space.system,
        space.factors[0],
    )
    x, guess, parameters, h = (vectors[X], numbers.guesses[case], numbers.parameters[case], numbers.h[case])
    lower, upper, n, kept = (numbers.lower[case], numbers.upper[case], x.size, common.kept)
    weight, is_scaled = 1.0, False
    if common.is_scaled:
        weight, is_scaled = factors_at(calls, common, h, parameters, guess, lower, upper, False, space, sizes)
    found.weights[case] = weight
    for i in range(sizes.size):
        found.sizes[case, i] = sizes[i] if is_scaled else 1.0
    own_sizes, forces = space.own[0, : n if is_scaled else 0], space.own[1, : n if is_scaled else 0]
    for i in range(own_sizes.size):
        own_sizes[i] = sizes[kept[i]]
        forces[i] = weight * own_sizes[i]
    scaled, costless = own_sizes[:0], common.without_cost
    if is_scaled:
        fill_entry_factors(
            own_sizes, forces, system[9], system[10], common.local_is_multiplier, common.without_cost, system[7],
            space.entry_factors,
        )  # fmt: skip
        scaled, costless = space.entry_factors[0], space.entry_factors[1]
    system = (
        system[0], system[1], system[2], system[3], scaled, costless, system[6], system[7], system[8], system[9],
        system[10],
    )  # fmt: skip
    least, greatest = space.own[2, : n if lower.size else 0], space.own[3, : n if lower.size else 0]
    for i in range(least.size):
        unit = 1.0 if common.is_slack[kept[i]] or not is_scaled else own_sizes[i]
        least[i], greatest[i] = lower[kept[i]] / unit, upper[kept[i]] / unit
        if least[i] > greatest[i]:
            return False
    indices, side, magnitude, value = space.bound_indices, space.bounds[0], space.bounds[1], space.bounds[2]
    if count_bounds(least, greatest) != indices.size:
        return False
    fill_bounds(least, greatest, indices, side, magnitude, value)
    bounds = indices, side, magnitude, value, least, greatest
    grid = (
        common.steps, h, common.nodes, parameters, common.is_multiplier, own_sizes, forces, weight, common.ties,
        common.is_free, common.fillings, common.durations,
    )  # fmt: skip
    for i in range(n):
        x[i] = guess[i] / own_sizes[i] if is_scaled else guess[i]
    if common.is_linear:
        is_solved = is_solved_by_newton_steps(calls, common, grid, system, tolerance, space)
    else:
        is_solved = is_solved_at_once(calls, common, grid, system, bounds, tolerance, limit, is_warm, space)
    if not is_solved:
        return False
    found.iterations[case], found.stationarities[case] = (integers[ITERATIONS], reals[STATIONARITY] / weight)
    for i in range(n - system[7][5], n):  # linking variables, such as a free duration, may grow without limit
        if not abs(x[i]) <= GROWTH:
            return False
    solution = found.unknowns[case]
    for i in range(n):
        solution[i] = x[i] * own_sizes[i] if is_scaled else x[i]
        if not common.is_free[i]:
            solution[i] = guess[i]
    for j in range(common.ties.shape[0]):
        i, other = common.ties[j, 0], common.ties[j, 1]
        solution[i] += solution[other] - guess[other]
    if is_scaled and are_other_factors(
        calls, common, h, parameters, solution, lower, upper, weight, space
    ):  # fmt: skip
        return False
    by = 0.0 if common.is_linear else correction(x, vectors[G], common.is_multiplier, least, greatest)
    if abs(by) > LARGE_CORRECTION * abs(reals[COST]):
        by = 0.0
    found.costs[case] = (reals[COST] + by) / weight
    return True


@njit(error_model="numpy")
def factors_at(calls, common, h, parameters, unknowns, lower, upper, is_solution, space, sizes):
    """Fill the scaling factors `sizes` (m,) at the `unknowns` (n,) of a search; return what `scaled_grid` uses."""
    whole = space.factors[2]
    for i in range(sizes.size):
        whole[i] = unknowns[common.like[i]]
    return call_scaling(
        calls[2],
        (
            common.quantities, common.with_stages[0], common.with_stages[1], common.steps, h, common.nodes, parameters,
            common.all_are_multiplier, whole, lower, upper, common.all_ties, common.kinds, common.counts, common.places,
            common.lacks, is_solution, space.entries, space.room, sizes,
        ),
    )  # fmt: skip


@njit(error_model="numpy")
def are_other_factors(calls, common, h, parameters, unknowns, lower, upper, weight, space):
    """Return True if scaling factors at a solution are much larger than those at the guess, see `optimise_from`."""
    begin, sizes, finer = (space.vectors[workspace.TRIAL], space.factors[0], space.factors[1])
    for i in range(unknowns.size):
        is_negligible = abs(unknowns[i]) < NEGLIGIBLE * sizes[common.kept[i]]
        begin[i] = 0.0 if common.is_multiplier[i] or is_negligible else unknowns[i]
    finer_weight, is_scaled = factors_at(calls, common, h, parameters, begin, lower, upper, True, space, finer)
    for i in common.kept:
        force = finer_weight * finer[i] if is_scaled else 1.0
        if force > (STEEPER if common.all_are_multiplier[i] else STEEPER_COST) * weight * sizes[i]:
            return True
    return False


@njit(error_model="numpy")
def is_solved_at_once(calls, common, grid, system, bounds, tolerance, limit, is_warm, space):
    """Search from the unknowns in the work space as `newton.descend` does; return True if the search succeeds at once.

    The iterate, with unknowns inside their bounds, stays in the work space.
    """
    reals, integers, vectors, barriers = (space.reals, space.integers, space.vectors, space.barriers)
    problem, x, g, is_bounded = (common.problem, vectors[X], vectors[G], bounds[0].size > 0)
    reals[:] = 0.0
    integers[:] = 0
    reals[workspace.LEAST_RELAXATION], integers[IS_COSTLESS] = (direction.LEAST_RELAXED, common.is_costless)
    reals[workspace.SHORTEST], reals[workspace.FUNNEL] = SHORTEST, FUNNEL
    if is_warm:
        call_begin_beside(calls[1], (problem, grid, bounds, tolerance, reals, integers, vectors, barriers))
        integers[STAGE] = workspace.WITH_ITERATE
    else:
        for i in range(x.size):
            if common.is_multiplier[i]:
                x[i] = 0.0
        weight, reals[workspace.PUSH] = first_iterate.AT_GUESS
        reals[workspace.MU] = weight if is_bounded else 0.0
        integers[workspace.LOOKS], integers[STAGE] = 1, workspace.WITH_UNKNOWNS
    status = workspace.CONTINUE
    while status == workspace.CONTINUE and integers[ITERATIONS] < limit:
        status = call_descend(
            calls[0],
            (
                problem, grid, system, bounds, tolerance, limit, space.log.shape[0] - 1, reals, integers, vectors,
                barriers, space.pairs, space.refinement, space.log,
            ),
        )  # fmt: skip
    if status != workspace.SOLVED:
        return False
    known = (reals[COST], reals[RESIDUAL], reals[VIOLATION], reals[STATIONARITY], reals[ERROR])
    if is_bounded:
        inside = call_clip(calls[3], (problem, grid, bounds, known, barriers[DISTANCE], barriers[DUALS], vectors, x, g))
        if not inside[4] <= max(tolerance, WORSE * known[4]):
            return False
        reals[COST], reals[RESIDUAL], reals[STATIONARITY] = (inside[0], inside[1], inside[3])
        if 0.0 < abs(reals[COST]) < tolerance / LOOSE:  # the search continues with a smaller tolerance
            return False
    return reals[STATIONARITY] <= STEEP and reals[RESIDUAL] <= ROUNDED


@njit(error_model="numpy")
def is_solved_by_newton_steps(calls, common, grid, system, tolerance, space):
    """Solve a linear-quadratic problem as `solve.solve_linear_quadratic` does; return True on success."""
    steps, h, nodes, parameters, is_multiplier, sizes, _, _, _, _, _, _ = grid
    tables, factors, orders, entries, scaled, _, inverses, counts, equations, _, _ = system
    problem, reals, vectors = common.problem, space.reals, space.vectors
    x, g, step, none, spare = (
        vectors[X],
        vectors[G],
        vectors[workspace.STEP],
        vectors[workspace.DIAGONAL],
        vectors[SCALED],
    )
    none[:] = 0.0
    for iteration in range(4):
        measures = measured_gradient(
            problem[0], x, sizes, 1.0, steps, h, nodes, parameters, is_multiplier, spare[:0], g
        )
        if not measures[4] < np.inf:
            return False
        if iteration == 0:
            excess = factor_at(
                problem[1], problem[2], x, sizes, spare, scaled, steps, h, nodes, parameters, tables, entries, g, none,
                equations, factors, orders, inverses, counts, step, True, True,
            )  # fmt: skip
            if excess != 0:
                return False
        else:
            of_equations, of_slopes = call_terms(calls[4], (problem, grid, system, x, int(common.is_costless), vectors))
            is_closed = is_small_compiled(measures[1], of_equations, tolerance, ROUNDINGS)
            if is_closed and is_small_compiled(measures[3], of_slopes, tolerance, ROUNDINGS):
                reals[COST], reals[RESIDUAL], reals[STATIONARITY] = (measures[0], measures[1], measures[3])
                space.integers[ITERATIONS] = iteration
                for i in range(x.size):  # the Lagrangian is the cost at the nearby point where the equations hold
                    reals[COST] += x[i] * g[i] if is_multiplier[i] else 0.0
                return True
            solve_at(problem[2], steps, tables, g, equations, factors, orders, inverses, counts, step)
        for i in range(x.size):
            x[i] += step[i]
    return False


@njit(cache=True, error_model="numpy", nogil=True)
def verify_cases(common, numbers, tolerance, found, gradient, whole, residuals):
    """Evaluate all solutions again, and fill `whole` and `residuals`; see `is_case_verified`."""
    for case in range(found.is_found.size):
        if found.is_found[case]:
            found.is_found[case] = is_case_verified(case, common, numbers, tolerance, found, gradient, whole, residuals)


@njit(error_model="numpy")
def is_case_verified(case, common, numbers, tolerance, found, gradient, whole, residuals):
    """Evaluate a solution again, in the problem's own units and with stages; return True if its equations hold.

    Row `case` of `whole` (k, m) has all unknowns: with stages if the search has none, otherwise they are given.
    `residuals` (k,) are the largest moduli of residuals. Residual and stationarity may not exceed VERIFIED times the
    tolerance, in scaled units. `gradient` (m,) is work space.
    """
    x, parameters, h = whole[case], numbers.parameters[case], numbers.h[case]
    if common.with_stages[2] != 0:
        fill(common.with_stages[2], found.unknowns[case], common.steps, h, common.nodes, parameters, x)
    measures = measured_gradient(
        common.with_stages[0], x, gradient[:0], 1.0, common.steps, h, common.nodes, parameters,
        common.all_are_multiplier, gradient[:0], gradient,
    )  # fmt: skip
    residuals[case], worst = measures[1], 0.0
    for i in range(x.size):
        error = abs(gradient[i]) * found.weights[case] * found.sizes[case, i]
        if numbers.lower.shape[1] and not common.all_are_multiplier[i]:
            # A slope of the Lagrangian is permitted at a bound beyond which the cost falls.
            below, above = (x[i] - numbers.lower[case, i], numbers.upper[case, i] - x[i])
            distance = (below if gradient[i] > 0.0 else above) / found.sizes[case, i]
            error *= min(max(distance, 0.0), 1.0)
        worst = max(worst, error)
    return worst <= VERIFIED * tolerance


class Options(NamedTuple):
    """The options of the searches of all cases, see `solution.solve_on`.

    `on_device` is None, or the function `cuda.batches.solve_cases`, which solves the cases on a GPU.
    """

    tolerance: float
    max_iterations: int
    is_warm: bool
    scaling: str
    on_device: Callable[..., None] | None = None


def solve_grids(grids, guesses, options, log):
    """Find a local minimum on each of several grids; return a list of Optimum.

    The optima are those that `solution.solve_on` finds.

    Parameters
    ----------
    grids : list of Grid
        Grids of one problem, with as many intervals.
    guesses : list of (m,)
        Unknowns of initial guesses, with prescribed values.
    options : Options
        The options of all searches.
    log : callable
        () -> Log, for a case that is solved by itself.
    """
    results = [None] * len(grids)
    for alike in groups(grids):
        of_group = solve_stack(stacked([grids[i] for i in alike], [guesses[i] for i in alike]), options, log)
        for number, i in enumerate(alike):
            results[i] = of_group.one(number)
    return results


def groups(grids):
    """Return lists of indices of grids that differ in their numbers only: same nodes, and as many parameters."""
    found = {}
    for i, grid in enumerate(grids):
        nodes = b"" if grid.is_uniform else grid.nodes.tobytes()
        found.setdefault((grid.steps, nodes, grid.inner, grid.parameters.shape), []).append(i)
    return list(found.values())


def stacked(grids, guesses):
    """Return the Stack of grids of one group."""
    k, lower = len(grids), np.empty((len(grids), 0))
    upper, problem = lower, grids[0].problem
    if problem.variable_bounds is not None:
        bounds = [problem.variable_bounds(grid) for grid in grids]
        lower, upper = (np.array([own[side] for own in bounds]) for side in (0, 1))
    return Stack(
        grids[0], np.ones(k, bool), np.array([float(grid.h) for grid in grids]),
        np.array([grid.parameters for grid in grids]), np.array(guesses), lower, upper,
    )  # fmt: skip


def solve_stack(stack, options, log):
    """Find a local minimum of each case of a Stack with usable numbers; return Optima.

    `options` and `log` are explained in `solve_grids`.
    """
    tolerance, max_iterations, is_warm, scaling, _ = options
    whole, residuals, found = solve_at_once(stack, options)
    problem, is_found = stack.grid.problem, found.is_found
    if problem.metadata.relaxation and not is_warm:
        is_found[:] = False  # without the continuation a search ends at a poor minimum
    messages = {}
    status = np.where(is_found, SOLVED, "").astype(LONGEST_STATUS)
    optima = Optima(status, found.costs, residuals, found.stationarities, found.iterations, whole, messages)
    if problem.structure.shared or stack.lower.shape[1] or problem.inputs is not None:
        for case in np.flatnonzero(is_found).tolist():
            status[case], messages[case] = described(stack, optima, case)
    for case in np.flatnonzero(stack.is_usable & (status == "")).tolist():
        grid, guess = stack.grid_of(case), np.array(stack.guesses[case])
        of_case, message, point, iterations, _ = optimise(
            grid, guess, tolerance, max_iterations, is_warm, scaling, log()
        )
        optima.put(
            case,
            Optimum(of_case, message, point.cost, point.residual, point.stationarity, iterations, point.unknowns),
        )
    return optima


def described(stack, optima, case):
    """Return status and message of a case that has been found; two empty texts if a free duration is not positive."""
    problem, grid, unknowns = stack.grid.problem, stack.grid_of(case), optima.unknowns[case]
    if problem.structure.shared and not least_duration(grid, unknowns) > 0.0:
        return "", ""
    if stack.lower.shape[1]:
        grid = grid._replace(bounds=(stack.lower[case], stack.upper[case]))
    residual, stationarity = float(optima.residual[case]), float(optima.stationarity[case])
    point = Point(unknowns, NONE, float(optima.cost[case]), residual, np.nan, stationarity, max(residual, stationarity))
    return describe(grid, unknowns, point, SOLVED)


def solve_at_once(stack, options):
    """Search once for each case of a Stack; return all unknowns (k, m), residuals (k,) and the Found."""
    grid, k, lower = stack.grid, stack.h.size, stack.lower
    problem, m, n = grid.problem, grid.is_multiplier.size, 0
    if lower.shape[1]:
        grid = grid._replace(bounds=problem.variable_bounds(grid))
    guesses = stack.guesses
    if problem.shooting is not None:
        guesses = guesses[:, kept_unknowns(problem.structure, grid.steps)]
    numbers = Numbers(stack.h, stack.parameters, guesses, lower, stack.upper)
    search = search_on(shooting_grid(grid))
    common, n = common_of(grid, search, options.scaling), search.grid.is_multiplier.size
    found = Found(
        np.array(stack.is_usable), np.empty((k, n)), np.empty((k, m)), np.ones(k), np.empty(k), np.empty(k),
        np.zeros(k, np.int64),
    )  # fmt: skip
    space, limit = space_for(grid, search), min(SLOW, options.max_iterations)
    whole, residuals = found.unknowns if problem.shooting is None else np.empty((k, m)), np.empty(k)
    common_arguments = options.tolerance, limit, options.is_warm, space, found
    if options.on_device is not None:
        options.on_device(grid, common, numbers, *common_arguments, whole, residuals)
    else:
        numbers = Numbers(*map(np.ascontiguousarray, numbers))
        calls = calls_of(search, common, numbers, space, options.tolerance)
        solve_cases(calls, common, numbers, *common_arguments)
        verify_cases(common, numbers, options.tolerance, found, np.empty(m), whole, residuals)
    keep_storage(search)
    return whole, residuals, found


def space_for(grid, search):
    """Return the Space of a batch; `grid` has stages, and `search` is on the grid of a search."""
    work, problem, m = search.work, grid.problem, grid.is_multiplier.size
    n, bounds, own = search.grid.is_multiplier.size, search.bounds.indices.size, search.grid.problem.structure
    return Space(
        search.arguments[2], work.reals, work.integers, work.vectors, work.barriers, work.pairs, np.empty((0, n)),
        work.log, np.zeros(problem.structure.entry_count(grid.steps)), np.empty((3, m)),
        room_for(quantities_of(problem), m), np.empty((4, n)), np.empty((2, own.without_cost.size)),
        np.empty(bounds, np.int64), np.empty((3, bounds)),
    )  # fmt: skip


def common_of(grid, search, scaling):
    """Return the common data of all cases; `grid` has stages, and `search` is on the grid of a search."""
    problem, s, steps, searched = (grid.problem, grid.problem.structure, grid.steps, search.grid)
    kinds, places, lacks, counts = sampled(problem, steps, grid.inner)
    is_whole, everything = problem.shooting is None, np.arange(grid.is_multiplier.size)
    own = searched.problem.structure
    return Common(
        search.arguments[0],
        (problem.gradient.address, problem.hessians.address, 0 if is_whole else problem.shooting.stages.address),
        quantities_of(problem), steps, grid.nodes, searched.is_multiplier, grid.is_multiplier, own.ties(steps),
        s.ties(steps), layout_of(searched).is_free, own.fillings(steps), own.free_durations(steps), kinds, counts,
        places, lacks, quantities_of(problem).is_slack[kinds],
        everything if is_whole else kept_unknowns(s, steps),
        everything if is_whole else like_unknowns(problem, steps), own.local_is_multiplier, own.without_cost,
        bool(own.linear_quadratic), bool(own.costless), scaling == "auto" and not own.linear_quadratic,
    )  # fmt: skip


def is_ready():
    """Return True if machine code of `solve_cases` is on the disk, or if numba is switched off."""
    return bool(config.DISABLE_JIT) or is_kept(solve_cases.py_func)


ADDRESSES: list[tuple[int, ...]] = []
"""The addresses of the functions that `solve_cases` calls; empty before the first batch."""


def calls_of(search, common, numbers, space, tolerance):
    """Return the addresses of the functions that `solve_cases` calls.

    The arguments are examples. The types of their parts are the same for all problems, and so are the addresses.
    """
    if ADDRESSES:
        return ADDRESSES[0]
    problem, grid, system, bounds = search.arguments
    reals, integers, vectors, barriers = space.reals, space.integers, space.vectors, space.barriers
    duals, lower = barriers[DUALS], numbers.lower[0]
    arguments = (
        (descent.descend, (
            problem, grid, system, bounds, tolerance, 1, 1, reals, integers, vectors, barriers, space.pairs,
            space.refinement, space.log,
        )),
        (first_iterate.begin_beside, (problem, grid, bounds, tolerance, reals, integers, vectors, barriers)),
        (fill_scaling_factors, (
            common.quantities, *common.with_stages[:2], common.steps, 1.0, common.nodes, numbers.parameters[0],
            common.all_are_multiplier, space.factors[0], lower, lower, common.all_ties, common.kinds, common.counts,
            common.places, common.lacks, True, space.entries, space.room, space.factors[0],
        )),
        (clip, (problem, grid, bounds, (0.0,) * 5, duals, duals, vectors, vectors[X], vectors[G])),
        (optimality.terms, (problem, grid, system, vectors[X], 1, vectors)),
    )  # fmt: skip
    ADDRESSES.append(tuple(address_of_compiled(function, given) for function, given in arguments))
    return ADDRESSES[0]
