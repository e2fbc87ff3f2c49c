"""Pictures of a solution with what its problem's drawing shows: a figure of everything about it, and a film."""

from __future__ import annotations

import ast
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen import plots
from codegen.author.sources import ProblemFile, Source
from codegen.errors import ArgumentError
from codegen.interfaces import GeneratedModule, is_control
from codegen.model import Model
from codegen.pictures.scene import fine_times, scene
from codegen.plots import shapes
from codegen.plots.quantities import first_guess_of_segments
from codegen.solutions.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from codegen.model.pairwise import PairwiseModel


def figure_of(
    module: GeneratedModule, model: Model | PairwiseModel | None, result: Result, unit: str = "", style: str = "page"
) -> Figure:
    """The figure of a result, with the drawing of its model, if there are any; `unit` is that of the time."""
    drawings: Any = None
    if isinstance(model, Model) and model.drawing:
        drawings = scene(model.authored, result, fine_times(result.t))
        if is_control(module):
            guess = first_guess_of_segments(module, result)
            drawings = plots.Drawings(drawings, scene(model.authored, guess, fine_times(guess.t)))
    return plots.figure(module, result, drawings, unit, style)


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
