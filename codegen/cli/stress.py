"""The command `codegen stress`: solves of stiff and extreme cases."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.options import Set
from codegen.errors import ArgumentError, one_line
from codegen.terminal import console, progress, working

EXAMPLES = ("codegen stress problems/pendulum.py --out stress", "codegen stress --quick --out stress")


def stress(
    problem: Annotated[Path | None, typer.Argument(metavar="PROBLEM.py", help="The problem file.")] = None,
    set_: Set = [],  # noqa: B006
    all_: Annotated[bool, typer.Option("--all", help="All stiff and extreme cases of every kind of problem.")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Only the cases of a few modules.")] = False,
    out: Annotated[Path, typer.Option(help="Folder for stress.csv and stress.html.", show_default=False)] = ...,  # type: ignore[assignment]
) -> None:
    """Solve stiff and extreme cases. Exit status 1 after a wrong answer, a NaN, a hang or an unexpected error."""
    from codegen.evidence.stress import families, own, page, run
    from codegen.evidence.stress.cases import DEFECTS
    from codegen.solving.results import output

    if (problem is None) != (all_ or quick):
        raise ArgumentError("stress takes a problem file, or --all, or --quick", "give one of them")
    output.require_folder(out, "--out", may_be_made=True)
    if problem is not None:
        from codegen.problem.sources import parse_arguments

        with working("Deriving"):
            cases = own.cases_of(problem, parse_arguments(set_, problem))
    else:
        cases = families.quick_cases() if quick else families.all_cases()
    with progress("Stressing", len(cases)) as show:
        rows = run(cases, out, show)
    if problem is not None:
        console().print(own.verdict(rows), soft_wrap=True)
    console().print(page.table(rows))
    failed = [row for row in rows if row.outcome in DEFECTS and (problem is None or row.outcome != "unexpected")]
    for row in failed:
        typer.echo(f"{row.outcome}: {row.case.name}, {row.case.setup.label}: {one_line(row.text, 300)}", err=True)
    if failed:
        typer.echo(f"codegen: {len(failed)} of {len(rows)} rows failed; see {out / 'stress.html'}", err=True)
        raise typer.Exit(1)
