"""What `codegen solve` draws: a page about the solution, and a film of the problem's drawing."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from codegen.errors import ArgumentError
from codegen.files import replacing
from codegen.solutions.output import require_writable

if TYPE_CHECKING:
    from codegen.interfaces import GeneratedModule
    from codegen.model import Model
    from codegen.model.pairwise import PairwiseModel
    from codegen.solutions.result import Result
    from codegen.solving.request import Request

PLOTS = (".png", ".pdf", ".svg")
ANIMATIONS = (".gif", ".mp4")


@dataclass(frozen=True)
class Pictures:
    """The files that are wanted, with what the problem file has to say about them."""

    plot: Path | None = None
    animation: Path | None = None
    model: Model | PairwiseModel | None = None
    unit: str = ""
    style: str = "page"

    def save(self, module: GeneratedModule, result: Result) -> None:
        """Write the files, each as a whole or not at all."""
        if self.plot is not None:
            from codegen.pictures import figure_of
            from codegen.plots.picture import Picture

            Picture(figure_of(module, self.model, result, self.unit, self.style), self.style).save(self.plot)
        if self.animation is not None:
            self._save_animation(self.animation, result)

    def _save_animation(self, path: Path, result: Result) -> None:
        from codegen.pictures import save_film

        with replacing(path) as temporary:
            save_film(self.model, result, temporary, _with_progress)


def requested(request: Request, plot: Path | None, animation: Path | None, style: str = "page") -> Pictures:
    """Check, before anything is solved, that the wanted pictures can be drawn.

    Raises ArgumentError for files that cannot be written, for a film of type .mp4 without ffmpeg and for a film of a
    problem without a drawing, as a generated module is; what the problem file raises.
    """
    if plot is not None:
        require_writable(plot, PLOTS, "--plot")
    if animation is not None:
        require_writable(animation, ANIMATIONS, "--animate")
        if animation.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
            finding = f"--animate {animation} needs the program ffmpeg, which is not installed"
            raise ArgumentError(finding, "install ffmpeg, or let the file end in .gif")
    if plot is None and animation is None:
        return Pictures()
    from codegen.model.from_file import load_problem
    from codegen.pictures import unit_of

    model: Model | PairwiseModel | None = None
    unit = ""
    if not request.is_built:
        model = load_problem(request.source, request.settings)
        unit = unit_of(request.source)
    if animation is not None and not (model and model.drawing):
        finding = f"--animate {animation}: {request.problem} says nothing about how to draw it"
        raise ArgumentError(finding, "add drawing=[...] with items of codegen.drawing to the problem")
    return Pictures(plot, animation, model, unit, style)


def _with_progress(frames: Iterable[Any], count: int) -> Iterable[Any]:
    """A progress bar on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        return frames
    from rich.console import Console
    from rich.progress import track

    return track(frames, "Drawing", total=count, console=Console(stderr=True), transient=True)
