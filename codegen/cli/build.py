"""The command `codegen build`: derive, write and compile a module."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.modules import build_module
from codegen.cli.options import Controls, Method, Place, Problem, Scheme, Set
from codegen.deadline import BUILD
from codegen.terminal import working


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
    from codegen.solutions import notes, output

    output.require_folder(out, "--out", may_be_made=True)
    begin = time.perf_counter()
    if no_compile:
        with working("Deriving"):
            made = build_module(problem, set_, scheme, method, controls, out, time_limit)
    else:
        from codegen import solving
        from codegen.machine_code.processes import compilers

        with compilers() as processes:
            from codegen.cli import machine_code  # which imports arrays; the processes should not wait for that

            with working("Deriving"):
                made = build_module(problem, set_, scheme, method, controls, out, time_limit)
            with working("Compiling"):
                solving.prepare(made.path, processes)
        machine_code.tell(processes)
    seconds = time.perf_counter() - begin
    state = "written" if made.written else "up to date"
    typer.echo(f"{made.path}: {state} ({seconds:.2f} s{', derivation cached' if made.cached else ''})")
    for note in notes.notes_of_file(made.path):
        typer.echo(f"codegen: note: {note}", err=True)
