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

EXAMPLES = (
    "codegen build problems/pendulum.py --scheme stormer-verlet",
    "codegen build problems/cart_pole.py --standalone --out modules",
)


def build(
    problem: Problem,
    set_: Set = [],  # noqa: B006  typer copies it
    scheme: Scheme = None,
    method: Method = None,
    controls: ControlSites = Controls.INTERVAL,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="Include the functions for derivatives of solutions.")
    ] = False,
    standalone: Annotated[
        bool, typer.Option("--standalone", help="Write one file that needs numpy and numba alone; compile later.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for the module.")] = Path("generated"),
    no_compile: Annotated[bool, typer.Option("--no-compile", help="Compile at the first solve.")] = False,
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Most seconds of derivation.")] = BUILD,
) -> None:
    """Derive, write and compile the module that solves a problem."""
    from codegen.problem.sources import parse_arguments
    from codegen.solving import compiler
    from codegen.solving.loading import load
    from codegen.solving.machine_code.processes import compilers, require
    from codegen.solving.results import output

    output.require_folder(out, "--out", may_be_made=True)
    begin, arguments = time.perf_counter(), parse_arguments(set_, problem)
    with nullcontext() if no_compile or standalone else compilers() as processes:
        with working("Deriving"):
            result = compiler.build(
                problem, arguments, scheme=scheme, method=method, controls=controls.value, out=out,
                time_limit=time_limit, sensitivities=sensitivities, standalone=standalone,
                deriving=(lambda: None) if processes is None else processes.start,
            )  # fmt: skip
        messages: list[str] = []
        if processes is not None:
            messages = require(result.path, load(result.path), result.written, working, processes)[1]
    for line in messages:
        typer.echo(line, err=True)
    seconds = time.perf_counter() - begin
    state = "written" if result.written else "up to date"
    typer.echo(f"{result.path}: {state} ({seconds:.2f} s{', derivation cached' if result.cached else ''})")
    for note in output.notes_of_file(result.path):
        typer.echo(f"codegen: note: {note}", err=True)
