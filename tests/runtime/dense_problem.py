"""Small optimisation problems with dense linear algebra, behind the functions that a generated module has.

A problem is a `Dense` grid; `evaluate`, `factor_kkt`, ... take it where a generated module takes its grid. Unknowns
are variables and multipliers of equations, interleaved. An inequality g <= 0 is y (g + s) with a slack s >= 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import sympy
from numpy.typing import NDArray
from scipy.linalg.lapack import dgetrf, dgetrs

from codegen.runtime.kkt import refinement
from codegen.runtime.optimise import barrier, bounded

Vector = NDArray[np.float64]
INFINITY = float("inf")


class Dense(NamedTuple):
    """A problem; `lagrangian` gives cost and gradient of the Lagrangian, `hessian` its full second derivative."""

    is_multiplier: NDArray[np.bool_]
    free: NDArray[np.bool_]
    lower: Vector
    upper: Vector
    guess: Vector
    lagrangian: Callable[[Vector], tuple[float, Vector]]
    hessian: Callable[[Vector], Vector]
    sizes: Vector = np.zeros(0)


class Point(NamedTuple):
    """As in point.py of the runtime."""

    unknowns: Vector
    gradient: Vector
    cost: float
    residual: float
    violation: float
    stationarity: float
    error: float


def evaluate(grid: Dense, unknowns: Vector) -> Point:
    with np.errstate(all="ignore"):
        cost, gradient = grid.lagrangian(unknowns)
    gradient = np.where(grid.free, gradient, 0.0)
    if not (np.isfinite(gradient).all() and np.isfinite(cost)):
        return Point(unknowns, gradient, cost, np.inf, np.inf, np.inf, np.inf)
    size = np.abs(gradient)
    residuals, stationarity = size[grid.is_multiplier], float(size[~grid.is_multiplier].max(initial=0.0))
    residual = float(residuals.max(initial=0.0))
    return Point(unknowns, gradient, cost, residual, float(residuals.sum()), stationarity, max(residual, stationarity))


def kkt_matrix(grid: Dense, unknowns: Vector) -> Vector:
    """The KKT matrix, with rows and columns of pinned unknowns set to zero."""
    with np.errstate(all="ignore"):
        return np.where(np.outer(grid.free, grid.free), grid.hessian(unknowns), 0.0)


def allocate_system(grid: Dense) -> list[Any]:
    return [None, None]


def factor_kkt(
    grid: Dense, unknowns: Vector, weight: float, diagonal: Vector, system: list[Any], gradient: Vector | None = None,
    step: Vector | None = None,
) -> int | None:  # fmt: skip
    """Excess of negative eigenvalues, or None; rows and columns are scaled alike for it, which keeps their signs."""
    matrix = kkt_matrix(grid, unknowns)
    primal = ~grid.is_multiplier
    matrix[np.ix_(primal, primal)] *= weight
    matrix[np.diag_indices_from(matrix)] += np.where(grid.free, diagonal, 1.0)
    if not np.isfinite(matrix).all():
        return None
    system[0], system[1], index = dgetrf(matrix)
    if index:
        return None
    if gradient is not None and step is not None:
        solve_kkt(grid, system, gradient, step)
    scale = 1.0 / np.sqrt(np.abs(matrix).max(axis=0))
    eigenvalues = np.linalg.eigvalsh(matrix * np.outer(scale, scale))
    return int(np.count_nonzero(eigenvalues < 0.0) - np.count_nonzero(grid.is_multiplier & grid.free))


def moved(search: Any, iterate: Any, step: Any, length: float) -> bounded.Iterate:
    """As in bounded.py, by the functions that make its one compiled call."""
    grid, (indices, _, side, _), duals = search.grid, search.bounds, np.empty(iterate.duals.size)
    trial, distance = np.empty(grid.guess.size), np.empty(duals.size)
    places = indices, side, iterate.distance
    logarithms = barrier.move(iterate.point.unknowns, step.primal, length, *places, trial, distance)
    unknowns, gradient, *evaluated = evaluate(grid, trial)
    measured = barrier.move_duals(
        gradient, trial, grid.is_multiplier, indices, side, distance, iterate.duals, step.dual, step.dual_length,
        iterate.mu, duals,
    )  # fmt: skip
    point = bounded.with_duals(unknowns, gradient, evaluated, measured)
    return bounded.Iterate(point, iterate.mu, distance, logarithms, duals, bounded.Measured(*measured))


def step_along(search: Any, iterate: Any, gradient: Vector, primal: Vector, inertia: Any) -> bounded.Step:
    """As in bounded.py, without the iterate at its end, which `moved` finds when it is asked for."""
    (indices, _, side, _), dual = search.bounds, np.empty(iterate.duals.size)
    places = search.grid.is_multiplier, indices, side, iterate.distance, iterate.duals
    tau = max(0.99, 1.0 - iterate.mu)
    measured = barrier.measure_step(iterate.point.unknowns, gradient, primal, *places, iterate.mu, tau, dual)
    return bounded.Step(primal, dual, gradient, *measured, inertia)


def solve_kkt(grid: Dense, system: list[Any], gradient: Vector, step: Vector) -> None:
    step[:] = np.where(grid.free, dgetrs(system[0], system[1], -gradient)[0], 0.0)


def linear_residual(
    grid: Dense, unknowns: Vector, diagonal: Vector, gradient: Vector, step: Vector
) -> tuple[Vector, float]:
    left = np.where(grid.free, kkt_matrix(grid, unknowns) @ step + diagonal * step + gradient, 0.0)
    return left, refinement.inaccuracy(gradient, step, left, grid.is_multiplier)


def sizes_of_terms(grid: Dense, unknowns: Vector, *_enough: float) -> tuple[float, float]:
    """Largest sum of absolute terms in an equation, and in a stationarity condition."""
    sums = np.abs(kkt_matrix(grid, unknowns)) @ np.abs(unknowns)
    return float(sums[grid.is_multiplier].max(initial=0.0)), float(sums[~grid.is_multiplier].max(initial=0.0))


def bounds_of(grid: Dense) -> tuple[Vector, Vector]:
    return grid.lower, grid.upper


def views(grid: Dense, unknowns: Vector) -> tuple[Vector, Vector]:
    """All unknowns as those of intervals, of which each is one quantity."""
    return np.zeros((1, 2, 0)), unknowns.reshape(1, -1, 1)


def with_tied_values(grid: Dense, unknowns: Vector) -> Vector:
    return np.where(grid.free, unknowns, grid.guess)


def free_unknowns(grid: Dense) -> NDArray[np.bool_]:
    return grid.free


def multiplier_unknowns(grid: Dense) -> NDArray[np.intp]:
    return np.flatnonzero(grid.is_multiplier & grid.free)


def term_sizes(grid: Dense, unknowns: Vector) -> tuple[float, float]:
    sums = np.abs(kkt_matrix(grid, unknowns)) @ np.abs(unknowns)
    return float(sums[grid.is_multiplier].max(initial=0.0)), float(sums[~grid.is_multiplier].max(initial=0.0))


def is_solved(grid: Dense, point: Point, tolerance: float) -> bool:
    sizes = term_sizes(grid, point.unknowns)
    measured = point.residual, point.stationarity
    return all(v <= max(tolerance * min(1.0, s), 2.2e-16 * s) for v, s in zip(measured, sizes, strict=True))


def is_at_rounding_level(grid: Dense, point: Point) -> bool:
    sizes = term_sizes(grid, point.unknowns)
    measured = point.residual, point.stationarity
    return all(v <= 2.2e-13 * s for v, s in zip(measured, sizes, strict=True))


def program(
    guess: dict[sympy.Symbol, float],
    cost: Any,
    equations: list[Any] = (),  # type: ignore[assignment]
    inequalities: list[Any] = (),  # type: ignore[assignment]
    bounds: dict[sympy.Symbol, tuple[float, float]] | None = None,
) -> Dense:
    """A problem in symbols: equations are 0, inequalities <= 0; a slack's guess is what satisfies its equation."""
    bounds, guess = dict(bounds or {}), dict(guess)
    residuals = list(map(sympy.sympify, equations))
    for i, inequality in enumerate(inequalities):
        slack = sympy.Symbol(f"slack{i}")
        start = float(sympy.sympify(inequality).subs(guess))
        residuals.append(inequality + slack)
        bounds[slack], guess[slack] = (0.0, INFINITY), max(0.0, -start)
    multipliers = sympy.symbols(f"multiplier:{len(residuals)}")
    unknowns: list[sympy.Symbol] = []
    for i in range(max(len(guess), len(multipliers))):  # interleaved, as in a generated module
        unknowns += [*list(guess)[i : i + 1], *multipliers[i : i + 1]]
    cost = sympy.sympify(cost)
    lagrangian = cost + sum(y * r for y, r in zip(multipliers, residuals, strict=True))
    gradient = [lagrangian.diff(x) for x in unknowns]
    first = sympy.lambdify([unknowns], [cost, gradient], cse=True)
    second = sympy.lambdify([unknowns], sympy.Matrix(gradient).jacobian(unknowns).tolist(), cse=True)

    def values(x: Vector) -> tuple[float, Vector]:
        value, slope = first(x)
        return float(value), np.array(slope, dtype=float)

    return Dense(
        np.array([x in multipliers for x in unknowns]),
        np.ones(len(unknowns), dtype=bool),
        np.array([bounds.get(x, (-INFINITY, INFINITY))[0] for x in unknowns]),
        np.array([bounds.get(x, (-INFINITY, INFINITY))[1] for x in unknowns]),
        np.array([float(guess.get(x, 0.0)) for x in unknowns]),
        values,
        lambda x: np.array(second(x), dtype=float),
    )


class Motion(NamedTuple):
    """x' = rates on [0, duration], discretised by the implicit midpoint rule with one control an interval.

    `duration` is a number or a symbol, which is then an unknown with a guess and bounds. `running` is integrated,
    `path` <= 0 holds at midpoints. `guess` gives each symbol a number, or (start, end) to go between.
    """

    states: list[sympy.Symbol]
    controls: list[sympy.Symbol]
    rates: list[Any]
    duration: Any
    running: Any
    start: dict[sympy.Symbol, float]
    end: dict[sympy.Symbol, float]
    guess: dict[sympy.Symbol, Any]
    bounds: dict[sympy.Symbol, tuple[float, float]]
    path: list[Any] = []  # noqa: RUF012
    terminal: Any = 0


def transcribe(motion: Motion, steps: int) -> Dense:
    """Interleaved unknowns: state 0, (multipliers, controls, slacks) 0, state 1, ..., state N, and the duration."""
    states, controls, slacks = motion.states, motion.controls, sympy.symbols(f"slack:{len(motion.path)}")
    right = [sympy.Symbol(f"{x}_next") for x in states]
    multipliers = sympy.symbols(f"multiplier:{len(states) + len(slacks)}")
    shared = [motion.duration] if isinstance(motion.duration, sympy.Symbol) else []
    h = motion.duration / sympy.Integer(steps)
    middle = {x: (x + y) / 2 for x, y in zip(states, right, strict=True)}
    residuals = [y - x - h * sympy.sympify(f).subs(middle, simultaneous=True)
                 for x, y, f in zip(states, right, motion.rates, strict=True)]  # fmt: skip
    residuals += [sympy.sympify(g).subs(middle, simultaneous=True) + s
                  for g, s in zip(motion.path, slacks, strict=True)]  # fmt: skip
    cost = h * sympy.sympify(motion.running).subs(middle, simultaneous=True)
    local = [*states, *multipliers, *controls, *slacks, *right, *shared]
    stride, node = len(local) - len(right) - len(shared), len(states)
    size = stride * steps + node + len(shared)
    indices = np.arange(steps)[:, None] * stride + np.arange(len(local))
    if shared:
        indices[:, -1] = size - 1
    pairs = (indices[:, :, None] * size + indices[:, None, :]).ravel()
    element = cost + sum(y * r for y, r in zip(multipliers, residuals, strict=True))
    ends = [*range(size - len(shared) - node, size - len(shared)), *range(size - len(shared), size)]
    first, second = _derivatives(element, cost, local)
    end_first, end_second = _derivatives(motion.terminal, motion.terminal, [*states, *shared])

    def lagrangian(x: Vector) -> tuple[float, Vector]:
        values = first(x[indices])
        gradient = np.bincount(indices.ravel(), values[:, 1:].ravel(), size)
        last = end_first(x[None, ends])[0]
        gradient[ends] += last[1:]
        return float(values[:, 0].sum() + last[0]), gradient

    def hessian(x: Vector) -> Vector:
        matrix = np.bincount(pairs, second(x[indices]).ravel(), size * size).reshape(size, size)
        matrix[np.ix_(ends, ends)] += end_second(x[None, ends])[0]
        return matrix

    names = [*([*states, *multipliers, *controls, *slacks] * steps), *states, *shared]
    guess = np.zeros(size)
    for i, name in enumerate(names):
        value = motion.guess.get(name, 0.0)
        guess[i] = np.interp(i / (stride * steps), [0.0, 1.0], value) if isinstance(value, tuple) else value
    free = np.ones(size, dtype=bool)
    for offset, values in ((0, motion.start), (stride * steps, motion.end)):
        for symbol, value in values.items():
            free[offset + states.index(symbol)] = False
            guess[offset + states.index(symbol)] = value
    bounds = {**motion.bounds, **dict.fromkeys(slacks, (0.0, INFINITY))}
    limits = np.array([bounds.get(x, (-INFINITY, INFINITY)) for x in names]).T
    limits[0, ~free], limits[1, ~free] = -INFINITY, INFINITY
    is_multiplier = np.array([x in multipliers for x in names])
    grid = Dense(is_multiplier, free, limits[0].copy(), limits[1].copy(), guess, lagrangian, hessian)
    residual = evaluate(grid, guess).gradient
    for j in range(len(slacks)):
        at = np.arange(steps) * stride + node
        guess[at + len(multipliers) + len(controls) + j] = np.maximum(0.0, -residual[at + len(states) + j])
    return grid


def _derivatives(element: Any, cost: Any, local: list[sympy.Symbol]) -> tuple[Any, Any]:
    """Functions of rows of local unknowns: (cost, gradient), and the Hessian, of every row."""
    element = sympy.sympify(element)
    gradient = [element.diff(x) for x in local]
    hessian = [entry for row in sympy.Matrix(gradient).jacobian(local).tolist() for entry in row]

    def rows(expressions: list[Any]) -> Callable[[Vector], Vector]:
        function = sympy.lambdify([local], expressions, cse=True)

        def evaluate_rows(values: Vector) -> Vector:
            return np.stack([np.broadcast_to(v, values.shape[0]) for v in function(values.T)], axis=-1).astype(float)

        return evaluate_rows

    second = rows(hessian)
    return rows([sympy.sympify(cost), *gradient]), lambda x: second(x).reshape(-1, len(local), len(local))
