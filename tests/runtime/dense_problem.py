"""Small optimisation problems with a dense KKT matrix, as grids of the runtime, and searches by it.

A problem has one interval that holds all its unknowns: variables and multipliers of equations, interleaved. The one
unknown of each node is given, and means nothing. An inequality g <= 0 is y (g + s) with a slack s >= 0. Cost and
derivatives are callbacks; the search and the factorisation are those of all problems.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import sympy
from made_records import control_record
from numpy.typing import NDArray

from codegen.runtime.search.bounds import bounds_of
from codegen.runtime.search.cascade import minimise
from codegen.runtime.search.grid import NONE, Grid, multiplier_unknowns, primal_unknowns
from codegen.runtime.search.point import Point, evaluate
from codegen.runtime.search.problem import ControlProblem, Loop
from codegen.runtime.search.solution import Log
from codegen.runtime.search.structure import Structure

Vector = NDArray[np.float64]
INFINITY = float("inf")


def dense_grid(
    is_multiplier: NDArray[np.bool_],
    lower: Vector,
    upper: Vector,
    guess: Vector,
    lagrangian: Callable[[Vector], tuple[float, Vector]],
    hessian: Callable[[Vector], Vector],
) -> Grid:
    """A problem by its unknowns (n,); `lagrangian` gives cost and gradient, `hessian` the second derivative (n, n)."""
    size = is_multiplier.size
    rows, columns = np.tril_indices(size)

    def gradient(unknowns: Any, *others: Any) -> float:
        filled = np.ctypeslib.as_array(others[-1], (size + 2,))
        with np.errstate(all="ignore"):
            cost, slope = lagrangian(np.ctypeslib.as_array(unknowns, (size + 2,))[1:-1].copy())
        filled[:] = 0.0
        filled[1:-1] = slope
        return float(cost)

    structure = Structure(
        node=1, stride=size + 1, condensed=0, rows=rows + 1, columns=columns + 1,
        is_multiplier=np.concatenate([[False], is_multiplier]), start_pinned=np.array([0]), end_pinned=np.array([0]),
        bordered=False, inequalities=bool(np.isfinite([lower, upper]).any()),
    )  # fmt: skip
    limits = tuple(np.concatenate([[end], values, [end]]) for end, values in ((-INFINITY, lower), (INFINITY, upper)))
    problem = ControlProblem(
        structure, control_record(), Loop(gradient, True), second_derivatives(hessian, size), Loop(gradient, True),
        lambda *_: 1.0,
        lambda _: np.concatenate([[0.0], guess, [0.0]]), lambda *_: None, lambda *_: (),
        (lambda _: limits) if structure.inequalities else None,
    )  # fmt: skip
    masks = structure.layouts(1).is_multiplier.copy()
    return Grid(1, 1.0, np.arange(2.0), True, np.zeros((1, 1)), masks, NONE, NONE, 1.0, (), (), problem)


def second_derivatives(hessian: Callable[[Vector], Vector], size: int) -> Loop:
    """The callback that fills the lower triangle of the KKT matrix."""
    lower = np.tril_indices(size)

    def fill(unknowns: Any, *others: Any) -> float:
        with np.errstate(all="ignore"):
            matrix = hessian(np.ctypeslib.as_array(unknowns, (size + 2,))[1:-1].copy())
        np.ctypeslib.as_array(others[-1], (lower[0].size,))[:] = matrix[lower]
        return 0.0

    return Loop(fill, True)


def with_hessian(grid: Grid, hessian: Callable[[Vector], Vector]) -> Grid:
    """The problem with other second derivatives."""
    return grid._replace(
        problem=replace(grid.problem, hessians=second_derivatives(hessian, grid.is_multiplier.size - 2))
    )


def guess_of(grid: Grid) -> Vector:
    """The unknowns from which searches begin."""
    return grid.problem.initial_guess(grid)


def variables(grid: Grid, point: Point) -> Vector:
    """The variables of a problem, slacks behind them, without multipliers."""
    return point.unknowns[primal_unknowns(grid)]


def solve(grid: Grid, limit: int = 300, warm: bool = False, guess: Any = None) -> tuple[str, Point, int]:
    unknowns = guess_of(grid) if guess is None else guess
    status, point, iterations = minimise(grid, unknowns, 1e-10, limit, warm, Log())
    assert iterations <= limit
    return status, point, iterations


def assert_optimal(grid: Grid, point: Point) -> None:
    """First-order conditions from the definition: equations, bounds, and signs of the Lagrangian's own gradient."""
    unknowns, (lower, upper) = point.unknowns, bounds_of(grid)
    assert (unknowns >= lower).all()
    assert (unknowns <= upper).all()
    gradient = evaluate(grid, unknowns).gradient
    assert np.abs(gradient[multiplier_unknowns(grid)]).max(initial=0.0) <= 1e-10
    for i in primal_unknowns(grid):
        room = max(0.0, gradient[i]) * (unknowns[i] - lower[i] if lower[i] > -INFINITY else 1.0)
        room += max(0.0, -gradient[i]) * (upper[i] - unknowns[i] if upper[i] < INFINITY else 1.0)
        assert room <= 2e-10 * max(1.0, np.abs(unknowns).max())


def program(
    guess: dict[sympy.Symbol, float],
    cost: Any,
    equations: list[Any] = (),  # type: ignore[assignment]
    inequalities: list[Any] = (),  # type: ignore[assignment]
    bounds: dict[sympy.Symbol, tuple[float, float]] | None = None,
) -> Grid:
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

    return dense_grid(
        np.array([x in multipliers for x in unknowns]),
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


def transcribe(motion: Motion, steps: int) -> Grid:
    """Interleaved unknowns: state 0, (multipliers, controls, slacks) 0, state 1, ..., state N, and the duration.

    States that are given at the ends are left out.
    """
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
    residual = lagrangian(guess)[1]
    for j in range(len(slacks)):
        at = np.arange(steps) * stride + node
        guess[at + len(multipliers) + len(controls) + j] = np.maximum(0.0, -residual[at + len(states) + j])

    def whole(x: Vector) -> Vector:
        """All unknowns, those that are given among them."""
        unknowns = guess.copy()
        unknowns[free] = x
        return unknowns

    def of_free(x: Vector) -> tuple[float, Vector]:
        cost, gradient = lagrangian(whole(x))
        return cost, gradient[free]

    return dense_grid(
        np.array([x in multipliers for x in names])[free], limits[0, free], limits[1, free], guess[free], of_free,
        lambda x: hessian(whole(x))[np.ix_(free, free)],
    )  # fmt: skip


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
