"""The command `codegen show`: the derived discrete equations."""

from __future__ import annotations

from typing import Annotated

import typer

from codegen.cli.options import Controls, ControlSites, Method, Problem, Scheme, Set
from codegen.terminal import working

EXAMPLES = ("codegen show problems/pendulum.py", "codegen show problems/cart_pole.py --scheme midpoint --latex")


def show(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    method: Method = None,
    controls: ControlSites = Controls.INTERVAL,
    latex: Annotated[bool, typer.Option("--latex", help="Print LaTeX.")] = False,
) -> None:
    """Print the derived discrete equations."""
    from codegen.problem.sources import parse_arguments
    from codegen.show.equations import equations

    arguments = parse_arguments(set_, problem)
    with working("Deriving"):
        text = equations(problem, arguments, scheme=scheme, method=method, controls=controls.value, latex=latex)
    typer.echo(text)
