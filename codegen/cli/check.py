"""The command `codegen check`: evidence for the derivation and the generated code."""

from __future__ import annotations

from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Annotated

import typer

from codegen.cli.options import Controls, ControlSites, Method, Problem, Scheme, Set, Steps
from codegen.emit.deadline import CHECK
from codegen.errors import one_line
from codegen.terminal import console, working

EXAMPLES = ("codegen check problems/pendulum.py", "codegen check problems/cart_pole.py --time-limit 300")


def check(
    problem: Problem,
    set_: Set = [],  # noqa: B006
    scheme: Scheme = None,
    method: Method = None,
    controls: ControlSites = Controls.INTERVAL,
    steps: Steps = None,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="Check the module with sensitivities.")
    ] = False,
    out: Annotated[Path | None, typer.Option(help="Folder of the module to check. [default: generated]")] = None,
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Time limit in seconds.")] = CHECK,
) -> None:
    """Check the derivation and the generated code. Exit status 1 if a check fails."""
    from numba.core.errors import NumbaError

    from codegen.emit import naming
    from codegen.evidence.checks.base import findings_table, not_applicable, verdict
    from codegen.problem.sources import parse_arguments
    from codegen.solving import compiler
    from codegen.solving.loading import load
    from codegen.solving.machine_code import processes
    from codegen.solving.results import output

    if out is not None:
        output.require_folder(out, "--out")
    arguments = parse_arguments(set_, problem)
    with working("Checking"):
        from codegen.evidence import checks

        # Check an existing module in the folder as it is, even if edited by hand; otherwise a module of the cache.
        choices = naming.chosen(scheme, method, controls.value, sensitivities=sensitivities)
        module = (out or compiler.GENERATED) / f"{naming.module_name(problem, arguments, choices)}.py"
        is_new = False
        if not module.is_file():
            built = compiler.build(
                problem, arguments, scheme=choices.scheme, method=choices.method, controls=choices.controls,
                sensitivities=choices.sensitivities,
            )  # fmt: skip
            module, is_new = built.path, built.written
        # Compile before the checks, because their time limits would interrupt the compiler. The checks report code of a
        # damaged module that cannot be compiled.
        with suppress(NumbaError):
            for line in processes.require(module, load(module), is_new, nullcontext)[1]:
                typer.echo(line, err=True)
        findings = checks.run(
            problem, arguments, scheme=scheme, method=method, controls=controls.value, module=module,
            time_limit=time_limit, sensitivities=sensitivities, steps=steps,
        )  # fmt: skip
    failed = [finding for finding in findings if not finding.passed]
    screen = console()
    screen.print(f"[bold {'red' if failed else 'green'}]{verdict(findings)}[/]")
    table = findings_table(findings)
    if table.row_count:
        screen.print(table)
    if line := not_applicable(findings):
        screen.print(line, style="dim")
    if failed:
        text = f"codegen: {len(failed)} of {len(findings)} checks failed, first {failed[0].check}"
        typer.echo(one_line(text), err=True)
        raise typer.Exit(1)
