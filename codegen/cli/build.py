"""The command `codegen build`: derive, write and compile a module."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.options import Controls, ControlSites, Method, Problem, Scheme, Set
from codegen.emit.deadline import BUILD
from codegen.terminal import working


def build(
    problem: Problem,
    set_: Set = [],  # noqa: B006  typer copies it
    scheme: Scheme = None,
    method: Method = None,
    controls: ControlSites = Controls.INTERVAL,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="With what derivatives of solutions need.")
    ] = False,
    standalone: Annotated[
        bool, typer.Option("--standalone", help="As one file that needs numpy and numba alone; it is compiled later.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for the module.")] = Path("generated"),
    no_compile: Annotated[bool, typer.Option("--no-compile", help="Leave compilation to the first solve.")] = False,
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Most seconds of derivation.")] = BUILD,
) -> None:
    """Derive and write the module that solves a problem, and compile it."""
    from codegen.problem.sources import parse_arguments
    from codegen.solving import compiler
    from codegen.solving.loading import load
    from codegen.solving.machine_code import processes as machine_code
    from codegen.solving.machine_code.processes import compilers
    from codegen.solving.results import output
    from codegen.solving.results import output as notes

    output.require_folder(out, "--out", may_be_made=True)
    begin, arguments = time.perf_counter(), parse_arguments(set_, problem)
    with nullcontext() if no_compile or standalone else compilers() as processes:
        with working("Deriving"):
            made = compiler.build(
                problem, arguments, scheme=scheme, method=method, controls=controls.value, out=out,
                time_limit=time_limit, sensitivities=sensitivities, standalone=standalone,
                deriving=(lambda: None) if processes is None else processes.start,
            )  # fmt: skip
        said: list[str] = []
        if processes is not None:
            said = machine_code.require(made.path, load(made.path), made.written, working, processes)[1]
    for line in said:
        typer.echo(line, err=True)
    seconds = time.perf_counter() - begin
    state = "written" if made.written else "up to date"
    typer.echo(f"{made.path}: {state} ({seconds:.2f} s{', derivation cached' if made.cached else ''})")
    for note in notes.notes_of_file(made.path):
        typer.echo(f"codegen: note: {note}", err=True)
