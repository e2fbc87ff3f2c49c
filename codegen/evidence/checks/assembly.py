"""Checks of the assembled optimality system, and of the values and bounds that the module gives to unknowns.

Assembly: the Lagrangian of the optimisation problem is the sum of terms: one for each interval and end of every body,
each measurement, and each condition between bodies. The system is assembled on a few intervals of different lengths.
Differences of the Lagrangian, in 120-digit arithmetic, verify the loops, index tables and elimination of the module.

Given values: boundary values, unknowns that equal a linking unknown, and bounds are compared with the author's problem.
They do not appear in the Lagrangian, so that checks of kernels cannot verify them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import TypeAlias

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from codegen.discretise.forms import in_velocities
from codegen.discretise.model.definitions import prescribed
from codegen.discretise.program import ControlProgram, EndElement, Unknown
from codegen.emit.verify.shares import shared_symbols
from codegen.evidence.checks.base import (
    DIGITS,
    Agreement,
    Context,
    Finding,
    Function,
    Numbers,
    directional,
    function_of,
    gradient,
    not_measured,
)
from codegen.evidence.checks.layout import FlatVector, few_steps, other_symbols
from codegen.runtime.record import Kind, Role
from codegen.runtime.search import point
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt
from codegen.solving.loading import Grid, Vector
from codegen.symbolic import checks as expressions

_STEPS = 2
_GRID = (0.375, 0.625)  # lengths of the intervals as fractions of the duration, or of a phase
_AMOUNT = 0.05  # relative distance of the point from the guess
_SOLVED = 1e-8  # residual of the Newton step relative to its terms
_SHIFTS = (1.0, 1e3, 1e6)  # of the diagonal of the Hessian, in this order
_DUAL_SHIFT = 1e-3
_CONSTANT = 1e-12  # largest change of an entry of a constant matrix, relative to the largest entry


@dataclass(frozen=True)
class _Share:
    """A term of the Lagrangian, as a function of the unknowns at `indices` in the flat vector, followed by `data`."""

    function: Function
    indices: NDArray[np.int64]
    data: tuple[float, ...]

    def numbers(self, unknowns: Vector) -> list[float]:
        return [*unknowns[self.indices], *self.data]


def check_assembly(context: Context) -> Iterator[Finding]:
    """Compare the gradient, KKT matrix and Newton step of the module with references, at a point near the guess."""
    program = context.control
    module, flat = context.module, FlatVector.on_grid(program, few_steps(program, _STEPS))
    grid = module.make_grid(flat.phase_steps, grid=None if program.inner.times else _GRID)
    shares = list(_shares(context, program, flat, grid))
    unknowns, exact = _trial_point(module, grid, flat, shares)
    if exact is None:
        yield not_measured("assembly", "gradient of the Lagrangian", "it has no finite value beside the guess")
        return
    names, mask = flat.names(), flat.free()
    free = np.flatnonzero(mask)
    first = Agreement("assembly")
    emitted = np.array(module.evaluate(grid, unknowns).gradient)
    first.compare([f"by {names[i]}" for i in free], emitted[free], [exact[i] for i in free])
    yield first.finding("gradient of the Lagrangian", f"120-digit differences on {flat.phase_steps} intervals")

    # The dense KKT matrix from the module's Jacobian and Hessian; entries of prescribed unknowns are zero.
    matrix = np.zeros((unknowns.size, unknowns.size))
    primal, dual = module.primal_unknowns(grid), module.multiplier_unknowns(grid)
    rows, columns, values = point.hessian(grid, unknowns)
    np.add.at(matrix, (primal[rows], primal[columns]), values)
    rows, columns, values = point.jacobian(grid, unknowns)
    np.add.at(matrix, (dual[rows], primal[columns]), values)
    np.add.at(matrix, (primal[columns], dual[rows]), values)
    # A random direction. Unknowns that equal a linking unknown follow it, and prescribed unknowns stay fixed.
    direction = np.where(mask, np.random.default_rng(23).uniform(-1.0, 1.0, flat.size), 0.0)[flat.representatives()]
    turned = _scattered(
        shares, flat, lambda share: directional(share.function, share.numbers(unknowns), list(direction[share.indices]))
    )
    second = Agreement("assembly")
    second.compare([f"row of {names[i]}" for i in free], (matrix @ direction)[free], [turned[i] for i in free])
    yield second.finding("KKT matrix", "120-digit second differences along a random direction")
    if module.problem.structure.linear_quadratic:
        # The module takes the matrix for constant: its values at two points must agree.
        values, others = (
            np.concatenate([point.hessian(grid, at)[2], point.jacobian(grid, at)[2]])
            for at in (unknowns, unknowns + direction * (1.0 + np.abs(unknowns)))
        )
        change = np.abs(others - values).max(initial=0.0)
        right = "the same at two points, so that one Newton step solves the problem"
        wrong = f"entries change by {change:.1g} between two points, in a problem taken for linear-quadratic"
        passed = change <= _CONSTANT * np.abs(values).max(initial=0.0)
        yield Finding.decided("assembly", "constant KKT matrix", passed, right, wrong)
    # Compare the structured elimination with the dense matrix. A shift of the Hessian makes both regular.
    system, step = allocate_system(grid), np.empty_like(unknowns)
    # The last shift is large enough for any units of the Hessian: it makes every row diagonally dominant.
    dominant = np.ones(unknowns.size)
    dominant[primal] += np.abs(matrix[np.ix_(primal, primal)]).sum(axis=1)
    for shift in (*_SHIFTS, dominant[free]):
        diagonal = np.zeros(unknowns.size)
        diagonal[free] = np.where(grid.is_multiplier[free], -_DUAL_SHIFT, shift)
        excess = factor_kkt(grid, unknowns, 1.0, diagonal, system)
        if is_factored(excess):
            break
    else:
        detail = "the KKT matrix cannot be factored, however its Hessian is shifted"
        yield Finding("assembly", "Newton step", False, detail)
        return
    solve_kkt(grid, system, emitted, step)
    shifted = matrix[np.ix_(free, free)] + np.diag(diagonal[free])
    residual = np.abs(shifted @ step[free] + emitted[free])
    sizes = np.abs(shifted) @ np.abs(step[free]) + np.abs(emitted[free]).max(initial=0.0)
    errors = residual / np.where(sizes > 0.0, sizes, 1.0)
    worst = int(np.argmax(np.where(np.isfinite(errors), errors, np.inf)))
    right = f"it solves all {free.size} linear equations to {errors[worst]:.1g}"
    wrong = f"it leaves the row of {names[free[worst]]} by {errors[worst]:.1g} of its terms"
    yield Finding.decided(
        "assembly", "Newton step", np.isfinite(errors).all() and errors[worst] <= _SOLVED, right, wrong
    )


def _shares(context: Context, program: ControlProgram, flat: FlatVector, grid: Grid) -> Iterator[_Share]:
    """Yield the terms whose sum is the Lagrangian: of intervals, measurements, ends, and conditions between bodies."""
    others, count = other_symbols(program), len(program.model.parameters) + len(program.boundary_values)
    duration: float | None = 1.0
    if not program.scaled_time:
        duration = expressions.number_at(context.model.duration, context.model.default_values)
        assert duration is not None, "checked when the model was made"
    parts = np.diff(grid.nodes) / grid.steps if program.inner.times else _GRID
    lengths = duration * np.tile(parts, flat.steps // flat.phase_steps)
    times = np.append(0.0, np.cumsum(lengths))

    def data(body: int, k: int) -> tuple[float, ...]:
        row, number = grid.parameters[body], flat.inner_nodes.get(k)
        inner = np.reshape(row[count : count + len(program.inner.values)], (-1, max(1, len(program.inner.times))))
        at_node = [0.0 if number is None else numbers[number] for numbers in inner[1:]]
        return (*row[:count], *at_node, times[k], lengths[min(k, flat.steps - 1)])

    def function(scalar: Expr, unknowns: tuple[Symbol, ...]) -> Function:
        return function_of([*unknowns, *others], [scalar])

    elements = {e.element: function(e.element, program.element_symbols) for e in program.interval_elements}
    start = function(program.start.element, (*program.left_symbols, *program.linking.symbols))
    end = function(program.end.element, (*program.right_symbols, *program.linking.symbols))
    sample = program.sample
    losses = function(sample.element, (*sample.symbols, *program.element_symbols)) if sample else end
    for body in range(program.model.bodies):
        for k in range(flat.steps):
            yield _Share(elements[flat.share(k).element], flat.element(body, k), data(body, k))
        for time, *row in context.model.measurements[body].rows if sample else ():
            # The position of a measurement in its interval, then its values and their weights.
            k = min(int(np.sum(times[1:] <= time)), times.size - 2)
            arguments, columns = [(time - times[k]) / (times[k + 1] - times[k])], len(row) // 2
            arguments += [z if np.isfinite(z) else 0.0 for z in row[:columns]]
            arguments += [1 / s if np.isfinite(z) else 0.0 for z, s in zip(row[:columns], row[columns:], strict=True)]
            yield _Share(partial(losses, *arguments), flat.element(body, k), data(body, k))
        yield _Share(start, flat.end(body, "start"), data(body, 0))
        yield _Share(end, flat.end(body, "end"), data(body, flat.steps))
    symbols, every = shared_symbols(program), np.arange(flat.first_shared, flat.first_coupling)
    for i, coupling in enumerate(program.linking.couplings):
        multiplier = Symbol(f"_{coupling.multiplier.name}", real=True)
        indices = np.append(every, flat.first_coupling + i)
        yield _Share(function(multiplier * coupling.expression, (*symbols, multiplier)), indices, data(0, 0))


def _scattered(shares: list[_Share], flat: FlatVector, derivative: Callable[[_Share], Numbers]) -> Numbers:
    """Return the sum of `derivative(term)` over all terms, by unknown. Unknowns tied to a linking unknown add to it."""
    total, representatives = [mpmath.mpf(0)] * flat.size, flat.representatives()
    with mpmath.workdps(DIGITS):
        for share in shares:
            for index, value in zip(representatives[share.indices], derivative(share), strict=True):
                total[index] += value
    return total


def _trial_point(
    module: ModuleType, grid: Grid, flat: FlatVector, shares: list[_Share]
) -> tuple[Vector, Numbers | None]:
    """Return a point near the guess, nearer until the gradient is finite, and the gradient there (None if never)."""
    generator, free = np.random.default_rng(17), flat.free()
    noise = generator.uniform(-1.0, 1.0, flat.size)
    guess = module.initial_guess(grid)
    for amount in (_AMOUNT, _AMOUNT / 10, _AMOUNT / 1000):
        unknowns = guess + np.where(free, amount * noise * (1.0 + np.abs(guess)), 0.0)
        unknowns = module.with_pinned_values(grid, unknowns)

        def slopes(share: _Share, unknowns: Vector = unknowns) -> Numbers:
            return gradient(share.function, share.numbers(unknowns), range(share.indices.size))

        try:
            exact = _scattered(shares, flat, slopes)
            if all(np.isfinite(float(value)) for value in exact):
                return unknowns, exact
        except (TypeError, ValueError, ArithmeticError):
            continue  # outside the domain of an expression
    return guess, None


_FEW_STEPS = 3
_EQUAL = 1e-12

_Limits: TypeAlias = dict[str, tuple[Expr | None, Expr | None]]


def check_given_values(context: Context) -> Iterator[Finding]:
    """Compare the module's parameters, boundary values and bounds with the author's, entry by entry."""
    program = context.control
    flat = FlatVector.on_grid(program, few_steps(program, _FEW_STEPS))
    # Compare every body's row of parameters and boundary values. Values of a free end cannot appear there.
    module, model = context.module, context.model
    written: dict[tuple[str, str], Expr] = {}
    first, last, rates = (model.phases or (model,))[0], (model.phases or (model,))[-1], model.rates
    if program.method == "variational" and model.form == "hamiltonian":
        first, last = in_velocities(first), in_velocities(last)  # prescribed momenta are velocities there
        rates = first.rates
    for where, boundary in (("start", first.start), ("end", last.end)):
        assert boundary is not None, "a control problem has an end"
        quantities = zip((*model.coordinates, *rates), (*boundary.positions, *boundary.rates), strict=True)
        written |= {(where, q.name): value for q, value in quantities if value is not None}
    grid = module.make_grid(flat.phase_steps)
    ends = [f"{v.where} {v.quantity}" for v in program.boundary_values]
    if {(v.where, v.quantity) for v in program.boundary_values} != written.keys():
        detail = f"values are given of {', '.join(ends)}, not of what was written"
        yield Finding("given values", "boundary values", False, detail)
    else:
        entries = [*(f"parameter {p}" for p in model.parameters), *ends]
        names, pairs = list[str](), list[tuple[float, float]]()
        for body in range(program.model.bodies):
            ours = [_number(written[v.where, v.quantity], program, body) for v in program.boundary_values]
            names += [f"{entry} of body {body} is" for entry in entries]
            pairs += zip(grid.parameters[body][: len(entries)], [*model.defaults, *ours], strict=True)
        yield _compared("boundary values", names, pairs, f"{', '.join(ends) or 'none'}: as written")
    # Compare the entries that `with_pinned_values` overwrites in an arbitrary vector, and their values.
    before = np.random.default_rng(5).uniform(1.0, 2.0, flat.size)
    expected, free = before.copy(), flat.free()
    for body in range(program.model.bodies):
        values = {v.symbol: _number(v.value, program, body) for v in program.boundary_values}
        for k, end in ((0, program.start), (flat.steps, program.end)):
            node, shared = flat.node(body, k), flat.shared(body)
            for index, value in end.pins:
                expected[node[index]] = _number(value, program, body, values)
            for index, j, offset in end.shared:
                expected[node[index]] = before[shared[j]] + _number(offset, program, body, values)
        for k in range(1, flat.steps):
            indices = flat.node(body, k)[list(program.inner.unknowns)]
            expected[indices] = np.where(free[indices], before[indices], 0.0)
    pinned, fixed = module.with_pinned_values(grid, before), np.count_nonzero(expected != before)
    detail = f"{fixed} unknowns at the ends have their values, all others are left alone"
    names = [f"{name} is given" for name in flat.names()]
    yield _compared("pinned unknowns", names, list(zip(pinned, expected, strict=True)), detail)
    # Compare tables of bounds with the author's bounds. Slacks are not negative, pinned unknowns have no bounds.
    if not program.has_inequalities:
        passed = not hasattr(module, "variable_bounds")
        detail = "there are none" if passed else "there are none, but the module has variable_bounds"
        yield Finding("given values", "bounds", passed, detail)
        return
    lower, upper = np.full(flat.size, -np.inf), np.full(flat.size, np.inf)
    common: _Limits = {free.symbol.name: (free.lower, free.upper) for free in model.free_parameters}
    common |= {u.name: (sympy.S.Zero, None) for u in program.linking.unknowns if u.kind.role is Role.SLACK}
    common |= {slack.name: (slack.lower, None) for slack in program.slacks}
    common |= {u.name: (u.lower, None) for u in program.node if u.kind.role is Role.SLACK or u.kind is Kind.PACE}
    of_phases: list[_Limits] = [
        common | {bound.symbol.name: (bound.lower, bound.upper) for bound in phase.bounds}
        for phase in model.phases or (model,)
    ]

    def put(indices: NDArray[np.int64], unknowns: Sequence[Unknown], body: int, limits: _Limits) -> None:
        for index, unknown in zip(indices, unknowns, strict=True):
            least, greatest = limits.get(unknown.name, (None, None))
            if least is not None:
                lower[index] = max(lower[index], _number(least, program, body))
            if greatest is not None:
                upper[index] = min(upper[index], _number(greatest, program, body))

    def release(names: Sequence[str], end: EndElement | None, body: int, k: int, interval: int) -> None:
        """Remove the bounds of quantities that are determined at a node. Slacks keep an inactive bound."""
        indices = flat.interval(body, interval)[-len(program.slacks) :]
        slacks = {slack.name: index for slack, index in zip(program.slacks, indices, strict=False)}
        at_node = {unknown.name: index for unknown, index in zip(program.node, flat.node(body, k), strict=True)}
        for name in names:
            is_slack = name in slacks or (end is not None and name in [program.node[i].name for i, _ in end.slacks])
            index = slacks[name] if name in slacks else at_node[name]
            lower[index], upper[index] = -1.0 if is_slack else -np.inf, np.inf

    inner, nodes = program.inner, {number: k for k, number in flat.inner_nodes.items()}
    for body in range(program.model.bodies):
        for k in range(flat.steps + 1):
            # The node at a switch belongs to the phase before it.
            put(flat.node(body, k), program.node, body, of_phases[max(k - 1, 0) // flat.phase_steps])
            if k < flat.steps:
                inside = flat.inside[len(program.node) :]
                put(flat.interval(body, k), inside, body, of_phases[k // flat.phase_steps])
        put(flat.shared(body), program.linking.unknowns, body, of_phases[0])
        for k, end in ((0, program.start), (flat.steps, program.end)):
            lower[flat.node(body, k)[[slack for slack, _ in end.slacks]]] = 0.0
            for index, bound in end.bounds:
                unknown = program.node[index]
                put(flat.node(body, k)[[index]], [unknown], body, {unknown.name: (bound.lower, bound.upper)})
            release([name for name, _ in end.determined], end, body, k, min(k, flat.steps - 1))
        for number, earliest, latest in inner.windows:
            assert inner.clock is not None, "windows are of free times"
            index = flat.node(body, nodes[number])[inner.clock]
            lower[index] = lower[index] if earliest is None else _number(earliest, program, body)
            upper[index] = upper[index] if latest is None else _number(latest, program, body)
        for number, name, back in inner.determined:
            release([name], None, body, nodes[number], nodes[number] - back)
    for number in range(1, len(program.phases)):
        # Bounds of the later phase also hold at the switch, unless the quantity jumps.
        node, jumps = flat.node(0, number * flat.phase_steps), model.jumps[number - 1]
        jumping = {symbol.name for symbol, _ in jumps}
        put(node, program.node, 0, {name: pair for name, pair in of_phases[number].items() if name not in jumping})
        at_end = {symbol.name for symbol in prescribed(model.phases[number - 1], "end")}
        indices = node[[i for i, unknown in enumerate(program.node) if unknown.name in at_end]]
        lower[indices], upper[indices] = -np.inf, np.inf
    lower[~free], upper[~free] = -np.inf, np.inf

    bounds = module.variable_bounds(grid)
    names = [f"the {side} bound of {name} is" for side in ("lower", "upper") for name in flat.names()]
    pairs = [*zip(bounds[0], lower, strict=True), *zip(bounds[1], upper, strict=True)]
    count = np.count_nonzero(np.isfinite(lower)) + np.count_nonzero(np.isfinite(upper))
    detail = f"all {count} bounds on {flat.phase_steps} intervals are as written"
    yield _compared("bounds", names, pairs, detail)


def _number(value: Expr, program: ControlProgram, body: int, more: Mapping[Symbol, float] | None = None) -> float:
    """Return the value of an expression of parameters, the body's index and `more` symbols; nan if it has no value."""
    values: dict[Symbol, float] = dict(program.model.default_values) | dict(more or {})
    if program.model.body is not None:
        values[program.model.body] = float(body)
    number = expressions.number_at(sympy.sympify(value), values)
    return float("nan") if number is None else number


def _compared(subject: str, names: Sequence[str], pairs: Sequence[tuple[float, float]], right: str) -> Finding:
    """Return a finding on `pairs` (value, expected), with names such as "x is"; `right` is the detail if all agree."""
    wrong = [
        f"{name} {value:.12g}, expected {expected:.12g}"
        for name, (value, expected) in zip(names, pairs, strict=True)
        if not (value == expected or abs(value - expected) <= _EQUAL * max(1.0, abs(expected)))
    ]
    more = f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""
    return Finding("given values", subject, not wrong, f"{wrong[0]}{more}" if wrong else right)
