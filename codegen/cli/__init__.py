"""The command line: one function and one row of COMMANDS for each command.

The exit status is 0 for success, 1 if a solve or a check failed, and 2 for wrong input. Errors are one line on stderr.
Commands import slow packages in their functions, so that `codegen --help` is instant.
"""

from __future__ import annotations

from importlib import import_module
from typing import Annotated

import typer

from codegen.terminal import OneLineErrors

HELP_WIDTH = 120  # the largest width of help texts in columns; otherwise they have the width of the terminal
main = typer.Typer(
    cls=OneLineErrors,
    help="Solve mechanical problems: a problem in sympy becomes a Python module that solves the discrete problem.",
    context_settings={"max_content_width": HELP_WIDTH},
    rich_markup_mode=None,  # plain help does not import rich
)
COMMANDS = {
    "new": "problems", "build": "problems", "solve": "solve", "sweep": "solve", "check": "problems", "show": "problems",
    "analyse": "problems", "report": "problems", "stress": "problems", "warp": "registration",
    "distances": "registration", "app": "registration",
}  # fmt: skip
"""The commands in the order of the help text, and their files.

The file of a command has a function with the name of the command, and examples in EXAMPLES.
"""

for name, file in COMMANDS.items():
    module = import_module(f"codegen.cli.{file}")
    lines = getattr(module, "EXAMPLES", {}).get(name, ())
    # In an epilog \b keeps the line breaks of the paragraph.
    examples = "\n".join(("\b\nExamples:", *(f"  {line}" for line in lines)))
    main.command(epilog=examples if lines else None)(getattr(module, name))


@main.callback(invoke_without_command=True)
def _group(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from codegen import __version__

        typer.echo(f"codegen {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())
    else:
        return
    raise typer.Exit
