"""The commands `solve` and `sweep`: build the module if necessary, solve one case or many, and draw pictures."""

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
from codegen.errors import ArgumentError, clause, one_line
from codegen.files import replacing
from codegen.terminal import console, following, progress, working

if TYPE_CHECKING:
    from rich.table import Table

    from codegen.batch.executors import Tally
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
    ),
    "sweep": (
        "codegen sweep problems/orbital_transfer.py --vary r1=5.5:6.5:101 --out sweep.zarr --plot sweep.png",
        'codegen sweep problems/cart_pole.py --sample "m1=normal(1, 0.02)" --cases 500 --out sweep.nc',
    ),
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
        int | None, typer.Option(parser=options.positive, metavar="N", help="Largest number of iterations of a search.")
    ] = None,
    time_limit: Annotated[
        float | None, typer.Option(metavar="S", help="Time limit of a search in seconds (newton, ipopt).")
    ] = None,
    scaling: Annotated[str, typer.Option(help="auto, or none to work in the problem's own units (newton).")] = "auto",
    warm: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Start from a saved result.")] = None,
    doublings: Annotated[
        int, typer.Option(min=0, max=12, help="Number of further solves, each on twice as many intervals.")
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
        int, typer.Option(min=1, max=10000, help="Number of initial guesses; the best solution is kept.")
    ] = 1,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="Differentiate by parameters, boundary values and a given duration.")
    ] = False,
    plot: options.Plot = None,
    style: options.PictureStyle = options.PictureStyles.PAGE,
    animate: Annotated[Path | None, typer.Option(metavar="FILE", help="Save a film: .gif or .mp4.")] = None,
    save: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Save all arrays.")] = None,
    out: options.Out = None,
) -> None:
    """Solve a problem; build its module first if necessary."""
    from codegen.problem.sources import parse_arguments
    from codegen.solving.api import outcome_of
    from codegen.solving.request import Request
    from codegen.solving.results import output
    from codegen.solving.results.result import notes_of_parts

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
    for note in (*output.notes(outcome.module.metadata), *notes_of_parts(result), *of_result):
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


def sweep(
    problem: options.Problem,
    vary: Annotated[
        list[str], typer.Option(metavar="NAME=VALUES", help="first:last:count or a,b,c; all combinations are cases.")
    ] = [],  # noqa: B006
    zip_: Annotated[
        list[str], typer.Option("--zip", metavar="NAME,NAME", help="Vary these together instead of combined.")
    ] = [],  # noqa: B006
    sample: Annotated[
        list[str],
        typer.Option(metavar="NAME=DISTRIBUTION", help='As "m=normal(100, 5)", or any of scipy.stats by name.'),
    ] = [],  # noqa: B006
    cases: Annotated[
        str | None,
        typer.Option(
            metavar="FILE.csv or N",
            help="A table with a row for each case, or the number of samples. [default: 1000 samples]",
            show_default=False,
        ),
    ] = None,
    sampling: Annotated[str, typer.Option(help="Sampling method: random, latin or sobol.")] = "random",
    seed: Annotated[int, typer.Option(min=0, help="Seed of the samples.")] = 0,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="File for results: .zarr during the sweep, or .nc at the end.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a store of the same sweep.")] = False,
    keep: Annotated[
        str,
        typer.Option(
            metavar="NAMES",
            help="Arrays among t,q,p,u,multipliers,energy and their derivatives d_q, d_u, ...; or none. [default: all "
            "but derivatives, or t,q,u if that is more than 250 MB]",
            show_default=False,
        ),
    ] = "",
    workers: Annotated[
        int | None,
        typer.Option(parser=options.positive, metavar="N", help="Threads or processes. [default: all processors]"),
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="The scheduler of a cluster of dask; or local, to start one.")
    ] = None,
    executor: Annotated[
        str, typer.Option(metavar="PLACE", help="threads, or cuda for the GPU of this machine.")
    ] = "threads",
    warm_starts: Annotated[
        bool, typer.Option("--warm-starts", help="Start from solved neighbours, not only after a failure.")
    ] = False,
    chunk: Annotated[
        int | None,
        typer.Option(
            parser=options.positive, metavar="N", help="Cases written together. [default: about a second of work]"
        ),
    ] = None,
    set_: options.Set = [],  # noqa: B006
    scheme: options.Scheme = None,
    method: options.Method = None,
    controls: options.ControlSites = options.Controls.INTERVAL,
    driver: Annotated[str, typer.Option(help="As for codegen solve.")] = "newton",
    steps: options.Steps = None,
    every: options.Every = 1,
    tolerance: Annotated[float | None, typer.Option(metavar="E", help="Largest error of an equation.")] = None,
    max_iterations: Annotated[
        int | None, typer.Option(parser=options.positive, metavar="N", help="Iteration limit of a solve.")
    ] = None,
    time_limit: Annotated[float | None, typer.Option(metavar="S", help="Time limit of a solve in seconds.")] = None,
    scaling: Annotated[str, typer.Option(help="auto or none, as for codegen solve (newton).")] = "auto",
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="Differentiate the cost by all quantities; arrays by --keep.")
    ] = False,
    plot: options.Plot = None,
    style: options.PictureStyle = options.PictureStyles.PAGE,
    pareto: Annotated[
        str | None,
        typer.Option(metavar="A,B", help="Draw the Pareto front of two numbers of each case; -A: larger is better."),
    ] = None,
    json: options.Json = False,
) -> None:
    """Solve a problem for many values of its parameters, in parallel."""
    from codegen.batch.cases import assigned, axis_of
    from codegen.batch.executors import counted
    from codegen.batch.layout import FITS
    from codegen.batch.request import sweep_request
    from codegen.batch.sweep import outcome_of
    from codegen.cli.solve import PLOTS
    from codegen.problem.sources import parse_arguments
    from codegen.show.figures.pareto import objectives_of, require_objectives
    from codegen.solving.results.output import as_json, require_writable

    if out is None:
        raise ArgumentError("a sweep needs a place for its results", "give --out sweep.zarr or --out sweep.nc")
    if plot is not None:
        require_writable(plot, PLOTS, "--plot")
    elif pareto is not None:
        raise ArgumentError("--pareto without --plot", "name the file of the picture, as --plot front.png")
    objectives = None if pareto is None else objectives_of(pareto)
    names = () if keep.strip() == "none" else tuple(name.strip() for name in keep.split(","))
    request = sweep_request(
        problem,
        options.once("--vary", [axis_of(item) for item in vary]),
        zipped=[[name.strip() for name in group.split(",")] for group in zip_],
        samples=options.once("--sample", [assigned("--sample", item, '"m=normal(100, 5)"') for item in sample]),
        cases=int(cases) if cases is not None and cases.isascii() and cases.isdigit() and len(cases) < 13 else cases,
        sampling=sampling, seed=seed, out=out, resume=resume, keep=names if keep else None, workers=workers,
        warm_starts=warm_starts, chunk=chunk, cluster=cluster, executor=executor, driver=driver,
        arguments=parse_arguments(set_, problem),
        scheme=scheme, method=method, controls=controls.value, steps=steps, every=every,
        tolerance=tolerance, max_iterations=max_iterations, time_limit=time_limit, scaling=scaling,
        sensitivities=sensitivities,
    )  # fmt: skip
    outcome = outcome_of(
        request, working, progress, lambda outlined: require_objectives(objectives, outlined) if objectives else None
    )
    if plot is not None:
        from codegen.files import replacing
        from codegen.show import figures

        with working("Drawing"), replacing(plot) as temporary:
            figures.save_sweep(outcome.dataset(), temporary, pareto, style.value)
    for line in outcome.messages:
        typer.echo(line, err=True)
    tally = outcome.tally
    if json:
        typer.echo(as_json(outcome.record))
    else:
        console().print(_table_of(tally))
        new = counted(tally.cases - outcome.before, "case")
        before = f", {outcome.before} of {tally.cases} were there already" if outcome.before else ""
        console().print(f"{new} in {outcome.seconds:.3g} s{before}: {outcome.out}", markup=False)
        layout, rest = outcome.layout, ", ".join(outcome.layout.left_out)
        if layout.dims:
            without = f"; with {rest} all would be more than {FITS / 1e6:.0f} MB" if rest else ""
            arrays = f"{', '.join(layout.dims)} of each, {layout.bytes / 1e3:.3g} kB before compression"
            console().print(f"{arrays}{without} (--keep)", markup=False)
    if tally.improved:
        were = "was" if tally.improved == 1 else "were"
        improved = counted(tally.improved, "case")
        typer.echo(f"{improved} {were} improved from neighbours beyond a jump of the cost", err=True)
    if tally.jumps:
        remain = "remains" if tally.jumps == 1 else "remain"
        text = f"{counted(tally.jumps, 'jump')} of the cost {remain}: where jump is 1, a neighbour is better"
        typer.echo(text, err=True)
    if tally.failed:
        failed = f"{tally.cases - tally.solved} of {counted(tally.cases, 'case')}"
        message = f"codegen: {failed} failed; see status and message in {outcome.out}"
        typer.echo(message + options.on_statuses(*tally.failed), err=True)
        raise typer.Exit(1)


def _table_of(tally: Tally) -> Table:
    """Return a table for the terminal, with a row for each status and an example of its messages."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    from codegen.batch.executors import SOLVED

    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("status", no_wrap=True)
    table.add_column("cases", justify="right")
    table.add_column("for example")
    for status, count in {SOLVED: tally.solved, **tally.failed}.items():
        style = "green" if status == SOLVED else "bold red"
        example = "" if status == SOLVED else escape(clause(tally.messages.get(status, "")))
        table.add_row(f"[{style}]{status}[/]", str(count), example)
    return table
