"""A problem's drawing along a solution: expressions become arrays of numbers.

This is the one place beside the build that evaluates sympy expressions, so it is imported for pictures only.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray

from codegen.drawing import Item, Scene
from codegen.expressions.special_functions import NUMPY
from codegen.model import Model
from codegen.solutions.result import Result

Array = NDArray[np.float64]


def scene(model: Model, result: Result, times: Array | None = None) -> Scene:
    """The model's drawing at the given times, or at the nodes of the result.

    Coordinates are interpolated linearly between nodes, as the discrete motion has them; a control keeps its value for
    its interval, or follows a polynomial through its stages. Numbers that cannot be evaluated, such as the root of a
    negative one, become NaN.
    """
    times = result.t if times is None else times
    values = _values(model, result, times)
    symbols = list(values)
    arguments = list(values.values())

    def evaluate(item: Item) -> Item:
        with np.errstate(all="ignore"):
            arrays = item.mapped(lambda expression: _array(sympy.lambdify(symbols, expression, NUMPY)(*arguments)))
        shape = np.broadcast_shapes(*(array.shape for _, array in arrays.expressions()))
        return arrays.mapped(lambda array: np.broadcast_to(array, shape))

    return Scene(times, tuple(evaluate(item) for item in model.drawing))


def fine_times(t: Array, least: int = 400) -> Array:
    """The times of the nodes and as many between them that a curve in the plane looks smooth."""
    parts = max(1, -(-least // max(t.size - 1, 1)))
    return np.interp(np.arange((t.size - 1) * parts + 1) / parts, np.arange(t.size), t)


def _values(model: Model, result: Result, times: Array) -> dict[sympy.Symbol, Any]:
    """Numbers of every symbol: scalars, and arrays that broadcast to (bodies, times)."""
    bodies = np.arange(float(model.bodies))
    values: dict[sympy.Symbol, Any] = dict(model.default_values)
    values |= {symbol: result.parameters[symbol.name] for symbol in values if symbol.name in result.parameters}
    values |= {free.symbol: result.summary[free.symbol.name] for free in model.free_parameters}
    values |= {sympy.Symbol("body", real=True): bodies[:, None], model.time: times[None, :]}
    values |= dict(zip(model.coordinates, _columns(result.q, model.bodies, result.t, times), strict=True))
    if result.u is not None:
        controls = _by_body(result.controls_at(times), model.bodies)
        values |= dict(zip(model.controls, controls, strict=True))
    return values


def _columns(values: Array, bodies: int, t: Array, times: Array) -> Array:
    """The quantities (n, bodies, times) of columns that stand body by body, linear between nodes."""
    return _by_body(np.column_stack([np.interp(times, t, column) for column in values.T]), bodies)


def _by_body(rows: Array, bodies: int) -> Array:
    """The quantities (n, bodies, times) of rows over time, whose columns stand body by body."""
    return rows.T.reshape(bodies, rows.shape[1] // bodies, len(rows)).swapaxes(0, 1)


def _array(value: Any) -> Array:
    array = np.asarray(value, dtype=float)
    return array if array.ndim == 2 else array.reshape(1, 1)
