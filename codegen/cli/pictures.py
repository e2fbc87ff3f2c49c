"""What `codegen solve` draws: a page about the solution, and a film of the problem's drawing."""

from __future__ import annotations

import ast
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
    from codegen.loading import GeneratedModule
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

    def save(self, module: GeneratedModule, result: Result) -> None:
        """Write the files, each as a whole or not at all."""
        if self.plot is not None:
            self._save_plot(self.plot, module, result)
        if self.animation is not None:
            self._save_animation(self.animation, result)

    def _save_plot(self, path: Path, module: GeneratedModule, result: Result) -> None:
        from codegen import plots
        from codegen.cli.scene import fine_times, scene
        from codegen.loading import is_control
        from codegen.model import Model
        from codegen.plots.segments import first_guess

        drawings: Any = None
        if isinstance(self.model, Model) and self.model.drawing:
            drawings = scene(self.model.authored, result, fine_times(result.t))
            if is_control(module):
                guess = first_guess(module, result)
                drawings = plots.Drawings(drawings, scene(self.model.authored, guess, fine_times(guess.t)))
        with replacing(path) as temporary:
            plots.save(module, result, temporary, drawings, self.unit)

    def _save_animation(self, path: Path, result: Result) -> None:
        from codegen.cli.scene import scene
        from codegen.model import Model
        from codegen.plots import animation as animate

        assert isinstance(self.model, Model), "particles have no drawing"
        title = result.title if result.solved else f"{result.title.rstrip('.')} (NOT SOLVED: {result.status})"
        with replacing(path) as temporary:
            film = scene(self.model.authored, result, animate.scene_times(result.t))
            animate.save(film, title, temporary, _with_progress)


def requested(request: Request, plot: Path | None, animation: Path | None) -> Pictures:
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
    from codegen.author.problem_file import split_points
    from codegen.model.from_file import load_problem

    problem = Path(str(request.problem))
    model = None if request.is_built else load_problem(problem, split_points(problem, request.arguments)[0])
    if animation is not None and not (model and model.drawing):
        finding = f"--animate {animation}: {problem} says nothing about how to draw it"
        raise ArgumentError(finding, "add drawing=[...] with items of codegen.drawing to the problem")
    return Pictures(plot, animation, model, _unit(problem))


def _unit(problem: Path) -> str:
    """What the docstring of a problem file says about units, as far as it can be told: all quantities have none."""
    docstring = ast.get_docstring(ast.parse(problem.read_bytes())) or ""
    return "nondimensional" if "quantities are nondimensional" in " ".join(docstring.split()) else ""


def _with_progress(frames: Iterable[Any], count: int) -> Iterable[Any]:
    """A progress bar on a terminal, nothing elsewhere."""
    if not sys.stderr.isatty():
        return frames
    from rich.console import Console
    from rich.progress import track

    return track(frames, "Drawing", total=count, console=Console(stderr=True), transient=True)
