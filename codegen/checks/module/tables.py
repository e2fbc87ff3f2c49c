"""Tables of a module against their files, and their derivatives against scipy's splines through the same values."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import product
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator, RectBivariateSpline, RegularGridInterpolator

from codegen.checks.base import Context, Finding, does_not_apply
from codegen.expressions.table_functions import tables_of
from codegen.solutions.fit import plain
from codegen.tables.data import TableData
from codegen.tables.evaluation import ORDERS

_POINTS = 40
_LIMIT = 1e-9


def check(context: Context) -> Iterator[Finding]:
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
    """All derivatives at some points, (points, derivatives), by the module's look-up."""
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
