"""The command `codegen solve`: build the module if necessary, solve, print the outcome, and draw pictures."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from codegen.cli import options
from codegen.errors import ArgumentError, one_line
from codegen.files import replacing
from codegen.terminal import console, following, working

if TYPE_CHECKING:
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel
    from codegen.show.figures.shapes import Frame
    from codegen.solving.loading import GeneratedModule
    from codegen.solving.request import Request
    from codegen.solving.results.result import Result

EXAMPLES = {
    "solve": (
        "codegen solve problems/cart_pole.py --steps 100 --plot cart_pole.png",
        "codegen solve problems/pendulum.py --scheme stormer-verlet --parameter duration=20 --json",
    )
}
PLOTS = (".png", ".pdf", ".svg")
ANIMATIONS = (".gif", ".mp4")


def solve(
    problem: options.Problem,
    set_: options.Set = [],  # noqa: B006
    scheme: options.Scheme = None,
    method: options.Method = None,
    controls: options.ControlSites = options.Controls.INTERVAL,
    driver: Annotated[
        str, typer.Option(help="newton (generated), slsqp, trust-constr, ipopt, fsolve, fmin.")
    ] = "newton",
    steps: options.Steps = None,
    every: options.Every = 1,
    repeat: options.Repeat = 1,
    json: options.Json = False,
    log: options.Log = False,
    tolerance: Annotated[
        float | None,
        typer.Option(metavar="E", help="Largest error of an equation (newton, ipopt), or of an adaptive step."),
    ] = None,
    max_iterations: Annotated[
        int | None, typer.Option(parser=options.positive, metavar="N", help="Most iterations of an optimiser.")
    ] = None,
    time_limit: Annotated[
        float | None, typer.Option(metavar="S", help="Most seconds of a search (newton, ipopt).")
    ] = None,
    scaling: Annotated[str, typer.Option(help="auto, or none to work in the problem's own units (newton).")] = "auto",
    warm: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Start from a saved result.")] = None,
    doublings: Annotated[
        int, typer.Option(min=0, max=12, help="Solve again on twice as many intervals, so often.")
    ] = 0,
    accuracy: Annotated[
        float | None,
        typer.Option(metavar="E", help="Refine the time grid until the estimated relative error is below it."),
    ] = None,
    parameter: Annotated[
        list[str],
        typer.Option("--parameter", metavar="NAME=VALUE", help="A value of a parameter, without a build; repeatable."),
    ] = [],  # noqa: B006
    table: Annotated[
        list[str], typer.Option(metavar="NAME=FILE.csv", help="Other numbers for a table, on as many breakpoints.")
    ] = [],  # noqa: B006
    observations: Annotated[
        list[Path], typer.Option(metavar="FILE.csv", help="Other measurements; of several bodies one file for each.")
    ] = [],  # noqa: B006
    guesses: Annotated[
        int, typer.Option(min=1, max=10000, help="Optimise from so many first guesses and keep the best.")
    ] = 1,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="Derivatives by parameters, boundary values and a given duration.")
    ] = False,
    plot: options.Plot = None,
    style: options.PictureStyle = options.PictureStyles.PAGE,
    animate: Annotated[Path | None, typer.Option(metavar="FILE", help="Save a film: .gif or .mp4.")] = None,
    save: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Save all arrays.")] = None,
    out: options.Out = None,
) -> None:
    """Solve a problem; build its module first if necessary."""
    from codegen.problem.sources import parse_arguments
    from codegen.solving.outcome import outcome_of
    from codegen.solving.request import Request
    from codegen.solving.results import output

    values: dict[str, float] = {}
    for name, text in _pairs(parameter, "--parameter", "VALUE", "m=2.5").items():
        try:
            values[name] = float(text)
        except ValueError:
            raise ArgumentError(f"--parameter {name}={text} is no number", "write --parameter m=2.5") from None
    tables = {name: Path(file) for name, file in _pairs(table, "--table", "FILE", "thrust=other.csv").items()}
    request = Request(
        problem, driver, arguments=parse_arguments(set_, problem), scheme=scheme, method=method,
        controls=controls.value, out=out, steps=steps, every=every, repeat=repeat, warm=warm, doublings=doublings,
        accuracy=accuracy, guesses=guesses, tolerance=tolerance, max_iterations=max_iterations, time_limit=time_limit,
        scaling=scaling, log=log, parameters=values or None, tables=tables or None,
        observations=observations or None, sensitivities=sensitivities,
    )  # fmt: skip
    if save is not None:
        output.require_writable(save, output.ARCHIVES, "--save")
    if out is not None:
        output.require_folder(out, "--out", may_be_made=True)
    wanted = requested(request, plot, animate, style.value)
    outcome = outcome_of(request, working, following, partial(working, "Solving")).for_command_line
    if save is not None:
        output.save(outcome.result, outcome.record, save)
    wanted.save(outcome.module, outcome.result)
    result, record = outcome.result, outcome.record
    for line in outcome.notices:
        typer.echo(line, err=True)
    if log:
        console(stderr=json).print(output.log_table(result))
    for attempt in result.attempts:
        typer.echo(attempt, err=True)
    of_result = result.notes if json and result.solved else ()  # the table has these notes
    for note in (*output.notes(outcome.module.metadata), *output.notes_of_parts(result), *of_result):
        typer.echo(f"codegen: note: {note}", err=True)
    if json:
        typer.echo(output.as_json(record))
    else:
        console().print(result.title, style="bold", markup=False)
        console().print(output.as_table(record, result))
        if result.estimates:
            console().print(*output.estimates_tables(record["estimates"]))
        if result.sensitivity is not None and not result.sensitivity.reason:
            console().print(output.sensitivities_table(record["sensitivities"]))
    if not result.solved:
        typer.echo(one_line(f"codegen: {result.message}") + options.on_statuses(result.status), err=True)
        raise typer.Exit(1)


def _pairs(items: Sequence[str], option: str, what: str, example: str) -> dict[str, str]:
    """Return items NAME=text as a dict; other or repeated items raise ArgumentError with the form NAME=`what`."""
    pairs = []
    for item in items:
        name, _, text = item.partition("=")
        if not (name.strip() and text):
            raise ArgumentError(f"{option} {item!r} is not of the form NAME={what}", f"write {option} {example}")
        pairs.append((name.strip(), text.strip()))
    return options.once(option, pairs)


@dataclass(frozen=True)
class Pictures:
    """The requested files of pictures, and the model with the drawing of the problem; `unit` is the unit of time."""

    plot: Path | None = None
    animation: Path | None = None
    model: Model | PairwiseModel | None = None
    unit: str = ""
    style: str = "page"

    def save(self, module: GeneratedModule, result: Result) -> None:
        """Write the files."""
        if self.plot is not None:
            from codegen.show.figures.picture import Picture
            from codegen.show.films import figure_of

            Picture(figure_of(module, self.model, result, self.unit, self.style), self.style).save(self.plot)
        if self.animation is not None:
            from codegen.show.films import save_film

            with replacing(self.animation) as temporary:
                save_film(self.model, result, temporary, _with_progress)


def requested(request: Request, plot: Path | None, animation: Path | None, style: str = "page") -> Pictures:
    """Return the requested pictures after checks that need no solution.

    Raises ArgumentError for files that cannot be written, for a film .mp4 without ffmpeg, and for a film of a problem
    without a drawing. Raises the errors of the problem file.
    """
    from codegen.solving.results.output import require_writable

    if plot is not None:
        require_writable(plot, PLOTS, "--plot")
    if animation is not None:
        require_writable(animation, ANIMATIONS, "--animate")
        if animation.suffix.lower() == ".mp4" and shutil.which("ffmpeg") is None:
            finding = f"--animate {animation} needs the program ffmpeg, which is not installed"
            raise ArgumentError(finding, "install ffmpeg, or let the file end in .gif")
    if plot is None and animation is None:
        return Pictures()
    from codegen.discretise.model.from_problem import load_problem
    from codegen.show.films import unit_of

    model: Model | PairwiseModel | None = None
    unit = ""
    if not request.is_built:
        model = load_problem(request.source, request.settings)
        unit = unit_of(request.source)
    if animation is not None and not (model and model.drawing):
        finding = f"--animate {animation}: {request.problem} says nothing about how to draw it"
        raise ArgumentError(finding, "add drawing=[...] with items of codegen.drawing to the problem")
    return Pictures(plot, animation, model, unit, style)


def _with_progress(frames: Iterable[Frame], count: int) -> Iterable[Frame]:
    """Return the frames, with a progress bar if the error output is a terminal."""
    if not sys.stderr.isatty():
        return frames
    from rich.console import Console
    from rich.progress import track

    return track(frames, "Drawing", total=count, console=Console(stderr=True), transient=True)
