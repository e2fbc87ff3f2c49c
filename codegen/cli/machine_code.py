"""Machine code of modules that have none yet, and what is said where it cannot be made ahead."""

from __future__ import annotations

from typing import TYPE_CHECKING

import typer

from codegen import solving
from codegen.errors import one_line
from codegen.loading import GeneratedModule, has_machine_code
from codegen.terminal import working

if TYPE_CHECKING:
    from codegen.compiler import Build
    from codegen.machine_code.processes import Compilers


def require(made: Build, module: GeneratedModule) -> float:
    """Have a module that has no machine code compiled by processes that are quick at it; return the seconds."""
    from codegen.machine_code.processes import compilers

    if not made.written and not vars(module)["DAMAGED"] and has_machine_code(made.path, module):
        return 0.0
    with working("Compiling"), compilers() as processes:
        seconds = solving.prepare(made.path, processes)
    tell(processes)
    return seconds


def tell(processes: Compilers) -> None:
    """Say what the processes had to say, and by which error they could not make machine code, if they could not."""
    for note in processes.notes:
        typer.echo(note, err=True)
    if processes.failure:
        text = f"machine code could not be made ahead ({one_line(processes.failure)}); a first solve has made it"
        typer.echo(f"codegen: {text}", err=True)
