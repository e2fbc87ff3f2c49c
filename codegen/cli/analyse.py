"""The command `codegen analyse`: modified equations of a scheme."""

from __future__ import annotations

from typing import Annotated

import typer

from codegen.cli.options import Method, Problem, Set
from codegen.terminal import working

EXAMPLES = (
    "codegen analyse problems/pendulum.py --scheme stormer-verlet",
    "codegen analyse problems/pendulum.py --scheme alpha --order 4 --latex",
)


def analyse(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Annotated[str | None, typer.Option(help="Discretisation, or alpha for the whole family.")] = None,
    method: Method = None,
    order: Annotated[int, typer.Option(metavar="N", help="Highest power of the step h.")] = 3,
    latex: Annotated[bool, typer.Option("--latex", help="Print LaTeX.")] = False,
) -> None:
    """Print the modified equations of a scheme. Also print the modified Hamiltonian, if it exists."""
    from codegen.evidence.analysis.modified_equations import analysis
    from codegen.problem.sources import parse_arguments

    arguments = parse_arguments(set_, problem)
    with working("Expanding"):
        text = analysis(problem, arguments, scheme=scheme, method=method, order=order, latex=latex)
    typer.echo(text)
