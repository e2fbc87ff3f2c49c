"""Iterates of a search: initialisation, and the steps of an iterate where Python leads the search.

The Newton loop itself is compiled, see `descent`. Restoration, final bounds and starts take the steps of this module.
"""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numba import njit

from codegen.runtime.search import descent
from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.descent import COST, DISTANCE, DUALS, LARGEST_DUAL, LEAST_RELAXED, MU, G, X
from codegen.runtime.search.grid import NONE, Grid, layout_of, multiplier_unknowns, with_pinned_values
from codegen.runtime.search.linear_system import System, allocate_system, with_entry_factors
from codegen.runtime.search.point import Point, evaluate, lagrangian
from codegen.runtime.search.structure import NO_INDICES

LARGEST_KEPT = 4_000_000  # largest number of floats of a storage that is kept between searches: 32 MB


class Attempt(NamedTuple):
    """The start of a search.

    Attributes
    ----------
    weight, push : float
        First weight of the barrier, and least distance of unknowns to their bounds at the start.
    nearby : float
        Part of the violation at the guess that may remain before the search begins.
    shortest : float
        Shorter steps are replaced by a restoration.
    funnel : float
        Factor by which the violation may grow.
    bulge : float
        Bulge of the guess, relative to its size.
    on_path : bool
        True if duals begin on the central path, not at one.
    """

    weight: float
    push: float
    nearby: float
    shortest: float
    funnel: float
    bulge: float = 0.0
    on_path: bool = False


FROM_GUESS = Attempt(*descent.AT_GUESS, 1.0, 1e-12, 1e4)
NEARBY = FROM_GUESS._replace(nearby=1e-2)
# Warm start without multipliers.
FROM_NEIGHBOUR = Attempt(*descent.BESIDE, 1.0, 1e-12, 1e4, on_path=True)
CASCADE_WITH_BOUNDS = (
    Attempt(0.1, 1e-2, 0.1, 1e-3, 2.0),
    Attempt(10.0, 1e-2, 1.0, 1e-3, 2.0),
    Attempt(0.1, 1e-2, 1.0, 1e-12, 1e4, 0.1),  # for equations that depend on each other only at the guess
)
CASCADE = (CASCADE_WITH_BOUNDS[0], CASCADE_WITH_BOUNDS[2])


class Bounds(NamedTuple):
    """Indices, sides, magnitudes (at least one) and values of all finite bounds; least and greatest values (n,).

    The least and greatest values are empty if a problem has no bounds.
    """

    indices: np.ndarray
    side: np.ndarray
    magnitude: np.ndarray
    value: np.ndarray
    lower: np.ndarray
    upper: np.ndarray


@njit(cache=True, error_model="numpy")
def finite_bounds(lower, upper):
    """Return indices, sides, magnitudes and values of the bounds that exist, lower ones first."""
    n, m = lower.size, 0
    for i in range(n):
        m += int(lower[i] > -np.inf) + int(upper[i] < np.inf)
    indices, side, magnitude, value = np.empty(m, np.int64), np.empty(m), np.empty(m), np.empty(m)
    j = 0
    for sign, bound in ((1.0, lower), (-1.0, upper)):
        for i in range(n):
            if sign * bound[i] > -np.inf:
                indices[j], side[j], value[j], magnitude[j] = i, sign, bound[i], max(1.0, abs(bound[i]))
                j += 1
    return indices, side, magnitude, value


NO_BOUNDS = Bounds(NO_INDICES, NONE, NONE, NONE, NONE, NONE)


class Workspace:
    """The work space of the compiled search, used again by searches with as many unknowns and bounds."""

    def __init__(self, n, m):
        self.vectors, self.barriers = np.zeros((descent.VECTORS, n)), np.zeros((descent.BARRIERS, m))
        self.reals, self.integers = np.zeros(descent.REALS), np.zeros(descent.INTEGERS, np.int64)
        self.pairs, self.room = np.empty((1000, 2)), np.empty((0, n))

    def room_for_refinement(self):
        """Return the storage of corrections, which is allocated when it is first needed."""
        if not self.room.size:
            self.room = np.empty((2 * descent.SOLVED_AGAIN + 2, self.vectors.shape[1]))
        return self.room

    @cached_property
    def log(self):
        """Rows of the iterates of one call."""
        return np.empty((101, 6))


class Search(NamedTuple):
    """The constant data of a solve: grid, bounds, storage of the linear system, work space.

    Bounds are relaxed by at least `least`, relative to their magnitudes. `arguments` are those of the compiled search.
    """

    grid: Grid
    bounds: Bounds
    system: System
    work: Workspace
    arguments: tuple[tuple[Any, ...], ...]
    least: float = LEAST_RELAXED

    @property
    def is_bounded(self):
        """True if there are bounds."""
        return self.bounds.indices.size > 0

    @property
    def equations(self):
        """The indices of the multipliers whose equations are imposed."""
        return multiplier_unknowns(self.grid)


class Iterate(NamedTuple):
    """A point, the barrier's weight mu, distances to all bounds (m,) and their duals (m,)."""

    point: Point
    mu: float
    distance: np.ndarray
    duals: np.ndarray

    @property
    def objective(self):
        """The barrier function, which a line search lowers (3)."""
        return self.point.cost - self.mu * np.log(self.distance).sum()


class Step(NamedTuple):
    """A Newton step: primal and dual part, and their longest lengths."""

    primal: np.ndarray
    dual: np.ndarray
    longest: float
    dual_length: float


def search_on(grid):
    """Return the Search on a grid; the grid of the search has the bounds."""
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
    return Search(grid, bounds, system, work, (*arguments_of(grid, system), tuple(bounds)))


def keep_storage(search):
    """Keep the storage of a search that has ended for the next search with as many intervals and bounds."""
    system, work = search.system, search.work
    if system.factors.size + work.vectors.size <= LARGEST_KEPT:
        search.grid.problem.storage.keep(storage_key(search.grid, search.bounds), (system, work))


def storage_key(grid, bounds):
    """Return the numbers that determine the lengths of all arrays of a search."""
    return grid.steps, grid.is_uniform, bounds.side.size


def on_grid(search, grid):
    """Return the search on a grid with as many intervals and finite bounds, with the same storage.

    A grid without bounds takes the bounds of the search.
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
    """Return problem, grid and linear system in the form of the arguments of the compiled search."""
    steps, h, nodes, _, parameters, is_multiplier, sizes, forces, weight, _, _, problem = grid
    s = problem.structure
    data = (
        steps, float(h), nodes, parameters, is_multiplier, sizes, forces, float(weight), s.ties(steps),
        layout_of(grid).is_free, s.fillings(steps),
    )  # fmt: skip
    return (problem.gradient.address, system.loop, system.address), data, system[2:]


def begin(search, unknowns, attempt):
    """Return the iterate at primal unknowns pushed inside their bounds, with duals of one or on the central path."""
    work = search.work
    work.vectors[X] = unknowns
    work.reals[MU], work.reals[descent.PUSH] = attempt.weight if search.is_bounded else 0.0, attempt.push
    work.reals[descent.LEAST_RELAXATION], work.integers[descent.ON_PATH] = search.least, attempt.on_path
    problem, data, _, bounds = search.arguments
    descent.begin(problem, data, bounds, work.reals, work.integers, work.vectors, work.barriers)
    return stored(search)


def load(search, iterate):
    """Put an iterate into the work space."""
    work, point = search.work, iterate.point
    work.vectors[X], work.vectors[G] = point.unknowns, point.gradient
    work.barriers[DISTANCE], work.barriers[DUALS] = iterate.distance, iterate.duals
    work.reals[MU], work.reals[COST : COST + 5] = iterate.mu, point[2:]


def stored(search):
    """Return the iterate that is in the work space."""
    work = search.work
    vectors, barriers = work.vectors[: G + 1].copy(), work.barriers[: DUALS + 1].copy()
    point = Point(vectors[X], vectors[G], *work.reals[COST : COST + 5].tolist())
    return Iterate(point, float(work.reals[MU]), barriers[DISTANCE], barriers[DUALS])


def pushed_inside(search, unknowns, push):
    """Return unknowns at least `push` max(1, |bound|) inside their bounds (36).

    Between two bounds, the push is at most that part of their distance.
    """
    inside = unknowns.copy()
    descent.push_inside(search.arguments[1], search.arguments[3], push, inside)
    return inside


def with_tied_values(grid, unknowns):
    """Return unknowns in which unknowns of the end nodes have the values of the linking variables that they equal."""
    if not grid.problem.structure.is_tied:
        return unknowns
    if grid.sizes.size:
        return with_pinned_values(grid, unknowns * grid.sizes) / grid.sizes
    return with_pinned_values(grid, unknowns)


def central_duals(mu, distance):
    """Return duals (m,) on the central path, limited where a bound is close."""
    return np.minimum(mu / distance, LARGEST_DUAL)


def with_least_squares_multipliers(search, iterate):
    """Return an iterate whose multipliers solve stationarity by least squares (36), zero if huge or singular.

    All multipliers of `iterate` are zero.
    """
    load(search, iterate)
    descent.estimate_multipliers(*search.arguments, search.work.reals, search.work.vectors, search.work.barriers)
    return stored(search)


def measured_point(search, iterate):
    """Return the point of an iterate, with the duals of bounds included in its stationarity and error."""
    point, bounds = iterate.point, search.bounds
    if not search.is_bounded:
        return point
    stationarity = descent.optimality(
        point.gradient, point.unknowns, search.grid.is_multiplier, bounds.indices, bounds.side, iterate.distance,
        iterate.duals, search.work.vectors[descent.SPARE],
    )[0]  # fmt: skip
    error = max(point.residual, stationarity) if point.error < np.inf else np.inf
    return point._replace(stationarity=stationarity, error=error)


def newton_system(search, iterate, gradient, delta_w, delta_c):
    """Return right-hand side and diagonal (n,) of Newton's equations (13), given the gradient of the Lagrangian."""
    right, diagonal = np.empty_like(gradient), np.empty_like(gradient)
    descent.fill_newton_system(
        *search.arguments[1::2], gradient, iterate.distance, iterate.duals, iterate.mu, delta_w, delta_c, right,
        diagonal,
    )  # fmt: skip
    return right, diagonal


def step_along(search, iterate, right, primal):
    """Return the step with a primal part for a right-hand side: its dual part and its longest lengths (15)."""
    dual = np.empty_like(iterate.duals)
    _, _, longest, dual_length = descent.measure_step(
        *search.arguments[1::2], iterate.point.unknowns, right, primal, iterate.distance, iterate.duals, iterate.mu,
        dual,
    )  # fmt: skip
    return Step(primal, dual, longest, dual_length)


def moved(search, iterate, step, length):
    """Return the iterate after a length of the primal part of a step and the longest length of its dual part."""
    unknowns, distance, duals = (np.empty_like(x) for x in (iterate.point.unknowns, iterate.distance, iterate.duals))
    descent.move(
        search.arguments[3], iterate.point.unknowns, step.primal, length, iterate.distance, iterate.duals, step.dual,
        step.dual_length, iterate.mu, unknowns, distance, duals,
    )  # fmt: skip
    moved_to = Iterate(evaluate(search.grid, unknowns), iterate.mu, distance, duals)
    return moved_to._replace(point=measured_point(search, moved_to))


def newton_step(search, iterate):
    """Return the refined Newton step with the least shift of the Hessian that makes it a descent step, or None."""
    work, point = search.work, iterate.point
    is_found, _, longest, dual_length, _, _ = descent.regularise(
        *search.arguments, point.unknowns, point.gradient, iterate.distance, iterate.duals, iterate.mu, 0.0, True,
        np.zeros(descent.REALS), np.zeros(descent.INTEGERS, np.int64), work.vectors, work.barriers,
        work.room_for_refinement(),
    )  # fmt: skip
    if not is_found:
        return None
    return Step(work.vectors[descent.STEP].copy(), work.barriers[descent.DUAL_STEP].copy(), longest, dual_length)


def predicted_cost(search, iterate):
    """Return the cost of the nearby optimum to first order, by multipliers times residuals and duals times distances.

    Bounds are not relaxed here.
    """
    bounds = search.bounds
    distance = bounds.side * (iterate.point.unknowns[bounds.indices] - bounds.value)
    return lagrangian(search.grid, iterate.point) - iterate.duals @ distance
