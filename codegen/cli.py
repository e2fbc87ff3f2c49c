"""The command line: one function for each command, whose work is done elsewhere.

Exit status 0: it worked; 1: the numerics or a check failed; 2: the input was wrong, which is said in one line.
"""

from __future__ import annotations

import time
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from codegen.app_command import app
from codegen.deadline import BUILD, CHECK
from codegen.errors import ArgumentError, one_line
from codegen.terminal import OneLineErrors, console, progress, solving, working
from codegen.warp_command import warp

if TYPE_CHECKING:
    from codegen.compiler import Build

# Everything that is slow to import is imported by the command that needs it: `codegen --help` must be instant.


main = typer.Typer(
    cls=OneLineErrors,
    help="Derive, emit and solve discrete mechanics: problems in sympy become self-contained numba solvers.",
    add_completion=False,
    rich_markup_mode=None,  # plain help needs no rich
)


def _positive(text: str | int) -> int:
    """A positive integer; typer passes defaults through as well."""
    if isinstance(text, int):
        return text
    if not (text.isascii() and text.isdigit() and len(text) < 13 and int(text) > 0):
        raise typer.BadParameter(f"{text!r} is not a positive integer")
    return int(text)


class Controls(StrEnum):
    """Where controls live."""

    INTERVAL = "interval"
    NODAL = "nodal"


Problem = Annotated[Path, typer.Argument(metavar="PROBLEM.py", help="The problem file.", show_default=False)]
Set = Annotated[list[str], typer.Option("--set", metavar="NAME=VALUE", help="An argument of problem(); repeatable.")]
Scheme = Annotated[str | None, typer.Option(help="Discretisation, such as midpoint or stormer-verlet.")]
Method = Annotated[
    str | None,
    typer.Option(help="Formulation: variational, hamiltonian or one-step; of particles stepping, full or action."),
]
Place = Annotated[Controls, typer.Option(help="Where controls live; nodal reproduces the thesis.")]
Steps = Annotated[
    int | None, typer.Option(parser=_positive, metavar="N", help="Number of intervals. [default: the problem's own]")
]
Every = Annotated[int, typer.Option(parser=_positive, metavar="N", help="Store every so many-th step of a simulation.")]
Repeat = Annotated[int, typer.Option(parser=_positive, metavar="N", help="Time the best of so many solves.")]
Log = Annotated[bool, typer.Option("--log", help="Print the iterates of the generated solver.")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
Out = Annotated[Path | None, typer.Option(help="Folder for the module. [default: generated if current, else a cache]")]


@main.callback(invoke_without_command=True)
def _group(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from codegen import __version__

        typer.echo(f"codegen {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        raise ArgumentError("no command was given", f"use {_listed_commands()}; see codegen --help")


def _listed_commands() -> str:
    *names, last = [command.callback.__name__ for command in main.registered_commands if command.callback]
    return f"{', '.join(names)} or {last}"


@main.command()
def build(
    problem: Problem,
    set_: Set = [],  # noqa: B006  typer copies it
    scheme: Scheme = None,
    method: Method = None,
    controls: Place = Controls.INTERVAL,
    out: Annotated[Path, typer.Option(help="Folder for the module.")] = Path("generated"),
    no_compile: Annotated[bool, typer.Option("--no-compile", help="Leave compilation to the first solve.")] = False,
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Most seconds of derivation.")] = BUILD,
) -> None:
    """Derive and write the module that solves a problem, and compile it."""
    from codegen import notes, output

    output.require_folder(out, "--out", may_be_made=True)
    begin = time.perf_counter()
    if no_compile:
        with working("Deriving"):
            made = _build(problem, set_, scheme, method, controls, out, time_limit)
    else:
        from codegen import drivers
        from codegen.drivers.processes import compilers

        with compilers() as processes:
            from codegen import machine_code  # which imports arrays; the processes should not wait for that

            with working("Deriving"):
                made = _build(problem, set_, scheme, method, controls, out, time_limit)
            with working("Compiling"):
                drivers.prepare(made.path, processes)
        machine_code.tell(processes)
    seconds = time.perf_counter() - begin
    state = "written" if made.written else "up to date"
    typer.echo(f"{made.path}: {state} ({seconds:.2f} s{', derivation cached' if made.cached else ''})")
    for note in notes.notes_of_file(made.path):
        typer.echo(f"codegen: note: {note}", err=True)


@main.command()
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
        int | None, typer.Option(parser=_positive, metavar="N", help="Most iterations of an optimiser.")
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
    from codegen import drivers, machine_code, notes, output, pictures, solve_options

    solve_options.require_sensible(driver, log, save, out)
    wanted = pictures.requested(problem, set_, plot, animate)
    points = solve_options.points_of(problem, set_)
    start_of = solve_options.start_of(warm)
    with working("Deriving"):
        made = _build(problem, set_, scheme, method, controls, out)
    from codegen.loading import load

    begin = time.perf_counter()
    module = load(made.path)
    load_seconds = time.perf_counter() - begin
    solve_options.require_fitting(module.metadata["task"], driver, every, log)
    ahead_seconds = machine_code.require(made, module) if driver == "newton" else 0.0
    with solving() as watch:
        result = drivers.solve(
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


@main.command()
def check(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    method: Method = None,
    controls: Place = Controls.INTERVAL,
    out: Annotated[Path | None, typer.Option(help="Folder of the module to check. [default: generated]")] = None,
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Most seconds of all checks.")] = CHECK,
) -> None:
    """Check the derivation and the generated code; exit status 1 if a check fails."""
    from codegen import output
    from codegen.problem_file import parse_arguments

    if out is not None:
        output.require_folder(out, "--out")
    arguments = parse_arguments(set_, problem)
    with working("Checking"):
        from codegen import checks, compiler

        # A module that someone keeps is checked as it stands, never rebuilt: it may have been changed by hand.
        choices = compiler.chosen(scheme, method, controls.value)
        kept = (out or compiler.GENERATED) / f"{compiler.module_name(problem, arguments, choices)}.py"
        made = kept if kept.is_file() else _compiled(_build(problem, set_, scheme, method, controls, None))
        findings = checks.run(
            problem,
            arguments,
            scheme=scheme,
            method=method,
            controls=controls.value,
            module=made,
            time_limit=time_limit,
        )
    console().print(output.findings_table(findings))
    failed = [finding for finding in findings if not finding.passed]
    if failed:
        text = f"codegen: {len(failed)} of {len(findings)} checks failed, first {failed[0].check}"
        typer.echo(one_line(text), err=True)
        raise typer.Exit(1)


@main.command()
def show(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    method: Method = None,
    controls: Place = Controls.INTERVAL,
    latex: Annotated[bool, typer.Option("--latex", help="Print LaTeX.")] = False,
) -> None:
    """Print the derived discrete equations."""
    from codegen.problem_file import parse_arguments
    from codegen.show import equations

    arguments = parse_arguments(set_, problem)
    with working("Deriving"):
        text = equations(problem, arguments, scheme=scheme, method=method, controls=controls.value, latex=latex)
    typer.echo(text)


@main.command()
def analyse(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Annotated[str | None, typer.Option(help="Discretisation, or alpha for the whole family.")] = None,
    method: Method = None,
    order: Annotated[int, typer.Option(metavar="N", help="Highest power of the step h.")] = 3,
    latex: Annotated[bool, typer.Option("--latex", help="Print LaTeX.")] = False,
) -> None:
    """Print the modified equations of a scheme, and the modified Hamiltonian if there is one."""
    from codegen.analysis.modified_text import analysis
    from codegen.problem_file import parse_arguments

    arguments = parse_arguments(set_, problem)
    with working("Expanding"):
        text = analysis(problem, arguments, scheme=scheme, method=method, order=order, latex=latex)
    typer.echo(text)


@main.command()
def report(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the page and the measurements.")],
    problem: Annotated[
        Path | None, typer.Argument(metavar="[PROBLEM.py]", help="The problem file; with --all a folder of them.")
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="All problems of a folder. [default: problems]")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="A few cases only, in less than two minutes.")] = False,
    limit: Annotated[
        float | None, typer.Option(min=0.1, metavar="S", help="Go no further after a solve of S seconds.")
    ] = None,
    compare: Annotated[
        Path | None, typer.Option(metavar="OLD", help="An earlier report; exit status 1 if anything is worse.")
    ] = None,
) -> None:
    """Measure everything about problems and write one page; what DIR holds already is not measured again."""
    from codegen import output
    from codegen import report as reports

    output.require_folder(out, "--out", may_be_made=True)
    made = reports.problems_report(problem, out, everything=everything, quick=quick, limit=limit, earlier=compare)
    typer.echo(made.page)
    if made.regressions:
        first = made.regressions[0]
        text = f"{len(made.regressions)} regressions, first {first.what} of {first.problem}: {first.case}"
        typer.echo(one_line(f"codegen: {text}"), err=True)
        raise typer.Exit(1)


@main.command()
def stress(
    problem: Annotated[Path | None, typer.Argument(metavar="PROBLEM.py", help="Stress this problem alone.")] = None,
    set_: Set = [],  # noqa: B006
    all_: Annotated[bool, typer.Option("--all", help="All stiff and extreme cases of every kind of problem.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Only the cases of a few modules.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for stress.csv and stress.html.", show_default=False)] = ...,  # type: ignore[assignment]
) -> None:
    """Solve stiff and extreme cases; exit status 1 if one ends in a wrong answer, a NaN, a hang or an untyped error."""
    from codegen import output
    from codegen import stress as stressing
    from codegen.stress import families, generic, page

    if (problem is None) != (all_ or quick):
        raise ArgumentError("stress takes a problem file, or --all, or --quick", "give one of them")
    output.require_folder(out, "--out", may_be_made=True)
    if problem is not None:
        from codegen.problem_file import parse_arguments

        with working("Deriving"):
            cases = generic.cases_of(problem, parse_arguments(set_, problem))
    else:
        cases = families.quick_cases() if quick else families.all_cases()
    with progress("Stressing", len(cases)) as moved:
        rows = stressing.run(cases, out, moved)
    console().print(page.table(rows))
    failed = [row for row in rows if not row.passed]
    for row in failed:
        typer.echo(f"{row.outcome}: {row.case.name}, {row.case.setup.label}: {one_line(row.text, 300)}", err=True)
    if failed:
        typer.echo(f"codegen: {len(failed)} of {len(rows)} rows failed; see {out / 'stress.html'}", err=True)
        raise typer.Exit(1)


main.command()(warp)
main.command()(app)


def _build(
    problem: Path,
    set_: list[str],
    scheme: str | None,
    method: str | None,
    controls: Controls,
    out: Path | None,
    time_limit: float = BUILD,
) -> Build:
    from codegen import compiler
    from codegen.problem_file import parse_arguments

    arguments = parse_arguments(set_, problem)
    return compiler.build(
        problem, arguments, scheme=scheme, method=method, controls=controls.value, out=out, time_limit=time_limit
    )


def _compiled(made: Build) -> Path:
    """The path of a module, compiled by the processes that are quick at it, not function by function when called."""
    from codegen import machine_code
    from codegen.loading import load

    machine_code.require(made, load(made.path))
    return made.path
