"""The command `codegen sweep`: many solves of one problem, shared between processes, into one file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from codegen.cli.options import (
    Controls,
    ControlSites,
    Every,
    Json,
    PictureStyle,
    PictureStyles,
    Plot,
    Problem,
    Scheme,
    Set,
    Steps,
    on_statuses,
    positive,
)
from codegen.errors import ArgumentError
from codegen.terminal import console, progress, working

Vary = Annotated[
    list[str], typer.Option(metavar="NAME=VALUES", help="first:last:count or a,b,c; all combinations are cases.")
]
Together = Annotated[
    list[str], typer.Option("--zip", metavar="NAME,NAME", help="Vary these together instead of combined.")
]
Samples = Annotated[
    list[str],
    typer.Option(metavar="NAME=DISTRIBUTION", help='As "m=normal(100, 5)", or any of scipy.stats by name.'),
]
CasesOf = Annotated[
    str | None,
    typer.Option(
        metavar="FILE.csv or N",
        help="A table with a row for each case; of samples how many. [default: 1000 samples]",
        show_default=False,
    ),
]
Sampling = Annotated[str, typer.Option(help="Of samples: random, latin or sobol.")]
Seed = Annotated[int, typer.Option(min=0, help="Of samples.")]
Store = Annotated[
    Path | None, typer.Option(metavar="FILE", help="Where results go: .zarr, as they come, or .nc, at the end.")
]
Resume = Annotated[bool, typer.Option("--resume", help="Go on with a store that was begun by the same sweep.")]
Keep = Annotated[
    str,
    typer.Option(
        metavar="NAMES",
        help="Of t,q,p,u,multipliers,energy, and of d_q, d_u, ..., derivatives of them; or none. [default: all but "
        "derivatives, or t,q,u where that is more than 250 MB]",
        show_default=False,
    ),
]
Workers = Annotated[
    int | None, typer.Option(parser=positive, metavar="N", help="Processes. [default: one for each processor]")
]
Cluster = Annotated[
    str | None, typer.Option(metavar="ADDRESS", help="The scheduler of a cluster of dask; or local, to begin one.")
]
WarmStarts = Annotated[
    bool, typer.Option("--warm-starts", help="Begin from solved neighbours, not only where the own guess fails.")
]
Chunk = Annotated[
    int | None,
    typer.Option(parser=positive, metavar="N", help="Cases written together. [default: about a second of work]"),
]
Formulation = Annotated[str | None, typer.Option(help="variational, hamiltonian or one-step.")]
DriverName = Annotated[str, typer.Option(help="As for codegen solve.")]
Tolerance = Annotated[float | None, typer.Option(metavar="E", help="Largest error of an equation.")]
MaxIterations = Annotated[int | None, typer.Option(parser=positive, metavar="N", help="Most iterations of a solve.")]
TimeLimit = Annotated[float | None, typer.Option(metavar="S", help="Most seconds of a solve.")]
Scaling = Annotated[str, typer.Option(help="auto or none, as for codegen solve (newton).")]
Sensitivities = Annotated[
    bool, typer.Option("--sensitivities", help="Derivatives of the cost by all quantities; of others by --keep.")
]
Pareto = Annotated[
    str | None,
    typer.Option(metavar="A,B", help="The picture is the Pareto front of two numbers of each case; -A: large."),
]


def sweep(
    problem: Problem,
    vary: Vary = [],  # noqa: B006
    zip_: Together = [],  # noqa: B006
    sample: Samples = [],  # noqa: B006
    cases: CasesOf = None,
    method: Sampling = "random",
    seed: Seed = 0,
    out: Store = None,
    resume: Resume = False,
    keep: Keep = "",
    workers: Workers = None,
    cluster: Cluster = None,
    warm_starts: WarmStarts = False,
    chunk: Chunk = None,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    formulation: Formulation = None,
    controls: ControlSites = Controls.INTERVAL,
    driver: DriverName = "newton",
    steps: Steps = None,
    every: Every = 1,
    tolerance: Tolerance = None,
    max_iterations: MaxIterations = None,
    time_limit: TimeLimit = None,
    scaling: Scaling = "auto",
    sensitivities: Sensitivities = False,
    plot: Plot = None,
    style: PictureStyle = PictureStyles.PAGE,
    pareto: Pareto = None,
    json: Json = False,
) -> None:
    """Solve a problem for many values of its parameters, in parallel."""
    from codegen.batch.cases import assigned, axis_of
    from codegen.batch.request import sweep_request
    from codegen.batch.sweep import outcome_of

    # Refuse, before anything else, what cannot be written.
    from codegen.cli.solve import PLOTS
    from codegen.problem.problem_file import parse_arguments
    from codegen.show.figures.pareto import objectives_of
    from codegen.solving.results.output import require_writable

    if out is None:
        raise ArgumentError("a sweep needs a place for its results", "give --out sweep.zarr or --out sweep.nc")
    if plot is not None:
        require_writable(plot, PLOTS, "--plot")
    elif pareto is not None:
        raise ArgumentError("--pareto without --plot", "name the file of the picture, as --plot front.png")
    if pareto is not None:
        objectives_of(pareto)
    request = sweep_request(
        problem,
        _once("--vary", [axis_of(item) for item in vary]),
        zipped=[[name.strip() for name in group.split(",")] for group in zip_],
        samples=_once("--sample", [assigned("--sample", item, '"m=normal(100, 5)"') for item in sample]),
        cases=int(cases) if cases is not None and cases.isascii() and cases.isdigit() and len(cases) < 13 else cases,
        method=method, seed=seed, out=out, resume=resume, keep=_kept(keep) if keep else None, workers=workers,
        warm_starts=warm_starts, chunk=chunk, cluster=cluster, driver=driver, arguments=parse_arguments(set_, problem),
        scheme=scheme, formulation=formulation, controls=controls.value, steps=steps, every=every,
        tolerance=tolerance, max_iterations=max_iterations, time_limit=time_limit, scaling=scaling,
        sensitivities=sensitivities,
    )  # fmt: skip
    outcome = outcome_of(request, working, progress, partial(_require_front, pareto))
    if plot is not None:
        with working("Drawing"):
            _draw(outcome, plot, pareto, style.value)
    _tell(outcome, json)
    if outcome.tally.failed:
        raise typer.Exit(1)


def _require_front(pareto: str | None, outlined: Any) -> None:
    """Refuse objectives that the sweep will not have."""
    if pareto is not None:
        from codegen.show.figures.pareto import objectives_of, require_objectives

        require_objectives(objectives_of(pareto), outlined)


def _draw(outcome: Any, path: Path, pareto: str | None, style: str) -> None:
    from codegen.files import replacing
    from codegen.show import figures

    with replacing(path) as temporary:
        figures.save_sweep(outcome.dataset(), temporary, pareto, style)


def _once(option: str, pairs: Sequence[tuple[str, Any]]) -> dict[str, Any]:
    """The pairs as a dict; ArgumentError where a name is given twice."""
    found: dict[str, Any] = {}
    for name, value in pairs:
        if name in found:
            raise ArgumentError(f"{option} gives {name} twice", "give it once")
        found[name] = value
    return found


def _kept(names: str) -> tuple[str, ...]:
    return () if names.strip() == "none" else tuple(name.strip() for name in names.split(","))


def _kept_of_each(layout: Any) -> str:
    """Which arrays there are of each case, and which are left out because all would be too much."""
    from codegen.batch.layout import FITS

    if not layout.dims:
        return ""
    rest = ", ".join(layout.left_out)
    without = f"; with {rest} all would be more than {FITS / 1e6:.0f} MB" if rest else ""
    return f"{', '.join(layout.dims)} of each, {layout.bytes / 1e3:.3g} kB before compression{without} (--keep)"


def _tell(outcome: Any, json: bool) -> None:
    """Print how the cases ended."""
    from codegen.batch.executors.chunks import counted, table_of
    from codegen.solving.results.output import as_json

    for line in outcome.messages:
        typer.echo(line, err=True)
    tally = outcome.tally
    if json:
        typer.echo(as_json(outcome.record))
    else:
        console().print(table_of(tally))
        new = counted(tally.cases - outcome.before, "case")
        there = f", {outcome.before} of {tally.cases} were there already" if outcome.before else ""
        console().print(f"{new} in {outcome.seconds:.3g} s{there}: {outcome.out}", markup=False)
        if of_each := _kept_of_each(outcome.layout):
            console().print(of_each, markup=False)
    if tally.improved:
        were = "was" if tally.improved == 1 else "were"
        cases = counted(tally.improved, "case")
        typer.echo(f"{cases} {were} improved from neighbours beyond a jump of the cost", err=True)
    if tally.jumps:
        remain = "remains" if tally.jumps == 1 else "remain"
        text = f"{counted(tally.jumps, 'jump')} of the cost {remain}: where jump is 1, a neighbour is better"
        typer.echo(text, err=True)
    if tally.failed:
        cases = f"{tally.cases - tally.solved} of {counted(tally.cases, 'case')}"
        message = f"codegen: {cases} failed; see status and message in {outcome.out}"
        typer.echo(message + on_statuses(*tally.failed), err=True)
