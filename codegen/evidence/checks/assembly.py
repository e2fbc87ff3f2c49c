"""The whole of an optimality system on a few intervals of different lengths, put together again.

The Lagrangian of the optimisation problem is the sum of the derived shares of all intervals and ends of all bodies,
and of the conditions between bodies. Its differences, in 120-digit arithmetic, tell whether the module's loops, index
tables and elimination do what the equations say.

Values and bounds that the module gives to unknowns, against those of the author's problem. They are no part of the
Lagrangian, so that no kernel tells of them: values at both ends, unknowns that equal a shared one, and the tables of
least and greatest values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeAlias

import mpmath
import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from codegen.discretise.forms import in_velocities
from codegen.discretise.model.definitions import Model, prescribed
from codegen.discretise.program import ControlProgram, Unknown
from codegen.emit.verify.shares import shared_symbols
from codegen.evidence.checks.base import (
    DIGITS,
    Agreement,
    Context,
    Finding,
    Function,
    directional,
    function_of,
    gradient,
    not_measured,
)
from codegen.evidence.checks.layout import FlatVector, few_steps, other_symbols
from codegen.runtime.record import Kind, Role
from codegen.runtime.search import callbacks
from codegen.runtime.search.linear_system import allocate_system, factor_kkt, is_factored, solve_kkt
from codegen.symbolic import checks as expressions

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


def check_assembly(context: Context) -> Iterator[Finding]:
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


_FEW_STEPS = 3
_EQUAL = 1e-12

Values = NDArray[np.float64]
_Limits: TypeAlias = dict[str, tuple[Expr | None, Expr | None]]


def check_given_values(context: Context) -> Iterator[Finding]:
    """Compare the table of parameters, pinned values and bounds, entry by entry."""
    program = context.control
    yield _parameters(context, program)
    yield _pinned(context, program)
    yield _bounds(context, program)


def _parameters(context: Context, program: ControlProgram) -> Finding:
    """Every body's row of parameters and boundary values; what a free end has been given cannot stand there."""
    model = context.model
    given: dict[tuple[str, str], sympy.Expr] = {}
    first, last = (model.phases or (model,))[0], (model.phases or (model,))[-1]
    if program.method == "variational" and model.form == "hamiltonian":
        first, last = in_velocities(first), in_velocities(last)  # momenta that are given are velocities there
        model = replace(model, rates=first.rates)
    for where, boundary in (("start", first.start), ("end", last.end)):
        assert boundary is not None, "a control problem has an end"
        quantities = zip((*model.coordinates, *model.rates), (*boundary.positions, *boundary.rates), strict=True)
        given |= {(where, q.name): value for q, value in quantities if value is not None}
    grid, count = context.module.make_grid(few_steps(program, _FEW_STEPS)), len(model.parameters)
    names = [
        *(f"parameter {p}" for p in model.parameters),
        *(f"{v.where} {v.quantity}" for v in program.boundary_values),
    ]
    if {(v.where, v.quantity) for v in program.boundary_values} != given.keys():
        return _finding("boundary values", [f"values are given of {', '.join(names[count:])}, not of what was written"])
    wrong = []
    for body in range(program.bodies):
        values = [given[v.where, v.quantity] for v in program.boundary_values]
        wanted = [*model.defaults, *(_number(value, program, body) for value in values)]
        for name, found, value in zip(names, grid.parameters[body], wanted, strict=False):
            if not _equal(found, value):
                wrong.append(f"{name} of body {body} is {found:.12g}, expected {value:.12g}")
    return _finding("boundary values", wrong, f"{', '.join(names[count:]) or 'none'}: as written")


def _pinned(context: Context, program: ControlProgram) -> Finding:
    """What `with_pinned_values` overwrites in an arbitrary vector, and with what."""
    module, flat = context.module, FlatVector.on_grid(program, few_steps(program, _FEW_STEPS))
    grid = module.make_grid(flat.phase_steps)
    before = np.random.default_rng(5).uniform(1.0, 2.0, flat.size)
    wanted = before.copy()
    for body in range(program.bodies):
        known = {v.symbol: _number(v.value, program, body) for v in program.boundary_values}
        for k, end in ((0, program.start), (flat.steps, program.end)):
            node, shared = flat.node(body, k), flat.shared(body)
            for index, value in end.pins:
                wanted[node[index]] = _number(value, program, body, known)
            for index, j, offset in end.shared:
                wanted[node[index]] = before[shared[j]] + _number(offset, program, body, known)
        absent = list(program.inner.unknowns)
        for k in range(1, flat.steps):
            indices = flat.node(body, k)[absent]
            wanted[indices] = np.where(flat.free()[indices], before[indices], 0.0)
    found, names = module.with_pinned_values(grid, before), flat.names()
    wrong = [
        f"{names[i]} is given {found[i]:.12g}, expected {wanted[i]:.12g}"
        for i in range(flat.size)
        if not _equal(found[i], wanted[i])
    ]
    fixed = np.count_nonzero(wanted != before)
    return _finding(
        "pinned unknowns", wrong, f"{fixed} unknowns at the ends have their values, all others are left alone"
    )


def _bounds(context: Context, program: ControlProgram) -> Finding:
    """Tables of bounds against those that the author wrote; slacks are not negative, pinned unknowns unbounded."""
    module, flat = context.module, FlatVector.on_grid(program, few_steps(program, _FEW_STEPS))
    if not program.has_inequalities:
        wrong = ["there are none, but the module has variable_bounds"] if hasattr(module, "variable_bounds") else []
        return _finding("bounds", wrong, "there are none")
    lower, upper = np.full(flat.size, -np.inf), np.full(flat.size, np.inf)
    written = _written(context.model, program)

    def put(indices: NDArray[np.intp], unknowns: Sequence[Unknown], body: int, given: _Limits) -> None:
        for index, unknown in zip(indices, unknowns, strict=True):
            least, greatest = given.get(unknown.name, (None, None))
            if least is not None:
                lower[index] = max(lower[index], _number(least, program, body))
            if greatest is not None:
                upper[index] = min(upper[index], _number(greatest, program, body))

    for body in range(program.bodies):
        for k in range(flat.steps + 1):
            # The node at a switch belongs to the phase before it.
            phase = max(k - 1, 0) // flat.phase_steps
            put(flat.node(body, k), program.node, body, written[phase])
            if k < flat.steps:
                inside = flat.inside[len(program.node) :]
                put(flat.interval(body, k), inside, body, written[k // flat.phase_steps])
        put(flat.shared(body), program.shared, body, written[0])
        for k, end in ((0, program.start), (flat.steps, program.end)):
            lower[flat.node(body, k)[[slack for slack, _ in end.slacks]]] = 0.0
            for index, bound in end.bounds:
                unknown, limits = program.node[index], (bound.lower, bound.upper)
                put(flat.node(body, k)[[index]], [unknown], body, {unknown.name: limits})
            interval = flat.interval(body, min(k, flat.steps - 1))
            determined = [name for name, _ in end.determined]
            _release(program, determined, end.slacks, flat.node(body, k), interval, (lower, upper))
        _at_inner_times(program, flat, body, (lower, upper))
    for number in range(1, len(program.phases)):
        node = flat.node(0, number * flat.phase_steps)
        put(node, program.node, 0, _continued(context.model, number, written[number]))
        given = {symbol.name for symbol in prescribed(context.model.phases[number - 1], "end")}
        indices = node[[i for i, unknown in enumerate(program.node) if unknown.name in given]]
        lower[indices], upper[indices] = -np.inf, np.inf
    lower[~flat.free()], upper[~flat.free()] = -np.inf, np.inf
    return _compared_bounds(module, flat, lower, upper)


def _release(
    program: ControlProgram,
    determined: Sequence[str],
    own_slacks: Sequence[tuple[int, int]],
    node: NDArray[np.intp],
    interval: NDArray[np.intp],
    bounds: tuple[Values, Values],
) -> None:
    """Take away the bounds of what is determined at a node; slacks keep one that they cannot reach."""
    slacks = {slack.name: index for slack, index in zip(program.slacks, interval[-len(program.slacks) :], strict=False)}
    at_node = {unknown.name: index for unknown, index in zip(program.node, node, strict=True)}
    for name in determined:
        is_slack = name in slacks or name in [program.node[i].name for i, _ in own_slacks]
        index = slacks[name] if name in slacks else at_node[name]
        bounds[0][index], bounds[1][index] = -1.0 if is_slack else -np.inf, np.inf


def _at_inner_times(program: ControlProgram, flat: FlatVector, body: int, bounds: tuple[Values, Values]) -> None:
    """Put the windows of inner times, and take away the bounds of what is determined there."""
    inner, nodes = program.inner, {number: k for k, number in flat.inner_nodes.items()}
    for number, earliest, latest in inner.windows:
        assert inner.clock is not None, "windows are of free times"
        index = flat.node(body, nodes[number])[inner.clock]
        for limits, value in zip(bounds, (earliest, latest), strict=True):
            limits[index] = limits[index] if value is None else _number(value, program, body)
    for number, name, before in inner.determined:
        k = nodes[number]
        _release(program, [name], (), flat.node(body, k), flat.interval(body, k - before), bounds)


def _written(model: Model, program: ControlProgram) -> list[_Limits]:
    """The bounds of every phase by name."""
    common: _Limits = {free.symbol.name: (free.lower, free.upper) for free in model.free_parameters}
    common |= {u.name: (sympy.S.Zero, None) for u in program.shared if u.kind.role is Role.SLACK}
    common |= {slack.name: (slack.lower, None) for slack in program.slacks}
    common |= {u.name: (u.lower, None) for u in program.node if u.kind.role is Role.SLACK or u.kind is Kind.PACE}
    models = model.phases or (model,)
    return [common | {bound.symbol.name: (bound.lower, bound.upper) for bound in own.bounds} for own in models]


def _continued(model: Model, number: int, bounds: _Limits) -> _Limits:
    """Those bounds of a phase that hold before the switch to it as well."""
    jumping = {symbol.name for symbol, _ in model.jumps[number - 1]}
    return {name: pair for name, pair in bounds.items() if name not in jumping}


def _compared_bounds(module: Any, flat: FlatVector, lower: Values, upper: Values) -> Finding:
    found, names = module.variable_bounds(module.make_grid(flat.phase_steps)), flat.names()
    wrong = [
        f"the {side} bound of {names[i]} is {values[i]:.12g}, expected {wanted[i]:.12g}"
        for side, values, wanted in (("lower", found[0], lower), ("upper", found[1], upper))
        for i in range(flat.size)
        if not _equal(values[i], wanted[i])
    ]
    count = np.count_nonzero(np.isfinite(lower)) + np.count_nonzero(np.isfinite(upper))
    return _finding("bounds", wrong, f"all {count} bounds on {flat.phase_steps} intervals are as written")


def _number(value: Expr, program: ControlProgram, body: int, more: Mapping[sympy.Symbol, float] | None = None) -> float:
    """An expression of parameters and of the body's number."""
    known: dict[sympy.Symbol, float] = dict(program.model.default_values) | dict(more or {})
    if program.body is not None:
        known[program.body] = float(body)
    number = expressions.number_at(sympy.sympify(value), known)
    return float("nan") if number is None else number


def _equal(found: float, wanted: float) -> bool:
    return bool(found == wanted or abs(found - wanted) <= _EQUAL * max(1.0, abs(wanted)))


def _finding(subject: str, wrong: list[str], right: str = "") -> Finding:
    more = f", and {len(wrong) - 1} more" if len(wrong) > 1 else ""
    return Finding("given values", subject, not wrong, f"{wrong[0]}{more}" if wrong else right)
