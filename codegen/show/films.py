"""The drawing of a problem along a solution: scenes, figures and films.

A scene is a drawing with arrays of numbers in place of sympy expressions.
"""

from __future__ import annotations

import ast
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import sympy
from numpy.typing import NDArray

from codegen.discretise.model.definitions import Model
from codegen.drawing import Scene
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
    """Return the drawing of a model along a result at `times` (n,), by default at the nodes of the result.

    Coordinates are interpolated linearly between nodes. A control is constant on its interval, or follows the
    polynomial through its stages. Numbers that cannot be evaluated, such as the root of a negative number, are NaN.
    """
    times = result.t if times is None else times
    # Values of all symbols: scalars, and arrays that broadcast to (bodies, times).
    values: dict[sympy.Symbol, float | Array] = dict(model.default_values)
    values |= {symbol: result.parameters[symbol.name] for symbol in values if symbol.name in result.parameters}
    values |= {free.symbol: result.summary[free.symbol.name] for free in model.free_parameters}
    values |= {sympy.Symbol("body", real=True): np.arange(float(model.bodies))[:, None], model.time: times[None, :]}
    q = np.column_stack([np.interp(times, result.t, column) for column in result.q.T])
    values |= dict(zip(model.coordinates, _by_body(q, model.bodies), strict=True))
    if result.u is not None:
        controls = _by_body(result.controls_at(times), model.bodies)
        values |= dict(zip(model.controls, controls, strict=True))
    symbols, arguments = list(values), list(values.values())

    def evaluated(expression: sympy.Expr) -> Array:
        array = np.asarray(sympy.lambdify(symbols, expression, NUMPY)(*arguments), dtype=float)
        return array if array.ndim == 2 else array.reshape(1, 1)

    items = []
    for item in model.drawing:
        with np.errstate(all="ignore"):
            arrays = item.mapped(evaluated)
        shape = np.broadcast_shapes(*(array.shape for _, array in arrays.expressions()))
        items.append(arrays.mapped(lambda array, shape=shape: np.broadcast_to(array, shape)))  # type: ignore[misc]
    return Scene(times, tuple(items))


def fine_times(t: Array, least: int = 400) -> Array:
    """Return the node times with evenly spaced times between them: at least `least` intervals in total."""
    parts = max(1, -(-least // max(t.size - 1, 1)))
    return np.interp(np.arange((t.size - 1) * parts + 1) / parts, np.arange(t.size), t)


def _by_body(rows: Array, bodies: int) -> Array:
    return rows.T.reshape(bodies, rows.shape[1] // bodies, len(rows)).swapaxes(0, 1)


def figure_of(
    module: GeneratedModule,
    model: Model | PairwiseModel | None,
    result: Result,
    unit: str = "",
    style: str = "page",
    panels: Sequence[str] | None = None,
) -> Figure:
    """Return the figure of a result, with the drawing of its model if it has one; `unit` is the unit of time."""
    drawings: Scene | figures.Drawings | None = None
    if isinstance(model, Model) and model.drawing and panels is None:
        drawings = solution = scene(model.authored, result, fine_times(result.t))
        if is_control(module):
            guess = first_guess_of_segments(module, result)
            drawings = figures.Drawings(solution, scene(model.authored, guess, fine_times(guess.t)))
    return figures.figure(module, result, drawings, unit, style, panels)


def save_film(
    model: Model | PairwiseModel | None,
    result: Result,
    path: Path,
    progress: shapes.Progress = lambda frames, count: frames,
) -> None:
    """Write a film of the drawing of a model along a result to a file .gif or .mp4; `progress` may show a bar.

    Raises ArgumentError for a problem without a drawing, and the errors of `shapes.save`.
    """
    if not (isinstance(model, Model) and model.drawing):
        finding = f"{result.problem} says nothing about how to draw it"
        raise ArgumentError(finding, "add drawing=[...] with items of codegen.drawing to the problem")
    title = result.title if result.solved else f"{result.title.rstrip('.')} (NOT SOLVED: {result.status})"
    shapes.save(scene(model.authored, result, shapes.scene_times(result.t)), title, path, progress)


def unit_of(source: Source) -> str:
    """Return "nondimensional" if the docstring of a problem file contains this statement, else an empty text."""
    if not isinstance(source, ProblemFile):
        return ""
    docstring = ast.get_docstring(ast.parse(source.path.read_bytes())) or ""
    return "nondimensional" if "quantities are nondimensional" in " ".join(docstring.split()) else ""
