"""Every emitted kernel against the expression that it stands for, differentiated independently, at random points.

The references are differences in 120-digit arithmetic of the undifferentiated expression, and for the gradient also
complex steps (Squire and Trapp, 1998) of a plain numpy evaluation where the expression is analytic.

The conditions between bodies: kernels and tables of their terms against the conditions that the author wrote. The
module holds a few kinds of term and says where each occurs. Put together again, terms must give every condition, its
slopes and its curvatures.

Tables of a module against their files, and their derivatives against scipy's splines through the same values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any

import mpmath
import numpy as np
import sympy
from scipy.interpolate import CubicSpline, PchipInterpolator, RectBivariateSpline, RegularGridInterpolator
from sympy import Expr, S, Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import Model
from codegen.discretise.program import ControlProgram, EndElement, IntervalElement, SampleElement, StepProgram
from codegen.emit.verify.comparison import CONTINUED
from codegen.emit.verify.shares import shared_symbols
from codegen.evidence.checks.base import (
    DIGITS,
    NOTHING,
    TOLERANCE,
    Agreement,
    Context,
    Finding,
    Function,
    Point,
    curved_beyond,
    does_not_apply,
    function_of,
    gradient,
    random_points,
    second_differences,
    vanishing,
)
from codegen.evidence.checks.layout import (
    kernel_stems,
    near_end,
    near_interval,
    other_symbols,
    parameter_vector,
    pattern_of,
    step_lengths,
)
from codegen.runtime.stepping.steps import part_of_step
from codegen.solving.results.estimates import plain
from codegen.symbolic.table_functions import numbers_of, tables_of
from codegen.symbolic.tables import ORDERS, TableData
from codegen.symbolic.zeros import identically_zero

_SHORTER = (1.0, 0.1, 0.01, 1e-3)
"""Parts of a step's length that are tried in turn."""


def _closed(context: Context, program: StepProgram, points: Sequence[Point], equations: Function) -> Finding:
    """The equations after a step of the module."""
    names, found = [f"{name} after a step" for name, _ in program.equations], Agreement()
    for point in points:
        left_over = _after_a_step(context, program, point, equations) or [mpmath.inf] * len(names)
        # One is added on both sides, so that what must vanish is measured on the scale of the state.
        with mpmath.workdps(DIGITS):
            found.compare(names, [1 + r for r in left_over], [mpmath.mpf(1)] * len(names))
    return found.finding("one step", "the scheme's equations")


def _after_a_step(context: Context, program: StepProgram, point: Point, equations: Function) -> list[Any] | None:
    """What is left over of the equations, in parts of the largest value of the step, or of one if that is more.

    Nothing where the module makes no step, however short. A long step may have no solution, as where bodies happen to
    lie beside each other; a short one has.
    """
    module, made = context.module, np.empty(len(program.equations))
    for shorter in _SHORTER:
        shortened = {**point, **{h: shorter * point[h] for h in program.lengths}}
        arguments = _step_arguments(shortened, program)
        if part_of_step(module.problem.scheme, *arguments, 1e-14, 50, made) >= 0:
            base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
            scale = max(1.0, np.abs(arguments[0]).max(), np.abs(made).max())
            with mpmath.workdps(DIGITS):
                left_over = equations(*(mpmath.mpf(shortened[symbol]) for symbol in base), *map(mpmath.mpf, made))
                return [value / mpmath.mpf(scale) for value in left_over]
    return None


def _implicit(context: Context, program: StepProgram) -> Iterator[Finding]:
    base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
    symbols = [*program.unknowns, *base]
    functions = [function_of(symbols, [value], program.before) for value in program.residual]
    size = len(program.unknowns)
    values_seen, entries_seen = Agreement(), Agreement()
    for point in random_points(program.residual, symbols, program.model, assignments=program.before):
        numbers = [point[symbol] for symbol in symbols]
        unknowns, arguments = np.array(numbers[:size], dtype=float), _step_arguments(point, program)
        alone, beside, matrix = np.empty(size), np.empty(size), np.empty((size, size))
        context.module.step_residual(unknowns, *arguments, alone)
        context.module.step_jacobian(unknowns, *arguments, beside, matrix)
        with mpmath.workdps(DIGITS):
            for i, function in enumerate(functions):
                exact = function(*map(mpmath.mpf, numbers)) * 2
                values_seen.compare([f"residual {i}"] * 2, [alone[i], beside[i]], exact)
                names = [f"d residual {i}/d{y}" for y in program.unknowns]
                entries_seen.compare(names, matrix[i], gradient(function, numbers, range(size)))
    yield values_seen.finding("step_residual", "the reduced equations")
    yield entries_seen.finding("step_jacobian", "120-digit differences of the residual")


def _step_arguments(point: Point, program: StepProgram) -> tuple[Any, float, Any, Any]:
    state = np.array([point[symbol] for symbol in program.left_symbols], dtype=float)
    numbers = numbers_of(program.model)
    parameters = np.array([*(point[symbol] for symbol in program.model.parameters), *numbers], dtype=float)
    return state, point[program.model.time], step_lengths(point, program), parameters


def check_couplings(context: Context, program: ControlProgram) -> Iterator[Finding]:
    """Compare values, slopes and curvatures of all conditions with differences of what the author wrote."""
    if not program.couplings:
        return
    symbols = shared_symbols(program)
    conditions = _written_conditions(context.model, program)
    others = [s for s in (*program.model.parameters, *(v.symbol for v in program.boundary_values)) if s not in symbols]
    values, slopes, curvatures = Agreement(), Agreement(), Agreement()
    every = [*symbols, *others]
    functions = [function_of(every, [condition]) for condition in conditions]
    for point in random_points(conditions, every, program.model):
        numbers, row = [point[s] for s in every], dict.fromkeys(program.shared_symbols, 0.0) | point
        parts = _assembled(context.module, [point[s] for s in symbols], parameter_vector(row, program), len(conditions))
        for r, (coupling, function) in enumerate(zip(program.couplings, functions, strict=True)):
            name = f"condition of {coupling.multiplier.name}"
            read = [i for i, s in enumerate(symbols) if conditions[r].has(s) or parts[1][r][i] or parts[2][r][i].any()]
            pairs = [(i, j) for i in read for j in read]
            with mpmath.workdps(DIGITS):
                values.compare([name], [parts[0][r]], function(*map(mpmath.mpf, numbers)))
                first = gradient(function, numbers, read)
                slopes.compare([f"{name} by {symbols[i]}" for i in read], parts[1][r][read], first)
                # Where a condition is not curved at all, second differences are the rounding of its values.
                least = NOTHING * max(map(abs, first), default=0)
                second = [
                    value if abs(value) > least else mpmath.mpf(0)
                    for value in second_differences(function, numbers, pairs).values()
                ]
                called = [f"{name} by {symbols[i]} and {symbols[j]}" for i, j in pairs]
                curvatures.compare(called, [parts[2][r][pair] for pair in pairs], second)
    yield values.finding("coupling_term", "the author's conditions")
    yield slopes.finding("slopes of coupling_term", "120-digit differences of the author's conditions")
    yield curvatures.finding("curvatures of coupling_term", "120-digit second differences of the author's conditions")


def _written_conditions(model: Model, program: ControlProgram) -> list[Expr]:
    """The author's conditions whose multipliers the module has, as functions of the shared unknowns.

    A coordinate that is periodic and coupled is shared as it is at the start, without its shift.
    """
    shifts = dict(model.periodic)
    shifted = {v.symbol: v.symbol + shifts.get(model.coordinates[v.coordinate], 0) for v in model.end_values}
    written = {condition.name: condition.expression for condition in model.couplings}
    return [written[coupling.multiplier.meaning.of].xreplace(shifted) for coupling in program.couplings]


def _assembled(module: Any, shared: list[float], parameters: Any, count: int) -> tuple[Any, Any, Any]:
    """Values (conditions,), slopes (conditions, shared) and curvatures (conditions, shared, shared) from the terms."""
    values, size = np.array(shared), len(shared)
    total, slope, curvature = np.zeros(count), np.zeros((count, size)), np.zeros((count, size, size))
    for kind, row, read, indices in zip(
        module.COUPLING_KINDS, module.COUPLING_ROWS, module.COUPLING_COUNTS, module.COUPLING_INDICES, strict=True
    ):
        here = indices[:read]
        width = len(indices)
        first, second = np.zeros(width), np.zeros(width * width)
        inputs = np.zeros(width)
        inputs[:read] = values[here]
        total[row] += plain(getattr(module, f"coupling_{kind}"))(inputs, parameters, first, second)
        np.add.at(slope[row], here, first[:read])
        np.add.at(curvature[row], np.ix_(here, here), second[: read * read].reshape(read, read))
    return total, slope, curvature


_COMPLEX_STEP = 1e-30
_NOT_ANALYTIC = (sympy.Abs, sympy.sign, sympy.Min, sympy.Max, sympy.Piecewise, sympy.Heaviside, sympy.atan2)


def check_derivatives(context: Context) -> Iterator[Finding]:
    """Compare all kernels of the module with what was derived."""
    program = context.program
    if not isinstance(program, ControlProgram):
        # The scheme's equations and the energy as written.
        interval = [*program.stage_symbols, *program.right_symbols]
        base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
        equations = function_of([*base, *interval], [value for _, value in program.equations])
        energy = function_of(base, [program.energy], program.state_assignments)
        written, height = Agreement(), Agreement()
        names = [name for name, _ in program.equations]
        module, size = context.module, len(interval)
        points = random_points([v for _, v in program.equations], [*base, *interval], program.model)
        for point in points:
            arguments = _step_arguments(point, program)
            after = np.array([point[symbol] for symbol in interval], dtype=float)
            emitted = np.empty(size)
            module.step_equations(arguments[0], after, *arguments[1:], emitted)
            numbers = [mpmath.mpf(point[symbol]) for symbol in base]
            with mpmath.workdps(DIGITS):
                written.compare(names, emitted, equations(*numbers, *map(mpmath.mpf, after)))
                height.compare(["H"], [module.energy(arguments[0], arguments[1], arguments[3])], energy(*numbers))
        yield written.finding("step_equations", "the scheme's equations")
        yield height.finding("energy", "the Hamiltonian")
        yield _closed(context, program, points, equations)
        if program.unknowns:
            yield from _implicit(context, program)
        return
    for stem, share in zip(kernel_stems(program), program.interval_elements, strict=True):
        yield from _interval(context, program, stem, share)
    yield from _end(context, program, "start", program.start, program.left_symbols)
    yield from _end(context, program, "end", program.end, program.right_symbols)
    yield from check_couplings(context, program)


def _interval(context: Context, program: ControlProgram, stem: str, share: IntervalElement) -> Iterator[Finding]:
    unknowns = program.element_symbols
    symbols = [*unknowns, *other_symbols(program)]
    scalar, indices = function_of(symbols, [share.element]), range(len(unknowns))
    cost = function_of(symbols, [share.cost])
    first, second, steps = Agreement(), Agreement(), Agreement()
    analytic = not share.element.has(*_NOT_ANALYTIC)
    module, pattern = context.module, pattern_of(context.module, "interval")
    names = [f"dl/d{x}" for x in unknowns]
    local = unknowns[: len(unknowns) - len(program.shared)]
    likely = near_interval(context, program, stem)
    for point in random_points([share.element, share.cost], symbols, program.model, likely=likely):
        numbers = [point[symbol] for symbol in symbols]
        x, parameters = np.array([point[s] for s in local]), parameter_vector(point, program)
        t, h = point[program.model.time], point[STEP]
        emitted, entries = np.empty(len(unknowns)), np.empty(len(pattern))
        found = plain(getattr(module, f"{stem}_gradient"))(x, t, h, parameters, emitted)
        plain(getattr(module, f"{stem}_hessian"))(x, t, h, parameters, entries)
        with mpmath.workdps(DIGITS):
            first.compare(names, emitted, gradient(scalar, numbers, indices))
            first.compare(["Cd"], [found], cost(*map(mpmath.mpf, numbers)))
            exact = second_differences(scalar, numbers, pattern)
            wanted = [exact[pair] for pair in pattern]
            second.compare([f"d2l/d{unknowns[r]} d{unknowns[c]}" for r, c in pattern], entries, wanted)
        if analytic:
            steps.compare(names, emitted, _complex_steps(share.element, symbols, numbers, len(unknowns)))
    yield first.finding(f"{stem}_gradient", "120-digit differences of l")
    if analytic:
        yield steps.finding(f"{stem}_gradient", "complex steps of l")
    yield second.finding(f"{stem}_hessian", "120-digit second differences of l")


def _complex_steps(scalar: Expr, symbols: Sequence[Symbol], numbers: Sequence[float], count: int) -> list[Any]:
    function = sympy.lambdify(list(symbols), scalar, modules=[CONTINUED, "numpy"], cse=True)
    results = []
    for i in range(count):
        shifted = [complex(number) for number in numbers]
        shifted[i] += 1j * _COMPLEX_STEP
        results.append(mpmath.mpf(float(np.imag(function(*shifted))) / _COMPLEX_STEP))
    return results


def _end(
    context: Context, program: ControlProgram, name: str, end: EndElement, node: Sequence[Symbol]
) -> Iterator[Finding]:
    """The end's own share of the Lagrangian and its cost; entries of pinned unknowns are not emitted."""
    unknowns = [*node, *program.shared_symbols]
    symbols = [*unknowns, *other_symbols(program)]
    scalar, cost = function_of(symbols, [end.element]), function_of(symbols, [end.cost])
    pinned = {i for i, _ in end.pins}
    free = [i for i in range(len(unknowns)) if i not in pinned]
    module, first, second = context.module, Agreement(), Agreement()
    pattern = pattern_of(module, name)
    likely = near_end(context, program, name)
    for point in random_points([end.element], symbols, program.model, likely=likely):
        numbers = [point[symbol] for symbol in symbols]
        x, t, parameters = np.array(numbers[: len(node)]), point[program.model.time], parameter_vector(point, program)
        emitted, entries = np.zeros(len(unknowns)), np.zeros(len(pattern))
        found = plain(getattr(module, f"{name}_gradient"))(x, t, parameters, emitted)
        if pattern:
            plain(getattr(module, f"{name}_hessian"))(x, t, parameters, entries)
        with mpmath.workdps(DIGITS):
            exact = gradient(scalar, numbers, free)
            first.compare([f"by {unknowns[i]}" for i in free], emitted[free], exact)
            first.compare([f"cost at the {name}"], [found], cost(*map(mpmath.mpf, numbers)))
            lost = sorted(curved_beyond(scalar, numbers, free, pattern))
            pairs = [*pattern, *lost]
            wanted = second_differences(scalar, numbers, pairs)
            names = [f"by {unknowns[r]}, {unknowns[c]}" for r, c in pairs]
            second.compare(names, [*entries, *np.zeros(len(lost))], [wanted[pair] for pair in pairs])
    yield first.finding(f"{name}_gradient", "120-digit differences")
    if pattern or second.error > TOLERANCE:
        yield second.finding(f"{name}_hessian", "120-digit second differences")


Pair = tuple[int, int]
_MEASURED = 0.4
"""What stands for everything that belongs to a sample, where all else is as at the guess."""


def check_sparsity(context: Context) -> Iterator[Finding]:
    """Compare the patterns of the interval and of both ends with where second differences of l are not zero."""
    program = context.control
    elements = [share.element for share in program.interval_elements]
    likely = [point for stem in kernel_stems(program) for point in near_interval(context, program, stem)[:2]]
    if program.sample is not None:
        elements.append(program.sample.element)
        likely = [{**point, **dict.fromkeys(program.sample.symbols, _MEASURED)} for point in likely]
    yield from _compared(context, program, "interval", elements, program.element_symbols, set(), likely)
    for name, end, node in (
        ("start", program.start, program.left_symbols),
        ("end", program.end, program.right_symbols),
    ):
        pinned = {index for index, _ in end.pins}
        likely = near_end(context, program, name)[:2]
        yield from _compared(context, program, name, [end.element], (*node, *program.shared_symbols), pinned, likely)


def _compared(
    context: Context,
    program: ControlProgram,
    name: str,
    scalars: Sequence[Expr],
    unknowns: Sequence[Symbol],
    pinned: set[int],
    likely: Sequence[Point],
) -> Iterator[Finding]:
    """Shares of the Lagrangian that have one pattern; what is pinned counts as a number there."""
    symbols = [*unknowns, *other_symbols(program)]
    symbols += program.sample.symbols if program.sample is not None and name == "interval" else ()
    emitted = pattern_of(context.module, name)
    free = [index for index in range(len(unknowns)) if index not in pinned]
    missing, occupied = set[Pair](), set[Pair]()
    seed = 7
    points = random_points(scalars, symbols, program.model, len(likely) + 1, seed, likely)
    for function, point in product([function_of(symbols, [scalar]) for scalar in scalars], points):
        numbers = [point[symbol] for symbol in symbols]
        values = second_differences(function, numbers, emitted)
        least = NOTHING * max(map(abs, values.values()), default=0)
        occupied |= {pair for pair, value in values.items() if abs(value) > least}
        missing |= curved_beyond(function, numbers, free, emitted)
    if name != "interval" and not emitted and not missing:
        return

    # Where differences are lost in rounding, or flat at all points, only algebra can tell.
    missing = {pair for pair in missing if not _is_zero(scalars, unknowns, pair)}
    needless = {pair for pair in set(emitted) - occupied if _is_zero(scalars, unknowns, pair)}

    def named(entries: set[Pair]) -> str:
        r, c = min(entries)
        more = f" and {len(entries) - 1} more" if len(entries) > 1 else ""
        return f"d2l/d{unknowns[r]} d{unknowns[c]}{more}"

    repeated = len(emitted) - len(set(emitted))
    outside = f"the {len(free) * (len(free) + 1) // 2 - len(set(emitted))} entries outside the pattern vanish"
    kernel = f"{name}_hessian"
    yield Finding("sparsity", kernel, not missing, f"not emitted: {named(missing)}" if missing else outside)
    wrong = f"identically zero: {named(needless)}" if needless else f"{repeated} entries are emitted twice"
    inside = f"none of the {len(emitted)} emitted entries is identically zero"
    yield Finding("sparsity", kernel, not needless and not repeated, wrong if needless or repeated else inside)


def _is_zero(scalars: Sequence[Expr], unknowns: Sequence[Symbol], pair: Pair) -> bool:
    row, column = pair
    return all(identically_zero(scalar.diff(unknowns[column]).diff(unknowns[row])) for scalar in scalars)


_POINTS = 40
_LIMIT = 1e-9


def check_tables(context: Context) -> Iterator[Finding]:
    """Look every table up at random points of its range, and compare what the module says with what scipy says."""
    tables = tables_of(context.model)
    if not tables:
        yield does_not_apply("tables", "there are no tables")
        return
    parameters = np.atleast_2d(context.module.make_grid(context.model.steps).parameters)[0]
    for table in tables:
        shape = table.shape
        same = np.array_equal(np.array(context.module.TABLES[shape.name]), table.numbers)
        detail = f"{' and '.join(str(size) for size in shape.sizes)} breakpoints"
        yield Finding("tables", f"{shape.name}: numbers", same, detail if same else f"others than in {table.source}")
        worst = _difference(table, plain(getattr(context.module, shape.lookup)), parameters)
        detail = f"value and derivatives differ from scipy's spline by {worst:.1g} of their sizes"
        yield Finding("tables", f"{shape.name}: {shape.kind}", worst <= _LIMIT, detail)


def _difference(table: TableData, function: Any, parameters: Any) -> float:
    """The largest difference from scipy's spline, in parts of sizes, of a look-up up to its second derivatives."""
    generator = np.random.default_rng(7)
    at = [generator.uniform(axis[0], axis[-1], _POINTS) for axis in table.axes]
    found, references, worst = _looked_up(function, parameters, at), _references(table), 0.0
    for order, values in zip(ORDERS[len(at)], found.T, strict=True):
        if sum(order) <= 2:
            exact = references(order, at)
            worst = max(
                worst, float(np.abs(values - exact).max()) / max(float(np.abs(exact).max()), _size(table, order))
            )
    return worst


def _looked_up(function: Any, parameters: Any, at: Sequence[Any]) -> Any:
    return np.array([function(parameters, *map(float, point)) for point in zip(*at, strict=True)])


def _size(table: TableData, order: Sequence[int]) -> float:
    """How large a derivative of a table is, by its values and the widths of its cells."""
    size = float(np.abs(table.heights[..., 0]).max())
    for axis, o in zip(table.axes, order, strict=True):
        size /= float(np.diff(axis).min()) ** o
    return size


def _references(table: TableData) -> Callable[[Sequence[int], Sequence[Any]], Any]:
    """Derivatives of scipy's spline through the values of a table."""
    kind, axes, values = table.shape.kind, table.axes, table.heights[..., 0]
    if kind == "cubic" and len(axes) == 2:
        surface = RectBivariateSpline(*axes, values, kx=3, ky=3, s=0)
        return lambda order, at: surface.ev(*at, dx=order[0], dy=order[1])
    if kind in ("cubic", "monotone"):
        curve = (CubicSpline if kind == "cubic" else PchipInterpolator)(axes[0], values)
        return lambda order, at: curve(at[0], nu=order[0])
    return lambda order, at: _of_lines(axes, values, order, at)


def _of_lines(axes: Sequence[Any], values: Any, order: Sequence[int], at: Sequence[Any]) -> Any:
    """Derivatives of products of straight lines, by differences across a cell, which are exact; of steps none."""
    if max(order) > 1:
        return np.zeros_like(at[0])
    interpolant = RegularGridInterpolator(axes, values, method="linear")
    ends, lengths = [], np.ones_like(at[0])
    for axis, o, x in zip(axes, order, at, strict=True):
        cell = np.searchsorted(axis, x, side="right") - 1
        ends.append(((-1.0, axis[cell]), (1.0, axis[cell + 1])) if o else ((1.0, x),))
        lengths = lengths * (axis[cell + 1] - axis[cell]) ** o
    total = np.zeros_like(at[0])
    for corner in product(*ends):
        signs, indices = zip(*corner, strict=True)
        total += np.prod(signs) * interpolant(np.stack(indices, axis=1))
    return total / lengths


_CHECK = "measurements"
_GRID = (0.1, 0.55, 0.35)
_ROUNDING = 1e-12


def check_measurements(context: Context) -> Iterator[Finding]:
    """Compare numbers and kernels, where samples lie, and what the motion is at both ends of an interval."""
    model, program = context.model, context.control
    assert program.sample is not None
    for emitted, data in zip(context.module.OBSERVATIONS, model.measurements, strict=True):
        same = np.array_equal(emitted, data.array, equal_nan=True)
        detail = data.summary if same else f"others than in {data.source}"
        yield Finding(_CHECK, f"{data.source}: numbers", same, detail)
    yield _places(context.module, model)
    yield _meets_nodes(model, program, program.sample)
    yield from _kernels(context, program, program.sample)


def _places(module: Any, model: Model) -> Finding:
    """Whether on intervals of different lengths every sample is told the interval in which it lies, and where."""
    grid, structure = module.make_grid(len(_GRID), grid=_GRID), module.problem.structure
    nodes = np.append(0.0, np.cumsum(_GRID)) * grid.steps * grid.h
    worst, count = 0.0, 0
    for row, data in zip(grid.parameters, model.measurements, strict=True):
        samples = row[structure.first_sample :].reshape(-1, structure.sample)[: len(data.rows)]
        for (middle, fraction, *_), (time, *_) in zip(samples, data.rows, strict=True):
            k = int(np.searchsorted(nodes, middle)) - 1
            inside = 0 <= k < len(_GRID) and 0.0 <= fraction <= 1.0
            error = abs(nodes[k] + fraction * (nodes[k + 1] - nodes[k]) - time) if inside else np.inf
            worst, count = max(worst, error / nodes[-1]), count + 1
    detail = f"{count} samples lie where they were taken, on {len(_GRID)} intervals of different lengths"
    if not worst <= _ROUNDING:
        detail = f"a sample is taken {worst:.2g} of the duration away from its time"
    return Finding(_CHECK, "times of samples", bool(worst <= _ROUNDING), detail)


def _meets_nodes(model: Model, program: ControlProgram, sample: SampleElement) -> Finding:
    """Whether the motion inside an interval begins and ends at its nodes, where measurements are of states alone."""
    subject, states = "motion inside an interval", {*model.coordinates, *model.rates}
    for number, observed in enumerate(model.observed):
        if not observed.expression.free_symbols <= {*states, *model.parameters}:
            continue
        others = {weight: S.Zero for i, weight in enumerate(sample.weights) if i != number}
        own = {sample.weights[number]: S.One}
        for end, symbols in ((S.Zero, program.left_symbols), (S.One, program.right_symbols)):
            at = {s: node for s in states for u, node in zip(program.node, symbols, strict=True) if s.name == u.name}
            if not observed.expression.free_symbols & states <= set(at):
                continue
            met = {sample.values[number]: observed.expression.xreplace(at)}
            left = sample.element.xreplace(others | own | met).subs(sample.fraction, end)
            if not vanishing(left):
                which = "right" if end else "left"
                return Finding(_CHECK, subject, False, f"{observed.name} at the {which} node is not that of its state")
    return Finding(_CHECK, subject, True, "at its ends it is that of the nodes, proved symbolically")


def _kernels(context: Context, program: ControlProgram, sample: SampleElement) -> Iterator[Finding]:
    """The emitted gradient and Hessian of a sample's losses, at random points."""
    unknowns, pattern = program.element_symbols, pattern_of(context.module, "interval")
    symbols = [*unknowns, *other_symbols(program), *sample.symbols]
    losses, indices = function_of(symbols, [sample.element]), range(len(unknowns))
    first, second = Agreement(_CHECK), Agreement(_CHECK)
    pairs = [(i, j) for i in indices for j in range(i + 1)]
    for point in random_points([sample.element], symbols, program.model):
        numbers = [point[symbol] for symbol in symbols]
        emitted, matrix, value = _emitted(context.module, program, sample, point, pattern)
        with mpmath.workdps(DIGITS):
            first.compare(["the losses"], [value], losses(*map(mpmath.mpf, numbers)))
            first.compare([f"by {x}" for x in unknowns], emitted, gradient(losses, numbers, indices))
            exact = second_differences(losses, numbers, pairs)
            names = [f"by {unknowns[i]}, {unknowns[j]}" for i, j in pairs]
            second.compare(names, [matrix[pair] for pair in pairs], list(exact.values()))
    yield first.finding("sample_gradient", "120-digit differences of the losses")
    yield second.finding("sample_hessian", "120-digit second differences of the losses")


def _emitted(
    module: Any, program: ControlProgram, sample: SampleElement, point: dict[Symbol, float], pattern: Any
) -> tuple[Any, Any, float]:
    """The gradient (m,), the lower triangle of the Hessian (m, m) and the value that a module gives."""
    local = program.element_symbols[: len(program.element_symbols) - len(program.shared)]
    row = parameter_vector(point, program)
    time, step = other_symbols(program)[-2:]
    given = np.array([point[s] for s in local]), point[time], point[step]
    row = np.array([*row, point[time] + point[step] / 2, *(point[s] for s in sample.symbols)])
    size = len(program.element_symbols)
    slopes, entries, matrix = np.zeros(size), np.zeros(len(pattern)), np.zeros((size, size))
    first = module.problem.structure.first_sample
    value = plain(module.sample_gradient)(*given, row, first, slopes)
    plain(module.sample_hessian)(*given, row, first, entries)
    for (i, j), entry in zip(pattern, entries, strict=True):
        matrix[i, j] += entry
    return slopes, matrix, value
