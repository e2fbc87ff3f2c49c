"""The command `codegen solve`: build where necessary, solve, and say how it ended."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.modules import build_module
from codegen.cli.options import (
    Controls,
    Every,
    Json,
    Log,
    Method,
    Out,
    Place,
    Problem,
    Repeat,
    Scheme,
    Set,
    Steps,
    positive,
)
from codegen.errors import one_line
from codegen.terminal import console, following, working


def solve(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    method: Method = None,
    controls: Place = Controls.INTERVAL,
    driver: Annotated[
        str, typer.Option(help="newton (generated), slsqp, trust-constr, ipopt, fsolve, fmin.")
    ] = "newton",
    steps: Steps = None,
    every: Every = 1,
    repeat: Repeat = 1,
    json: Json = False,
    log: Log = False,
    tolerance: Annotated[
        float | None,
        typer.Option(metavar="E", help="Largest error of an equation (newton, ipopt), or of an adaptive step."),
    ] = None,
    max_iterations: Annotated[
        int | None, typer.Option(parser=positive, metavar="N", help="Most iterations of an optimiser.")
    ] = None,
    time_limit: Annotated[float | None, typer.Option(metavar="S", help="Most seconds of an optimiser.")] = None,
    scaling: Annotated[
        str, typer.Option(help="auto, or none for an optimiser that works in the problem's own units.")
    ] = "auto",
    warm: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Start from a saved result.")] = None,
    doublings: Annotated[
        int, typer.Option(min=0, max=12, help="Solve again on twice as many intervals, so often.")
    ] = 0,
    guesses: Annotated[
        int, typer.Option(min=1, max=10000, help="Optimise from so many first guesses and keep the best.")
    ] = 1,
    plot: Annotated[Path | None, typer.Option(metavar="FILE", help="Save a picture: .png, .pdf or .svg.")] = None,
    animate: Annotated[Path | None, typer.Option(metavar="FILE", help="Save a film: .gif or .mp4.")] = None,
    save: Annotated[Path | None, typer.Option(metavar="FILE.npz", help="Save all arrays.")] = None,
    out: Out = None,
) -> None:
    """Solve a problem, building its module first where that is necessary."""
    from codegen import solving
    from codegen.cli import machine_code, pictures, solve_options
    from codegen.solutions import notes, output

    solve_options.require_sensible(driver, log, save, out)
    wanted = pictures.requested(problem, set_, plot, animate)
    points = solve_options.points_of(problem, set_)
    start_of = solve_options.start_of(warm)
    with working("Deriving"):
        made = build_module(problem, set_, scheme, method, controls, out)
    from codegen.loading import load

    begin = time.perf_counter()
    module = load(made.path)
    load_seconds = time.perf_counter() - begin
    solve_options.require_fitting(module.metadata["task"], driver, every, log)
    ahead_seconds = machine_code.require(made, module) if driver == "newton" else 0.0
    with following() as watch:
        result = solving.solve(
            module, driver, steps=steps, every=every, repeat=repeat, warm=start_of(module), doublings=doublings,
            guesses=guesses, points=points(module.metadata), tolerance=tolerance, max_iterations=max_iterations,
            time_limit=time_limit, watch=watch, scaling=scaling,
        )  # fmt: skip
    result = solve_options.with_options(result)
    compile_seconds, read_seconds = (result.seconds_first, 0.0) if result.compiled else (0.0, result.seconds_first)
    build_seconds = made.seconds + ahead_seconds + compile_seconds
    record = output.as_record(result, build_seconds, load_seconds + read_seconds)
    if save is not None:
        output.save(result, record, save)
    wanted.save(module, result)
    if log:
        console(stderr=json).print(output.log_table(result))
    for attempt in result.attempts:
        typer.echo(attempt, err=True)
    for note in notes.notes(module.metadata):
        typer.echo(f"codegen: note: {note}", err=True)
    if json:
        typer.echo(output.as_json(record))
    else:
        console().print(result.title, style="bold", markup=False)
        console().print(output.as_table(record, result.intervals))
    if not result.solved:
        may_help = (
            guesses == 1 and result.task == "control" and result.status in ("infeasible", "saddle point", "stalled")
        )
        hint = "; --guesses 10 tries ten first guesses" if may_help else ""
        typer.echo(one_line(f"codegen: {result.message}{hint}"), err=True)
        raise typer.Exit(1)
