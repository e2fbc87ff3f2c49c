"""Tables of a module against their files, and their derivatives against scipy's splines through the same values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any

import mpmath
import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator, RectBivariateSpline, RegularGridInterpolator
from sympy import S, Symbol

from codegen.discretise.model.definitions import Model
from codegen.discretise.program import ControlProgram, SampleElement
from codegen.evidence.checks.base import Context, Finding, does_not_apply
from codegen.evidence.checks.evaluation import (
    DIGITS,
    Agreement,
    function_of,
    gradient,
    random_points,
    second_differences,
    vanishing,
)
from codegen.evidence.checks.flat_vector import other_symbols, parameter_vector, pattern_of
from codegen.solving.results.estimates import plain
from codegen.symbolic.functions import tables_of
from codegen.symbolic.tables import ORDERS, TableData

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
