"""The command line: one file for each command, which reads its options and leaves the work to others.

Exit status 0: it worked; 1: the numerics or a check failed; 2: the input was wrong, which is said in one line.
Everything that is slow to import is imported by the command that needs it: `codegen --help` must be instant.
"""

from __future__ import annotations

from importlib import import_module
from typing import Annotated

import typer

from codegen.errors import ArgumentError
from codegen.terminal import OneLineErrors

main = typer.Typer(
    cls=OneLineErrors,
    help="Derive, emit and solve discrete mechanics: problems in sympy become self-contained numba solvers.",
    add_completion=False,
    rich_markup_mode=None,  # plain help needs no rich
)
COMMANDS = ("build", "solve", "sweep", "check", "show", "analyse", "report", "stress", "warp", "distances", "app")
"""Each has a file of that name here, with a function of that name; help lists them in this order."""

for name in COMMANDS:
    main.command()(getattr(import_module(f"codegen.cli.{name}"), name))


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
