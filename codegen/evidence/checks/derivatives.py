"""Checks of every emitted kernel and its sparsity pattern against the derived expression, at random points.

The references are differences in 120-digit arithmetic of the undifferentiated expression. The gradient of an interval
is also compared with complex steps (Squire and Trapp, 1998), by the code that verifies a module before it is written.
That verification reads the text of a module. These checks run the kernels of the module on disk, as solvers run them.

Conditions between bodies: the module holds a few kinds of term and tables of their occurrences. The sums of these terms
must equal every condition of the author, with its first and second derivatives.

Tables are compared with their files, and interpolated values with scipy's splines through the same values.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import product

import mpmath
import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator, RectBivariateSpline, RegularGridInterpolator
from sympy import Expr, S, Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.model.definitions import Model
from codegen.discretise.program import ControlProgram, EndElement, SampleElement, StepProgram
from codegen.emit.lower.simulate import rows_of_events
from codegen.emit.verify.comparison import complex_numbers, step_of
from codegen.emit.verify.execution import Tape
from codegen.emit.verify.shares import shared_symbols
from codegen.evidence.checks.base import (
    DIGITS,
    NOTHING,
    TOLERANCE,
    Agreement,
    Context,
    Finding,
    Point,
    curved_beyond,
    does_not_apply,
    function_of,
    gradient,
    random_points,
    second_differences,
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
from codegen.solving.loading import Vector
from codegen.solving.results.estimates import plain
from codegen.symbolic.functions import numbers_of, tables_of
from codegen.symbolic.tables import ORDERS, TableData
from codegen.symbolic.zeros import identically_zero


def check_derivatives(context: Context) -> Iterator[Finding]:
    """Compare all kernels of the module, their values and derivatives, with the derived expressions."""
    program = context.program
    if not isinstance(program, ControlProgram):
        yield from _step(context, program)
        return
    for stem, share in zip(kernel_stems(program), program.interval_elements, strict=True):
        # Compare the gradient, the cost and the Hessian of an interval with the interval's terms of the Lagrangian.
        unknowns = program.element_symbols
        symbols = [*unknowns, *other_symbols(program)]
        scalar, cost = function_of(symbols, [share.element]), function_of(symbols, [share.cost])
        tape, kind = Tape([share.element]), np.clongdouble
        first, second, steps, without_stages = Agreement(), Agreement(), Agreement(), Agreement()
        module, pattern = context.module, pattern_of(context.module, "interval")
        shooting = getattr(module, f"{stem}_shooting", None)
        names = [f"dl/d{x}" for x in unknowns]
        local, size = unknowns[: len(unknowns) - len(program.linking.unknowns)], len(unknowns)
        likely = near_interval(context, program, stem)
        for point in random_points([share.element, share.cost], symbols, program.model, likely=likely):
            numbers = [point[symbol] for symbol in symbols]
            x, parameters = np.array([point[s] for s in local]), parameter_vector(point, program)
            t, h = point[program.model.time], point[STEP]
            slopes, entries = np.empty(size), np.empty(len(pattern))
            emitted_cost = plain(getattr(module, f"{stem}_gradient"))(x, t, h, parameters, slopes)
            plain(getattr(module, f"{stem}_hessian"))(x, t, h, parameters, entries)
            with mpmath.workdps(DIGITS):
                first.compare(names, slopes, gradient(scalar, numbers, range(size)))
                first.compare(["Cd"], [emitted_cost], cost(*map(mpmath.mpf, numbers)))
                exact = second_differences(scalar, numbers, pattern)
                pairs = [f"d2l/d{unknowns[r]} d{unknowns[c]}" for r, c in pattern]
                second.compare(pairs, entries, [exact[pair] for pair in pattern])
                if shooting is not None:
                    # At the stages and multipliers that the kernel computes, derivatives by stages vanish.
                    filled, slopes_without = x.copy(), np.zeros(size)
                    cost_without = plain(shooting)(filled, t, h, parameters, slopes_without)
                    at = [*map(float, filled), *numbers[len(local) :]]
                    if np.isfinite(filled).all():
                        exact_slopes = [*gradient(scalar, at, range(size)), *cost(*map(mpmath.mpf, at))]
                        without_stages.compare([*names, "Cd"], [*slopes_without, cost_without], exact_slopes)
            shifted = {symbol: np.full(size, number, kind) for symbol, number in point.items()}
            for i, symbol in enumerate(unknowns):
                shifted[symbol][i] += 1j * step_of(kind)
            with np.errstate(all="ignore"):
                (values,) = tape.evaluate(shifted, complex_numbers(kind))
            along = np.broadcast_to(np.asarray(values, kind), size).imag / step_of(kind)
            steps.compare(names, slopes, [mpmath.mpf(float(slope)) for slope in along])
        yield first.finding(f"{stem}_gradient", "120-digit differences of l")
        yield steps.finding(f"{stem}_gradient", "complex steps of l")
        yield second.finding(f"{stem}_hessian", "120-digit second differences of l")
        if shooting is not None:
            yield without_stages.finding(f"{stem}_shooting", "120-digit differences of l at the stages")
    yield from _end(context, program, "start", program.start, program.left_symbols)
    yield from _end(context, program, "end", program.end, program.right_symbols)
    yield from check_couplings(context, program)


_SHORTER = tuple(10.0**-k for k in range(7))  # fractions of a step length, tried until a step has a solution


def _step(context: Context, program: StepProgram) -> Iterator[Finding]:
    """Compare the kernels of a simulation step (equations, energy, Jacobian), and check that steps are solved."""
    interval = [*program.stage_symbols, *program.right_symbols]
    base = [*program.left_symbols, program.model.time, *program.lengths, *program.model.parameters]
    equations = function_of([*base, *interval], [value for _, value in program.equations])
    residuals, closed = Agreement(), Agreement()
    # Kernels of a state: name, reference in words, labels and expressions of their values, and assignments.
    of_state = program.state_assignments
    rows = [(f"value {i}", value) for i, value in enumerate(value for c in program.constraints for value in c.row)]
    kernels = list[tuple[str, str, Sequence[tuple[str, Expr]], Sequence[tuple[Symbol, Expr]]]]()
    kernels += [("energy", "the Hamiltonian", [("H", program.energy)], of_state)] if program.energy is not None else []
    kernels += [("node_constraints", "the constraints, their rates and gradients", rows, of_state)] if rows else []
    of_events = (*of_state, *program.event_assignments)
    kernels += [(name, "events and gaps", values, of_events) for name, values in rows_of_events(program).items()]
    references = [function_of(base, [value for _, value in values], assigned) for _, _, values, assigned in kernels]
    agreements = [Agreement() for _ in kernels]
    names = [name for name, _ in program.equations]
    module, emitted, after = context.module, np.empty(len(interval)), np.empty(len(program.equations))
    for point in random_points([v for _, v in program.equations], [*base, *interval], program.model):
        arguments = _step_arguments(point, program)
        drawn = np.array([point[symbol] for symbol in interval], dtype=float)
        module.step_equations(arguments[0], drawn, *arguments[1:], emitted)
        numbers = [mpmath.mpf(point[symbol]) for symbol in base]
        with mpmath.workdps(DIGITS):
            residuals.compare(names, emitted, equations(*numbers, *map(mpmath.mpf, drawn)))
            for (kernel, _, values, _), reference, agreement in zip(kernels, references, agreements, strict=True):
                found = np.zeros(len(values))
                state, t, _, parameters = arguments
                if kernel == "energy":
                    found[0] = module.energy(state, t, parameters)
                else:
                    getattr(module, kernel)(state, t, parameters, found)
                agreement.compare([label for label, _ in values], found, reference(*numbers))

        # A long step may have no solution, for example where bodies happen to be close; a short step has one.
        errors = [mpmath.inf] * len(names)
        at_left = dict(zip(program.model.coordinates, program.left_symbols, strict=False))
        consistent = {**point}
        for quaternion in program.model.rotations:  # of length one
            length = math.hypot(*(point[at_left[q]] for q in quaternion))
            consistent |= {at_left[q]: point[at_left[q]] / length for q in quaternion}
        if program.model.holonomic:  # random positions violate the constraints; those at the start do not
            grid = module.make_grid()
            consistent |= {program.model.time: 0.0} | dict(zip(at_left.values(), map(float, grid.start), strict=False))
            consistent |= dict(zip(program.model.parameters, map(float, grid.parameters), strict=False))
        for shorter in _SHORTER:
            shortened = {**consistent, **{h: shorter * point[h] for h in program.lengths}}
            arguments = _step_arguments(shortened, program)
            if part_of_step(module.problem.scheme, *arguments, 1e-14, 50, after) < 0:
                continue
            scale = mpmath.mpf(max(1.0, np.abs(arguments[0]).max(), np.abs(after).max()))
            with mpmath.workdps(DIGITS):
                values = equations(*(mpmath.mpf(shortened[symbol]) for symbol in base), *map(mpmath.mpf, after))
                errors = [value / scale for value in values]
            break
        # One is added on both sides, so that residuals are relative to the scale of the state.
        with mpmath.workdps(DIGITS):
            closed.compare(
                [f"{name} after a step" for name in names], [1 + r for r in errors], [mpmath.mpf(1)] * len(names)
            )
    yield residuals.finding("step_equations", "the scheme's equations")
    for (kernel, against, _, _), agreement in zip(kernels, agreements, strict=True):
        yield agreement.finding(kernel, against)
    yield closed.finding("one step", "the scheme's equations")
    if not program.unknowns:
        return
    symbols = [*program.unknowns, *base]
    functions = [function_of(symbols, [value], program.before) for value in program.residual]
    size = len(program.unknowns)
    residuals, entries = Agreement(), Agreement()
    for point in random_points(program.residual, symbols, program.model, assignments=program.before):
        numbers = [point[symbol] for symbol in symbols]
        unknowns, arguments = np.array(numbers[:size], dtype=float), _step_arguments(point, program)
        alone, beside, matrix = np.empty(size), np.empty(size), np.zeros((size, size))
        context.module.step_residual(unknowns, *arguments, alone)
        context.module.step_jacobian(unknowns, *arguments, beside, matrix)
        with mpmath.workdps(DIGITS):
            for i, function in enumerate(functions):
                exact = function(*map(mpmath.mpf, numbers)) * 2
                residuals.compare([f"residual {i}"] * 2, [alone[i], beside[i]], exact)
                names = [f"d residual {i}/d{y}" for y in program.unknowns]
                entries.compare(names, matrix[i], gradient(function, numbers, range(size)))
    yield residuals.finding("step_residual", "the reduced equations")
    yield entries.finding("step_jacobian", "120-digit differences of the residual")


def _step_arguments(point: Point, program: StepProgram) -> tuple[Vector, float, Vector, Vector]:
    state = np.array([point[symbol] for symbol in program.left_symbols], dtype=float)
    numbers = numbers_of(program.model)
    parameters = np.array([*(point[symbol] for symbol in program.model.parameters), *numbers], dtype=float)
    return state, point[program.model.time], step_lengths(point, program), parameters


def _end(
    context: Context, program: ControlProgram, name: str, end: EndElement, node: Sequence[Symbol]
) -> Iterator[Finding]:
    """Compare the kernels of the start or end (`name`), which omit derivatives with respect to prescribed unknowns."""
    unknowns = [*node, *program.linking.symbols]
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
        slopes, entries = np.zeros(len(unknowns)), np.zeros(len(pattern))
        emitted_cost = plain(getattr(module, f"{name}_gradient"))(x, t, parameters, slopes)
        if pattern:
            plain(getattr(module, f"{name}_hessian"))(x, t, parameters, entries)
        with mpmath.workdps(DIGITS):
            first.compare([f"by {unknowns[i]}" for i in free], slopes[free], gradient(scalar, numbers, free))
            first.compare([f"cost at the {name}"], [emitted_cost], cost(*map(mpmath.mpf, numbers)))
            missing = sorted(curved_beyond(scalar, numbers, free, pattern))
            pairs = [*pattern, *missing]
            exact = second_differences(scalar, numbers, pairs)
            names = [f"by {unknowns[r]}, {unknowns[c]}" for r, c in pairs]
            second.compare(names, [*entries, *np.zeros(len(missing))], [exact[pair] for pair in pairs])
    yield first.finding(f"{name}_gradient", "120-digit differences")
    if pattern or second.error > TOLERANCE:
        yield second.finding(f"{name}_hessian", "120-digit second differences")


def check_couplings(context: Context, program: ControlProgram) -> Iterator[Finding]:
    """Compare values, slopes and curvatures of all conditions between bodies with the author's expressions."""
    if not program.linking.couplings:
        return
    model, module, symbols = context.model, context.module, shared_symbols(program)
    # The linking unknown of a coordinate that is periodic and coupled is its value at the start, without its shift.
    shifts = dict(model.periodic)
    shifted = {v.symbol: v.symbol + shifts.get(model.coordinates[v.coordinate], 0) for v in model.end_values}
    written = {condition.name: condition.expression for condition in model.couplings}
    conditions = [written[coupling.multiplier.meaning.of].xreplace(shifted) for coupling in program.linking.couplings]
    others = [s for s in (*program.model.parameters, *(v.symbol for v in program.boundary_values)) if s not in symbols]
    every = [*symbols, *others]
    functions = [function_of(every, [condition]) for condition in conditions]
    tables = module.COUPLING_KINDS, module.COUPLING_ROWS, module.COUPLING_COUNTS, module.COUPLING_INDICES
    values, slopes, curvatures = Agreement(), Agreement(), Agreement()
    for point in random_points(conditions, every, program.model):
        parameters = parameter_vector(dict.fromkeys(program.linking.symbols, 0.0) | point, program)
        # Assemble values, slopes (conditions, shared) and curvatures (conditions, shared, shared) from the terms.
        total, slope = np.zeros(len(conditions)), np.zeros((len(conditions), len(symbols)))
        curvature = np.zeros((len(conditions), len(symbols), len(symbols)))
        for kind, row, count, indices in zip(*tables, strict=True):
            read, width = indices[:count], len(indices)
            inputs, first, second = np.zeros(width), np.zeros(width), np.zeros(width * width)
            inputs[:count] = [point[symbols[i]] for i in read]
            total[row] += plain(getattr(module, f"coupling_{kind}"))(inputs, parameters, first, second)
            np.add.at(slope[row], read, first[:count])
            np.add.at(curvature[row], np.ix_(read, read), second[: count * count].reshape(count, count))
        numbers = [point[s] for s in every]
        for r, (coupling, function) in enumerate(zip(program.linking.couplings, functions, strict=True)):
            name = f"condition of {coupling.multiplier.name}"
            read = [i for i, s in enumerate(symbols) if conditions[r].has(s) or slope[r][i] or curvature[r][i].any()]
            pairs = [(i, j) for i in read for j in read]
            with mpmath.workdps(DIGITS):
                values.compare([name], [total[r]], function(*map(mpmath.mpf, numbers)))
                exact = gradient(function, numbers, read)
                slopes.compare([f"{name} by {symbols[i]}" for i in read], slope[r][read], exact)
                # Where a condition is not curved at all, second differences are rounding errors.
                least = NOTHING * max(map(abs, exact), default=0)
                differences = second_differences(function, numbers, pairs).values()
                curved = [value if abs(value) > least else mpmath.mpf(0) for value in differences]
                names = [f"{name} by {symbols[i]} and {symbols[j]}" for i, j in pairs]
                curvatures.compare(names, [curvature[r][pair] for pair in pairs], curved)
    yield values.finding("coupling_term", "the author's conditions")
    yield slopes.finding("slopes of coupling_term", "120-digit differences of the author's conditions")
    yield curvatures.finding("curvatures of coupling_term", "120-digit second differences of the author's conditions")


Pair = tuple[int, int]
_MEASURED = 0.4  # the value of all symbols of a measurement at points near the initial guess


def check_sparsity(context: Context) -> Iterator[Finding]:
    """Check that the Hessian patterns of the interval and both ends contain exactly the entries that are not zero."""
    program = context.control
    elements = [share.element for share in program.interval_elements]
    likely = [point for stem in kernel_stems(program) for point in near_interval(context, program, stem)[:2]]
    if program.sample is not None:
        elements.append(program.sample.element)
        likely = [{**point, **dict.fromkeys(program.sample.symbols, _MEASURED)} for point in likely]
    yield from _compared_pattern(context, program, "interval", elements, program.element_symbols, set(), likely)
    for name, end, node in (
        ("start", program.start, program.left_symbols),
        ("end", program.end, program.right_symbols),
    ):
        pinned, unknowns = {index for index, _ in end.pins}, (*node, *program.linking.symbols)
        likely = near_end(context, program, name)[:2]
        yield from _compared_pattern(context, program, name, [end.element], unknowns, pinned, likely)


def _compared_pattern(
    context: Context,
    program: ControlProgram,
    name: str,
    scalars: Sequence[Expr],
    unknowns: Sequence[Symbol],
    pinned: set[int],
    likely: Sequence[Point],
) -> Iterator[Finding]:
    """Compare the Hessian pattern `name` with the Lagrangian's terms `scalars`; `pinned` are prescribed unknowns."""
    symbols = [*unknowns, *other_symbols(program)]
    symbols += program.sample.symbols if program.sample is not None and name == "interval" else ()
    emitted = pattern_of(context.module, name)
    free = [index for index in range(len(unknowns)) if index not in pinned]
    missing, occupied = set[Pair](), set[Pair]()
    points = random_points(scalars, symbols, program.model, len(likely) + 1, 7, likely)
    for function, point in product([function_of(symbols, [scalar]) for scalar in scalars], points):
        numbers = [point[symbol] for symbol in symbols]
        values = second_differences(function, numbers, emitted)
        least = NOTHING * max(map(abs, values.values()), default=0)
        occupied |= {pair for pair, value in values.items() if abs(value) > least}
        missing |= curved_beyond(function, numbers, free, emitted)
    if name != "interval" and not emitted and not missing:
        return

    def vanishes(row: int, column: int) -> bool:
        return all(identically_zero(scalar.diff(unknowns[column]).diff(unknowns[row])) for scalar in scalars)

    # Algebra decides where differences are below rounding errors, or zero at all points.
    missing = {pair for pair in missing if not vanishes(*pair)}
    needless = {pair for pair in set(emitted) - occupied if vanishes(*pair)}

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


_POINTS = 40
_LIMIT = 1e-9


def check_tables(context: Context) -> Iterator[Finding]:
    """Compare every table with its file, and interpolation with scipy's spline at random points of its range."""
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
        generator = np.random.default_rng(7)
        at = [generator.uniform(axis[0], axis[-1], _POINTS) for axis in table.axes]
        look_up, references, worst = plain(getattr(context.module, shape.lookup)), _references(table), 0.0
        emitted = np.array([look_up(parameters, *map(float, point)) for point in zip(*at, strict=True)])
        for order, values in zip(ORDERS[len(at)], emitted.T, strict=True):
            if sum(order) > 2:
                continue
            size = float(np.abs(table.heights[..., 0]).max())
            for axis, o in zip(table.axes, order, strict=True):
                size /= float(np.diff(axis).min()) ** o
            exact = references(order, at)
            worst = max(worst, float(np.abs(values - exact).max()) / max(float(np.abs(exact).max()), size))
        detail = f"value and derivatives differ from scipy's spline by {worst:.1g} of their sizes"
        yield Finding("tables", f"{shape.name}: {shape.kind}", worst <= _LIMIT, detail)


def _references(table: TableData) -> Callable[[Sequence[int], Sequence[Vector]], Vector]:
    """Return a function that evaluates derivatives of scipy's spline, from the order and the values of each input."""
    kind, axes, values = table.shape.kind, table.axes, table.heights[..., 0]
    if kind == "cubic" and len(axes) == 2:
        surface = RectBivariateSpline(*axes, values, kx=3, ky=3, s=0)
        return lambda order, at: surface.ev(*at, dx=order[0], dy=order[1])
    if kind in ("cubic", "monotone"):
        curve = (CubicSpline if kind == "cubic" else PchipInterpolator)(axes[0], values)
        return lambda order, at: curve(at[0], nu=order[0])
    interpolant = RegularGridInterpolator(axes, values, method="slinear")  # multilinear, with derivatives in a cell
    return lambda order, at: interpolant(np.stack(at, axis=1), nu=order)


_GRID = (0.1, 0.55, 0.35)
_ROUNDING = 1e-12


def check_measurements(context: Context) -> Iterator[Finding]:
    """Check the values, times and kernels of measurements, and the motion at both ends of an interval."""
    model, program = context.model, context.control
    assert program.sample is not None
    for emitted, data in zip(context.module.OBSERVATIONS, model.measurements, strict=True):
        same, wrong = np.array_equal(emitted, data.array, equal_nan=True), f"others than in {data.source}"
        yield Finding.decided("measurements", f"{data.source}: numbers", same, data.summary, wrong)
    # Compare the interval and the position of every measurement, on intervals of different lengths.
    grid, structure = context.module.make_grid(len(_GRID), grid=_GRID), context.module.problem.structure
    nodes = np.append(0.0, np.cumsum(_GRID)) * grid.steps * grid.h
    worst, count = 0.0, 0
    for row, data in zip(grid.parameters, model.measurements, strict=True):
        samples = row[structure.first_sample :].reshape(-1, structure.sample)[: len(data.rows)]
        for (middle, fraction, *_), (time, *_) in zip(samples, data.rows, strict=True):
            k = int(np.searchsorted(nodes, middle)) - 1
            inside = 0 <= k < len(_GRID) and 0.0 <= fraction <= 1.0
            error = abs(nodes[k] + fraction * (nodes[k + 1] - nodes[k]) - time) if inside else np.inf
            worst, count = max(worst, error / nodes[-1]), count + 1
    right = f"{count} samples lie where they were taken, on {len(_GRID)} intervals of different lengths"
    wrong = f"a sample is taken {worst:.2g} of the duration away from its time"
    yield Finding.decided("measurements", "times of samples", worst <= _ROUNDING, right, wrong)
    yield _motion_at_nodes(model, program, program.sample)
    # Compare the emitted losses of a measurement, their gradient and their Hessian, at random points.
    unknowns, pattern = program.element_symbols, pattern_of(context.module, "interval")
    symbols, size = [*unknowns, *other_symbols(program), *program.sample.symbols], len(unknowns)
    losses, module = function_of(symbols, [program.sample.element]), context.module
    first, second = Agreement("measurements"), Agreement("measurements")
    pairs = [(i, j) for i in range(size) for j in range(i + 1)]
    for point in random_points([program.sample.element], symbols, program.model):
        x = np.array([point[s] for s in unknowns[: size - len(program.linking.unknowns)]])
        t, h = point[program.model.time], point[STEP]
        row = np.array([*parameter_vector(point, program), t + h / 2, *(point[s] for s in program.sample.symbols)])
        arguments = x, t, h, row, module.problem.structure.first_sample
        slopes, entries, matrix = np.zeros(size), np.zeros(len(pattern)), np.zeros((size, size))
        value = plain(module.sample_gradient)(*arguments, slopes)
        plain(module.sample_hessian)(*arguments, entries)
        for pair, entry in zip(pattern, entries, strict=True):
            matrix[pair] += entry
        numbers = [point[symbol] for symbol in symbols]
        with mpmath.workdps(DIGITS):
            first.compare(["the losses"], [value], losses(*map(mpmath.mpf, numbers)))
            first.compare([f"by {symbol}" for symbol in unknowns], slopes, gradient(losses, numbers, range(size)))
            exact = second_differences(losses, numbers, pairs)
            names = [f"by {unknowns[i]}, {unknowns[j]}" for i, j in pairs]
            second.compare(names, [matrix[pair] for pair in pairs], list(exact.values()))
    yield first.finding("sample_gradient", "120-digit differences of the losses")
    yield second.finding("sample_hessian", "120-digit second differences of the losses")


def _motion_at_nodes(model: Model, program: ControlProgram, sample: SampleElement) -> Finding:
    """Check that the motion inside an interval begins and ends in the states of its nodes, if states are measured."""
    subject, states = "motion inside an interval", {*model.coordinates, *model.rates}
    for number, observed in enumerate(model.observed):
        if not observed.expression.free_symbols <= {*states, *model.parameters}:
            continue
        weights = {weight: S.One if i == number else S.Zero for i, weight in enumerate(sample.weights)}
        for end, symbols in ((S.Zero, program.left_symbols), (S.One, program.right_symbols)):
            at = {s: node for s in states for u, node in zip(program.node, symbols, strict=True) if s.name == u.name}
            if not observed.expression.free_symbols & states <= set(at):
                continue
            measured = {sample.values[number]: observed.expression.xreplace(at)}
            if not identically_zero(sample.element.xreplace(weights | measured).subs(sample.fraction, end)):
                which = "right" if end else "left"
                detail = f"{observed.name} at the {which} node is not that of its state"
                return Finding("measurements", subject, False, detail)
    return Finding("measurements", subject, True, "at its ends it is that of the nodes, proved symbolically")
