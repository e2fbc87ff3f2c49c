"""Pictures of a solution with what its problem's drawing shows: a figure of everything about it, and a film.

A problem's drawing along a solution: expressions become arrays of numbers. This is the one place beside the build that
evaluates sympy expressions, so it is imported for pictures only.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from numpy.typing import NDArray

from codegen.discretise.model.definitions import Model
from codegen.drawing import Item, Scene
from codegen.errors import ArgumentError
from codegen.problem.sources import ProblemFile, Source
from codegen.show import figures
from codegen.show.figures import shapes
from codegen.show.figures.quantities import first_guess_of_segments
from codegen.solving.loading import GeneratedModule, is_control
from codegen.solving.results.result import Result
from codegen.symbolic.functions import NUMPY

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from codegen.discretise.model.pairwise import PairwiseModel


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
    return _by_body(np.column_stack([np.interp(times, t, column) for column in values.T]), bodies)


def _by_body(rows: Array, bodies: int) -> Array:
    return rows.T.reshape(bodies, rows.shape[1] // bodies, len(rows)).swapaxes(0, 1)


def _array(value: Any) -> Array:
    array = np.asarray(value, dtype=float)
    return array if array.ndim == 2 else array.reshape(1, 1)


def figure_of(
    module: GeneratedModule, model: Model | PairwiseModel | None, result: Result, unit: str = "", style: str = "page"
) -> Figure:
    """The figure of a result, with the drawing of its model, if there are any; `unit` is that of the time."""
    drawings: Any = None
    if isinstance(model, Model) and model.drawing:
        drawings = scene(model.authored, result, fine_times(result.t))
        if is_control(module):
            guess = first_guess_of_segments(module, result)
            drawings = figures.Drawings(drawings, scene(model.authored, guess, fine_times(guess.t)))
    return figures.figure(module, result, drawings, unit, style)


def save_film(
    model: Model | PairwiseModel | None,
    result: Result,
    path: Path,
    progress: Callable[[Iterable[Any], int], Iterable[Any]] = lambda frames, count: frames,
) -> None:
    """Film the drawing of a model along a result into a file, .gif or .mp4.

    Raises ArgumentError where there is no drawing, and as `animation.save` does.
    """
    if not (isinstance(model, Model) and model.drawing):
        finding = f"{result.problem} says nothing about how to draw it"
        raise ArgumentError(finding, "add drawing=[...] with items of codegen.drawing to the problem")
    title = result.title if result.solved else f"{result.title.rstrip('.')} (NOT SOLVED: {result.status})"
    shapes.save(scene(model.authored, result, shapes.scene_times(result.t)), title, path, progress)


def unit_of(source: Source) -> str:
    """What the docstring of a problem file says about units, as far as it can be told: all quantities have none."""
    if not isinstance(source, ProblemFile):
        return ""
    docstring = ast.get_docstring(ast.parse(source.path.read_bytes())) or ""
    return "nondimensional" if "quantities are nondimensional" in " ".join(docstring.split()) else ""
