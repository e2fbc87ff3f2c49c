"""The command `codegen report`: measurements of problems on one page."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from codegen.errors import one_line

EXAMPLES = (
    "codegen report problems/pendulum.py --out report --quick",
    "codegen report --all --out report --compare earlier",
)


def report(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder for the page and the measurements.")],
    problem: Annotated[
        Path | None, typer.Argument(metavar="[PROBLEM.py]", help="The problem file; with --all a folder of them.")
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="All problems of a folder. [default: problems]")] = False,
    quick: Annotated[bool, typer.Option("--quick", help="Measure a few cases only, in about a minute.")] = False,
    limit: Annotated[
        float | None, typer.Option(min=0.1, metavar="S", help="Skip finer grids after a solve of S seconds.")
    ] = None,
    compare: Annotated[
        Path | None, typer.Option(metavar="OLD", help="An earlier report; exit status 1 if more than times is worse.")
    ] = None,
) -> None:
    """Measure every scheme and driver and write one page. Measurements that DIR has are not repeated."""
    from codegen.evidence import report as reports
    from codegen.evidence.report.gallery import table_of
    from codegen.solving.results import output
    from codegen.terminal import console

    output.require_folder(out, "--out", may_be_made=True)
    made = reports.problems_report(problem, out, everything=everything, quick=quick, limit=limit, earlier=compare)
    typer.echo(made.page)
    if made.regressions:
        console(stderr=True).print(table_of(made.regressions))
    decisive = [regression for regression in made.regressions if regression.decides]
    if decisive:
        first = decisive[0]
        text = f"{len(decisive)} regressions, first {first.what} of {first.problem}: {first.case}"
        typer.echo(one_line(f"codegen: {text}"), err=True)
        raise typer.Exit(1)
