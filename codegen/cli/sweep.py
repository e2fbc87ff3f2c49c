"""The command `codegen sweep`: solve many cases of one problem by several workers, and store them in one file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from codegen.cli import options
from codegen.errors import ArgumentError, clause
from codegen.terminal import console, progress, working

if TYPE_CHECKING:
    from rich.table import Table

    from codegen.batch.executors import Tally

EXAMPLES = {
    "sweep": (
        "codegen sweep problems/orbital_transfer.py --vary r1=5.5:6.5:101 --out sweep.zarr --plot sweep.png",
        'codegen sweep problems/cart_pole.py --sample "m1=normal(1, 0.02)" --cases 500 --out sweep.nc',
    )
}


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
        bool, typer.Option("--sensitivities", help="Derivatives of the cost by all quantities; of arrays by --keep.")
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
