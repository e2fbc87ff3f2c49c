"""Iterates of a search: initial iterates, and the parts of a Newton step that Python code needs.

The Newton loop itself is compiled, see `descent`. Restorations, the last steps without relaxed bounds and the choice of
starts call the functions of this module.

In problems with contact forces, products of forces and gaps are at most epsilon, the parameter `relaxation`. The grid
has its final value. A search begins with a large relaxation and reduces it whenever the weight mu of the barrier falls,
so that one path of optima leads to the solution. Source: Raghunathan and Biegler (2005), An interior point method for
mathematical programs with complementarity constraints (MPCCs), SIAM Journal on Optimization 15.
"""

import math
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.search import direction, first_iterate, optimality, workspace
from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.direction import LEAST_RELAXED
from codegen.runtime.search.first_iterate import LARGEST_DUAL
from codegen.runtime.search.grid import NONE, Grid, layout_of, multiplier_unknowns, with_pinned_values
from codegen.runtime.search.linear_system import System, allocate_system, with_entry_factors
from codegen.runtime.search.point import Point, evaluate, lagrangian
from codegen.runtime.search.structure import NO_INDICES
from codegen.runtime.search.workspace import COST, DISTANCE, DUALS, MU, G, X

LARGEST_KEPT = 4_000_000  # largest number of floats of a storage that is kept between searches: 32 MB


FIRST = 1e8  # relaxation at the weight AT, relative to the final relaxation
AT = 0.1
LEAST = 1e-9  # largest weight with the final relaxation, unless the tolerance is larger


class Relaxation(NamedTuple):
    """The relaxation of a search: its values (nodes,) among the parameters of the grid, and its `final` value."""

    values: np.ndarray
    final: float

    def at(self, mu, tolerance):
        """Return the relaxation for the weight `mu` of the barrier."""
        least = max(LEAST, tolerance)
        power = math.log(FIRST) / math.log(AT / least)
        return self.final * max(1.0, (mu / least) ** power)

    def follow(self, mu, tolerance):
        """Set the relaxation for the weight `mu`."""
        self.values[:] = self.at(mu, tolerance)


def relaxation_of(grid):
    """Return (grid, Relaxation) for a grid with contact forces, otherwise (grid, None).

    The grid returned has its own parameters, so that the relaxation of the argument stays final.
    """
    metadata = grid.problem.metadata
    if not metadata.relaxation:
        return grid, None
    column = list(metadata.parameters).index(metadata.relaxation)
    grid = grid._replace(parameters=grid.parameters.copy())
    values = grid.parameters[:, column]
    return grid, Relaxation(values, float(values[0]))


class Attempt(NamedTuple):
    """The settings of one search in the cascade of searches from several starts.

    Attributes
    ----------
    weight, push : float
        The first weight of the barrier, and the least distance of unknowns to their bounds at the start.
    nearby : float
        The part of the constraint violation at the guess that may remain when the search begins; a restoration lowers
        the violation to this part. With 1 there is no restoration.
    shortest : float
        The least step length. If shorter steps are needed, a restoration follows.
    funnel : float
        The factor by which the violation may grow.
    bulge : float
        The height of a curve that is added to the guess, relative to the magnitude of each quantity.
    on_path : bool
        True if duals begin on the central path, False if they begin at one.
    """

    weight: float
    push: float
    nearby: float
    shortest: float
    funnel: float
    bulge: float = 0.0
    on_path: bool = False


FROM_GUESS = Attempt(*first_iterate.AT_GUESS, 1.0, 1e-12, 1e4)
NEARBY = FROM_GUESS._replace(nearby=1e-2)
# A warm start without multipliers.
FROM_NEIGHBOUR = Attempt(*first_iterate.BESIDE, 1.0, 1e-12, 1e4, on_path=True)
CASCADE_WITH_BOUNDS = (
    Attempt(0.1, 1e-2, 0.1, 1e-3, 2.0),
    Attempt(10.0, 1e-2, 1.0, 1e-3, 2.0),
    Attempt(0.1, 1e-2, 1.0, 1e-12, 1e4, 0.1),  # for equations that depend on each other only at the guess
)
CASCADE = (CASCADE_WITH_BOUNDS[0], CASCADE_WITH_BOUNDS[2])


class Bounds(NamedTuple):
    """All m finite bounds, as in `descent`: indices of unknowns, sides, magnitudes (at least one) and values.

    `lower` and `upper` (n,) are the least and greatest values of all unknowns. They are empty if a problem has no
    bounds.
    """

    indices: np.ndarray
    side: np.ndarray
    magnitude: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@njit(error_model="numpy")
def count_bounds(lower, upper):
    """Return the number of finite bounds."""
    m = 0
    for i in range(lower.size):
        m += int(lower[i] > -np.inf) + int(upper[i] < np.inf)
    return m


@njit(error_model="numpy")
def fill_bounds(lower, upper, indices, side, magnitude, value):
    """Fill arrays (m,) with indices, sides, magnitudes and values of all finite bounds, lower bounds first."""
    j = 0
    for i in range(lower.size):
        if lower[i] > -np.inf:
            indices[j], side[j], value[j], magnitude[j] = i, 1.0, lower[i], max(1.0, abs(lower[i]))
            j += 1
    for i in range(lower.size):
        if upper[i] < np.inf:
            indices[j], side[j], value[j], magnitude[j] = i, -1.0, upper[i], max(1.0, abs(upper[i]))
            j += 1


@njit(cache=True, error_model="numpy")
def finite_bounds(lower, upper):
    """Return indices, sides, magnitudes and values of all finite bounds, lower bounds first."""
    m = count_bounds(lower, upper)
    indices, side, magnitude, value = np.empty(m, np.int64), np.empty(m), np.empty(m), np.empty(m)
    fill_bounds(lower, upper, indices, side, magnitude, value)
    return indices, side, magnitude, value


NO_BOUNDS = Bounds(NO_INDICES, NONE, NONE, NONE, NONE, NONE)


class Workspace:
    """The work space of the compiled search for n unknowns and m bounds, which later searches use again."""

    def __init__(self, n, m):
        self.vectors, self.barriers = np.zeros((workspace.VECTORS, n)), np.zeros((workspace.BARRIERS, m))
        self.reals, self.integers = np.zeros(workspace.REALS), np.zeros(workspace.INTEGERS, np.int64)
        self.pairs, self.room = np.empty((1000, 2)), np.empty((0, n))

    def room_for_refinement(self):
        """Return the work space for refinements, and allocate it if it is needed for the first time."""
        if not self.room.size:
            self.room = np.empty((2 * direction.SOLVED_AGAIN + 2, self.vectors.shape[1]))
        return self.room

    @cached_property
    def log(self):
        """Rows for the log of one call of the compiled search."""
        return np.empty((101, 6))


class Search(NamedTuple):
    """The constant data of a search: grid, bounds, storage of the linear system, and work space.

    `arguments` are the first four arguments of the compiled search. Bounds are relaxed by at least `least`, relative to
    their magnitudes. With contact forces, `relaxation` follows the weight of the barrier.
    """

    grid: Grid
    bounds: Bounds
    system: System
    work: Workspace
    arguments: tuple[tuple[object, ...], ...]
    least: float = LEAST_RELAXED
    relaxation: Relaxation | None = None

    @property
    def is_bounded(self):
        """True if any unknown has a bound."""
        return self.bounds.indices.size > 0

    @property
    def equations(self):
        """The indices of the multipliers of all equations.

        Multipliers without an equation are left out, such as those of conditions at inner times at all other nodes.
        """
        return multiplier_unknowns(self.grid)


class Iterate(NamedTuple):
    """A Point, the barrier's weight mu, the distances to all bounds (m,), and the duals of all bounds (m,)."""

    point: Point
    mu: float
    distance: np.ndarray
    duals: np.ndarray

    @property
    def objective(self):
        """The barrier function (3), which the line search lowers."""
        return self.point.cost - self.mu * np.log(self.distance).sum()


class Step(NamedTuple):
    """A Newton step: its primal part (n,), its part for duals (m,), and the longest step length of each."""

    primal: np.ndarray
    dual: np.ndarray
    longest: float
    dual_length: float


def search_on(grid):
    """Return the Search on a grid, with kept or new storage; the grid of the Search includes the bounds."""
    grid, relaxation = relaxation_of(grid)
    bounds = NO_BOUNDS
    if grid.problem.variable_bounds is not None:
        box = bounds_of(grid)
        bounds = Bounds(*finite_bounds(*box), *box)
        grid = grid._replace(bounds=box)
    kept = grid.problem.storage.take(storage_key(grid, bounds))
    if kept is None:
        system, work = allocate_system(grid), Workspace(grid.is_multiplier.size, bounds.side.size)
    else:
        system, work = with_entry_factors(grid, kept[0]), kept[1]
    arguments = *arguments_of(grid, system), tuple(bounds)
    return Search(grid, bounds, system, work, arguments, relaxation=relaxation)


def keep_storage(search):
    """Keep the storage of a finished search for the next search with as many intervals and bounds."""
    system, work = search.system, search.work
    if system.factors.size + work.vectors.size <= LARGEST_KEPT:
        search.grid.problem.storage.keep(storage_key(search.grid, search.bounds), (system, work))


def storage_key(grid, bounds):
    """Return the numbers that determine the lengths of all arrays of a search."""
    return grid.steps, grid.is_uniform, bounds.side.size


def on_grid(search, grid):
    """Return `search` on another grid with as many intervals and finite bounds, with the same storage.

    If the grid has no bounds, the bounds of `search` remain.
    """
    if grid is search.grid:
        return search
    bounds = search.bounds
    if search.is_bounded and grid.bounds and grid.bounds is not search.grid.bounds:
        bounds = Bounds(*finite_bounds(*grid.bounds), *grid.bounds)
    system = search.system if grid.sizes is search.grid.sizes else with_entry_factors(grid, search.system)
    arguments = *arguments_of(grid, system), tuple(bounds)
    return search._replace(grid=grid, bounds=bounds, system=system, arguments=arguments)


def arguments_of(grid, system):
    """Return the arguments problem, grid and system of the compiled search, see `descent.descend`."""
    steps, h, nodes, _, parameters, is_multiplier, sizes, forces, weight, _, _, problem = grid
    s = problem.structure
    data = (
        steps, float(h), nodes, parameters, is_multiplier, sizes, forces, float(weight), s.ties(steps),
        layout_of(grid).is_free, s.fillings(steps), s.free_durations(steps),
    )  # fmt: skip
    return (problem.gradient.address, system.loop, system.address), data, system[2:]


def begin(search, unknowns, attempt):
    """Return the iterate at primal `unknowns` (n,), pushed inside their bounds by `attempt.push`.

    The duals are one, or on the central path with `attempt.on_path`.
    """
    work = search.work
    work.vectors[X] = unknowns
    work.reals[MU], work.reals[workspace.PUSH] = attempt.weight if search.is_bounded else 0.0, attempt.push
    work.reals[workspace.LEAST_RELAXATION], work.integers[workspace.ON_PATH] = search.least, attempt.on_path
    problem, data, _, bounds = search.arguments
    first_iterate.begin(problem, data, bounds, work.reals, work.integers, work.vectors, work.barriers)
    return stored(search)


def load(search, iterate):
    """Put an iterate into the work space of a search."""
    work, point = search.work, iterate.point
    work.vectors[X], work.vectors[G] = point.unknowns, point.gradient
    work.barriers[DISTANCE], work.barriers[DUALS] = iterate.distance, iterate.duals
    work.reals[MU], work.reals[COST : COST + 5] = iterate.mu, point[2:]


def stored(search):
    """Return the iterate in the work space of a search."""
    work = search.work
    vectors, barriers = work.vectors[: G + 1].copy(), work.barriers[: DUALS + 1].copy()
    point = Point(vectors[X], vectors[G], *work.reals[COST : COST + 5].tolist())
    return Iterate(point, float(work.reals[MU]), barriers[DISTANCE], barriers[DUALS])


def with_relaxation(search, tolerance):
    """Return the iterate in the work space of a search with contact forces, with the relaxation for its weight."""
    iterate = stored(search)
    search.relaxation.follow(iterate.mu, tolerance)
    return iterate._replace(point=evaluate(search.grid, iterate.point.unknowns))


def with_tied_values(grid, unknowns):
    """Return `unknowns` (n,) in which unknowns of end nodes take the values of linking variables that they equal."""
    if not grid.problem.structure.is_tied:
        return unknowns
    if grid.sizes.size:
        return with_pinned_values(grid, unknowns * grid.sizes) / grid.sizes
    return with_pinned_values(grid, unknowns)


def central_duals(mu, distance):
    """Return duals (m,) on the central path, limited to LARGEST_DUAL."""
    return np.minimum(mu / distance, LARGEST_DUAL)


def with_least_squares_multipliers(search, iterate):
    """Return `iterate` with multipliers that solve the stationarity conditions by least squares.

    All multipliers of `iterate` are zero. They stay zero if the solution is huge or does not exist.
    Source: Waechter and Biegler (2006), equation (36).
    """
    load(search, iterate)
    first_iterate.estimate_multipliers(*search.arguments, search.work.reals, search.work.vectors, search.work.barriers)
    return stored(search)


def measured_point(search, iterate):
    """Return the Point of an iterate with the duals of bounds included in its stationarity and error."""
    point, bounds = iterate.point, search.bounds
    if not search.is_bounded:
        return point
    stationarity = optimality.optimality(
        point.gradient, point.unknowns, search.grid.is_multiplier, bounds.indices, bounds.side, iterate.distance,
        iterate.duals, search.work.vectors[workspace.SPARE],
    )[0]  # fmt: skip
    error = max(point.residual, stationarity) if point.error < np.inf else np.inf
    return point._replace(stationarity=stationarity, error=error)


def newton_system(search, iterate, gradient, delta_w, delta_c):
    """Return the right-hand side and the diagonal (n,) of Newton's equations, see `direction.fill_newton_system`."""
    right, diagonal = np.empty_like(gradient), np.empty_like(gradient)
    direction.fill_newton_system(
        *search.arguments[1::2], gradient, iterate.distance, iterate.duals, iterate.mu, delta_w, delta_c, right,
        diagonal,
    )  # fmt: skip
    return right, diagonal


def step_along(search, iterate, right, primal):
    """Return the Step with the part `primal` (n,) for a right-hand side `right` (n,).

    The part for duals and the longest lengths (15) are computed.
    """
    dual = np.empty_like(iterate.duals)
    _, _, longest, dual_length = direction.measure_step(
        *search.arguments[1::2], iterate.point.unknowns, right, primal, iterate.distance, iterate.duals, iterate.mu,
        dual,
    )  # fmt: skip
    return Step(primal, dual, longest, dual_length)


def moved(search, iterate, step, length):
    """Return the iterate after a step with primal length `length` and the longest length of its duals."""
    unknowns, distance, duals = (np.empty_like(x) for x in (iterate.point.unknowns, iterate.distance, iterate.duals))
    direction.move(
        search.arguments[3], iterate.point.unknowns, step.primal, length, iterate.distance, iterate.duals, step.dual,
        step.dual_length, iterate.mu, unknowns, distance, duals,
    )  # fmt: skip
    moved_to = Iterate(evaluate(search.grid, unknowns), iterate.mu, distance, duals)
    return moved_to._replace(point=measured_point(search, moved_to))


def newton_step(search, iterate):
    """Return the refined Newton Step with a shift of the Hessian that makes it a descent step.

    Return None if no shift suffices.
    """
    work, point = search.work, iterate.point
    is_found, _, longest, dual_length, _, _ = direction.regularise(
        *search.arguments, point.unknowns, point.gradient, iterate.distance, iterate.duals, iterate.mu, 0.0, True,
        np.zeros(workspace.REALS), np.zeros(workspace.INTEGERS, np.int64), work.vectors, work.barriers,
        work.room_for_refinement(),
    )  # fmt: skip
    if not is_found:
        return None
    return Step(work.vectors[workspace.STEP].copy(), work.barriers[workspace.DUAL_STEP].copy(), longest, dual_length)


def predicted_cost(search, iterate):
    """Return the cost of the nearby optimum to first order, without relaxation of bounds.

    The prediction adds multipliers times residuals to the cost, and subtracts duals times distances.
    """
    bounds = search.bounds
    distance = bounds.side * (iterate.point.unknowns[bounds.indices] - bounds.value)
    return lagrangian(search.grid, iterate.point) - iterate.duals @ distance
