"""The command `codegen check`: evidence that the derivation and the generated code are right."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from codegen.cli.options import Controls, ControlSites, Method, Problem, Scheme, Set
from codegen.emit.deadline import CHECK
from codegen.errors import one_line
from codegen.terminal import console, working

if TYPE_CHECKING:
    from codegen.emit.naming import Choices


def check(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    method: Method = None,
    controls: ControlSites = Controls.INTERVAL,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="Of the module with sensitivities, these as well.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the module to check. [default: generated]")] = None,
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Most seconds of all checks.")] = CHECK,
) -> None:
    """Check the derivation and the generated code; exit status 1 if a check fails."""
    from codegen.emit import naming
    from codegen.evidence.checks.base import findings_table, verdict
    from codegen.problem.sources import parse_arguments
    from codegen.solving.results import output

    if out is not None:
        output.require_folder(out, "--out")
    arguments = parse_arguments(set_, problem)
    with working("Checking"):
        from codegen.evidence import checks

        made = _module(
            problem, arguments, naming.chosen(scheme, method, controls.value, sensitivities=sensitivities), out
        )
        findings = checks.run(
            problem, arguments, scheme=scheme, method=method, controls=controls.value, module=made,
            time_limit=time_limit, sensitivities=sensitivities,
        )  # fmt: skip
    failed = [finding for finding in findings if not finding.passed]
    screen = console()
    screen.print(f"[bold {'red' if failed else 'green'}]{verdict(findings)}[/]")
    screen.print(findings_table(findings))
    if failed:
        text = f"codegen: {len(failed)} of {len(findings)} checks failed, first {failed[0].check}"
        typer.echo(one_line(text), err=True)
        raise typer.Exit(1)


def _module(problem: Path, arguments: Mapping[str, str], choices: Choices, out: Path | None) -> Path:
    """The module that someone keeps, as it stands, since it may have been changed by hand; else one of the cache."""
    from codegen.emit import naming
    from codegen.solving import compiler
    from codegen.solving.loading import load
    from codegen.solving.machine_code import processes

    kept = (out or compiler.GENERATED) / f"{naming.module_name(problem, arguments, choices)}.py"
    if kept.is_file():
        return kept
    made = compiler.build(
        problem, arguments, scheme=choices.scheme, method=choices.method, controls=choices.controls,
        sensitivities=choices.sensitivities,
    )  # fmt: skip
    for line in processes.require(made.path, load(made.path), made.written, nullcontext)[1]:
        typer.echo(line, err=True)
    return made.path
