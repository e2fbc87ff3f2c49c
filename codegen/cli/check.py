"""The command `codegen check`: evidence that the derivation and the generated code are right."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.modules import build_module, compiled
from codegen.cli.options import Controls, Method, Place, Problem, Scheme, Set
from codegen.deadline import CHECK
from codegen.errors import one_line
from codegen.terminal import console, working


def check(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    method: Method = None,
    controls: Place = Controls.INTERVAL,
    out: Annotated[Path | None, typer.Option(help="Folder of the module to check. [default: generated]")] = None,
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Most seconds of all checks.")] = CHECK,
) -> None:
    """Check the derivation and the generated code; exit status 1 if a check fails."""
    from codegen.author.problem_file import parse_arguments
    from codegen.solutions import output

    if out is not None:
        output.require_folder(out, "--out")
    arguments = parse_arguments(set_, problem)
    with working("Checking"):
        from codegen import checks, compiler, naming

        # A module that someone keeps is checked as it stands, never rebuilt: it may have been changed by hand.
        choices = naming.chosen(scheme, method, controls.value)
        kept = (out or compiler.GENERATED) / f"{naming.module_name(problem, arguments, choices)}.py"
        made = kept if kept.is_file() else compiled(build_module(problem, set_, scheme, method, controls, None))
        findings = checks.run(
            problem,
            arguments,
            scheme=scheme,
            method=method,
            controls=controls.value,
            module=made,
            time_limit=time_limit,
        )
    console().print(output.findings_table(findings))
    failed = [finding for finding in findings if not finding.passed]
    if failed:
        text = f"codegen: {len(failed)} of {len(findings)} checks failed, first {failed[0].check}"
        typer.echo(one_line(text), err=True)
        raise typer.Exit(1)
