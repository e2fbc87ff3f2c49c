"""The whole of an optimality system on a few intervals of different lengths, put together again.

The Lagrangian of the optimisation problem is the sum of the derived shares of all intervals and ends of all bodies,
and of the conditions between bodies. Its differences, in 120-digit arithmetic, tell whether the module's loops, index
tables and elimination do what the equations say.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import mpmath
import numpy as np
from numpy.typing import NDArray
from sympy import Expr, Symbol

from codegen.checks.base import Context, Finding, not_measured
from codegen.checks.evaluation import DIGITS, Agreement, Function, directional, function_of, gradient
from codegen.checks.module.flat_vector import FlatVector, few_steps, other_symbols
from codegen.expressions import checks as expressions
from codegen.model import Model
from codegen.runtime.search import callbacks
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt
from codegen.transcribe.program import ControlProgram
from codegen.verify.couplings import shared_symbols

_STEPS = 2
_GRID = (0.375, 0.625)
"""What the intervals last, in parts of the duration or of a phase."""
_AMOUNT = 0.05
_SOLVED = 1e-8
_SHIFTS = (1.0, 1e3, 1e6)
_DUAL_SHIFT = 1e-3

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class _Share:
    """A function of unknowns at some indices of the flat vector, then of given numbers."""

    function: Function
    indices: NDArray[np.int64]
    given: tuple[float, ...]


def check(context: Context) -> Iterator[Finding]:
    """Compare gradient, matrix and step at a point beside the initial guess."""
    program = context.control
    module, flat = context.module, FlatVector.on_grid(program, few_steps(program, _STEPS))
    grid = module.make_grid(flat.phase_steps, grid=None if program.inner.times else _GRID)
    shares = list(_shares(context, program, flat, grid))
    unknowns, exact = _trial_point(module, grid, flat, shares)
    if exact is None:
        yield not_measured("assembly", "gradient of the Lagrangian", "it has no finite value beside the guess")
        return
    names, free = flat.names(), np.flatnonzero(flat.free())
    first = Agreement("assembly")
    emitted = np.array(module.evaluate(grid, unknowns).gradient)
    first.compare([f"by {names[i]}" for i in free], emitted[free], [exact[i] for i in free])
    yield first.finding("gradient of the Lagrangian", f"120-digit differences on {flat.phase_steps} intervals")
    matrix = _kkt_matrix(module, grid, unknowns)
    second, direction = Agreement("assembly"), _direction(flat)
    turned = _scattered(
        shares,
        flat,
        lambda share: directional(share.function, _numbers(share, unknowns), list(direction[share.indices])),
    )
    second.compare([f"row of {names[i]}" for i in free], (matrix @ direction)[free], [turned[i] for i in free])
    yield second.finding("KKT matrix", "120-digit second differences along a random direction")
    yield _newton_step(module, grid, unknowns, matrix, emitted, free, names)


def _shares(context: Context, program: ControlProgram, flat: FlatVector, grid: Any) -> Iterator[_Share]:
    """All shares of the Lagrangian."""
    others, count = other_symbols(program), len(program.model.parameters) + len(program.boundary_values)
    whole = 1.0 if program.scaled_time else _duration(context)
    parts = np.diff(grid.nodes) / grid.steps if program.inner.times else _GRID
    lengths = whole * np.tile(parts, flat.steps // flat.phase_steps)
    times = np.append(0.0, np.cumsum(lengths))

    def given(body: int, k: int) -> tuple[float, ...]:
        own, number = grid.parameters[body], flat.inner_nodes.get(k)
        numbers = np.reshape(own[count : count + len(program.inner.values)], (-1, max(1, len(program.inner.times))))
        here = [0.0 if number is None else row[number] for row in numbers[1:]]
        return (*own[:count], *here, times[k], lengths[min(k, flat.steps - 1)])

    def function(scalar: Expr, unknowns: tuple[Symbol, ...]) -> Function:
        return function_of([*unknowns, *others], [scalar])

    elements = {e.element: function(e.element, program.element_symbols) for e in program.interval_elements}
    start = function(program.start.element, (*program.left_symbols, *program.shared_symbols))
    end = function(program.end.element, (*program.right_symbols, *program.shared_symbols))
    sample = program.sample
    losses = function(sample.element, (*sample.symbols, *program.element_symbols)) if sample else end
    for body in range(program.bodies):
        for k in range(flat.steps):
            yield _Share(elements[flat.share(k).element], flat.element(body, k), given(body, k))
        for k, arguments in _samples(context.model, body, times) if sample else ():
            yield _Share(partial(losses, *arguments), flat.element(body, k), given(body, k))
        yield _Share(start, flat.end(body, "start"), given(body, 0))
        yield _Share(end, flat.end(body, "end"), given(body, flat.steps))
    symbols, every = shared_symbols(program), np.arange(flat.first_shared, flat.first_coupling)
    for i, coupling in enumerate(program.couplings):
        multiplier = Symbol(f"_{coupling.multiplier.name}", real=True)
        indices = np.append(every, flat.first_coupling + i)
        yield _Share(function(multiplier * coupling.expression, (*symbols, multiplier)), indices, given(0, 0))


def _samples(model: Model, body: int, times: Vector) -> Iterator[tuple[int, list[float]]]:
    """The interval of each sample of a body, with where it lies there, its values and their weights."""
    data = model.measurements[body]
    columns = len(data.layout.columns)
    for time, *row in data.rows:
        k = min(int(np.sum(times[1:] <= time)), times.size - 2)
        fraction = (time - times[k]) / (times[k + 1] - times[k])
        pairs = [
            (z, 1 / s) if np.isfinite(z) else (0.0, 0.0) for z, s in zip(row[:columns], row[columns:], strict=True)
        ]
        yield k, [fraction, *(z for z, _ in pairs), *(weight for _, weight in pairs)]


def _duration(context: Context) -> float:
    value = expressions.number_at(context.model.duration, context.model.default_values)
    assert value is not None, "checked when the model was made"
    return value


def _numbers(share: _Share, unknowns: Vector) -> list[float]:
    return [*unknowns[share.indices], *share.given]


def _scattered(shares: list[_Share], flat: FlatVector, derivative: Callable[[_Share], list[Any]]) -> list[Any]:
    """Sum of the derivatives of all shares at their indices; of an unknown that equals a shared one, at the latter."""
    total, representatives = [mpmath.mpf(0)] * flat.size, flat.representatives()
    with mpmath.workdps(DIGITS):
        for share in shares:
            for index, value in zip(representatives[share.indices], derivative(share), strict=True):
                total[index] += value
    return total


def _trial_point(module: Any, grid: Any, flat: FlatVector, shares: list[_Share]) -> tuple[Vector, list[Any] | None]:
    """Unknowns beside the guess, closer and closer to it until the gradient is finite there, and that gradient."""
    generator, free = np.random.default_rng(17), flat.free()
    noise = generator.uniform(-1.0, 1.0, flat.size)
    guess = module.initial_guess(grid)
    for amount in (_AMOUNT, _AMOUNT / 10, _AMOUNT / 1000):
        unknowns = guess + np.where(free, amount * noise * (1.0 + np.abs(guess)), 0.0)
        unknowns = module.with_pinned_values(grid, unknowns)

        def slopes(share: Any, unknowns: Any = unknowns) -> Any:
            return gradient(share.function, _numbers(share, unknowns), range(share.indices.size))

        try:
            exact = _scattered(shares, flat, slopes)
            if all(np.isfinite(float(value)) for value in exact):
                return unknowns, exact
        except (TypeError, ValueError, ArithmeticError):
            continue  # outside the domain of an expression
    return guess, None


def _direction(flat: FlatVector) -> Vector:
    """A random direction in which unknowns that equal a shared one follow it, and given ones stay."""
    free, representatives = flat.free(), flat.representatives()
    direction = np.where(free, np.random.default_rng(23).uniform(-1.0, 1.0, flat.size), 0.0)
    return np.asarray(direction[representatives])


def _kkt_matrix(module: Any, grid: Any, unknowns: Vector) -> Vector:
    """The dense KKT matrix from the module's Jacobian and Hessian; zero in what is given."""
    matrix = np.zeros((unknowns.size, unknowns.size))
    primal, dual = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    rows, columns, values = callbacks.hessian(grid, unknowns)
    np.add.at(matrix, (primal[rows], primal[columns]), values)
    rows, columns, values = callbacks.jacobian(grid, unknowns)
    np.add.at(matrix, (dual[rows], primal[columns]), values)
    np.add.at(matrix, (primal[columns], dual[rows]), values)
    return matrix


def _newton_step(
    module: Any, grid: Any, unknowns: Vector, matrix: Vector, gradient_: Vector, free: Any, names: list[str]
) -> Finding:
    """The structured elimination against the dense matrix; a shift of the Hessian makes both regular."""
    system, step = allocate_system(grid), np.empty_like(unknowns)
    subject = "Newton step"
    # The last shift is enough whatever the Hessian's units: it makes every row diagonally dominant.
    primal = module.primal_unknowns(grid)
    dominant = np.ones(unknowns.size)
    dominant[primal] += np.abs(matrix[np.ix_(primal, primal)]).sum(axis=1)
    for shift in (*_SHIFTS, dominant[free]):
        diagonal = np.zeros(unknowns.size)
        diagonal[free] = np.where(grid.is_multiplier[free], -_DUAL_SHIFT, shift)
        excess = factor_kkt(grid, unknowns, 1.0, diagonal, system)
        if is_factored(excess):
            break
    else:
        return Finding("assembly", subject, False, "the KKT matrix cannot be factored, however its Hessian is shifted")
    solve_kkt(grid, system, gradient_, step)
    shifted = matrix[np.ix_(free, free)] + np.diag(diagonal[free])
    left_over = np.abs(shifted @ step[free] + gradient_[free])
    sizes = np.abs(shifted) @ np.abs(step[free]) + np.abs(gradient_[free]).max(initial=0.0)
    errors = left_over / np.where(sizes > 0.0, sizes, 1.0)
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    if np.isfinite(errors).all() and errors[worst] <= _SOLVED:
        return Finding("assembly", subject, True, f"it solves all {free.size} linear equations to {errors[worst]:.1g}")
    return Finding(
        "assembly", subject, False, f"it leaves the row of {names[free[worst]]} by {errors[worst]:.1g} of its terms"
    )
