"""The commands about problems: `new`, `build`, `show`, and the evidence of `check`, `analyse`, `report`, `stress`."""

from __future__ import annotations

import ast
import re
import shutil
import time
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Annotated

import typer

from codegen.cli import options
from codegen.emit.deadline import BUILD, CHECK
from codegen.errors import ArgumentError, clause, one_line
from codegen.terminal import console, progress, working

EXAMPLES = {
    "new": ("codegen new", "codegen new cart_pole"),
    "build": (
        "codegen build problems/pendulum.py --scheme stormer-verlet",
        "codegen build problems/cart_pole.py --standalone --out modules",
    ),
    "show": ("codegen show problems/pendulum.py", "codegen show problems/cart_pole.py --scheme midpoint --latex"),
    "check": ("codegen check problems/pendulum.py", "codegen check problems/cart_pole.py --time-limit 300"),
    "analyse": (
        "codegen analyse problems/pendulum.py --scheme stormer-verlet",
        "codegen analyse problems/pendulum.py --scheme alpha --order 4 --latex",
    ),
    "report": (
        "codegen report problems/pendulum.py --out report --quick",
        "codegen report --all --out report --compare earlier",
    ),
    "stress": ("codegen stress problems/pendulum.py --out stress", "codegen stress --quick --out stress"),
}
_DATA = re.compile(r'"((?:\.\./)?data/[\w.]+\.csv)"')


def new(
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="The problem. [default: list all names]")] = None,
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for the file.")] = Path("."),
) -> None:
    """Copy a problem of the gallery, with its data. Without NAME list all problems."""
    package = Path(__file__).parents[1]
    # The gallery is a folder of the installed package, or of a checkout.
    folder = next((path for path in (package / "gallery", package.parent / "problems") if path.is_dir()), None)
    if folder is None:
        raise ArgumentError("the gallery of problems is missing from the installation", "install the package again")
    files = {path.stem: path for path in (*sorted(folder.glob("*.py")), *sorted((folder / "published").glob("*.py")))}
    if name is None:
        from rich.table import Table

        table = Table("name", "problem", box=None, pad_edge=False)
        for stem, path in files.items():
            title = (ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or "").partition("\n\n")[0]
            table.add_row(stem, " ".join(title.split()))
        console().print(table)
        return
    name = name.removesuffix(".py")
    if name not in files:
        from difflib import get_close_matches

        close = " or ".join(get_close_matches(name, files, 3, 0.5))
        remedy = f"did you mean {close}?" if close else "codegen new lists all names"
        raise ArgumentError(clause(f"the gallery has no problem {name}"), remedy)
    from codegen.files import write_text
    from codegen.solving.results.output import require_folder

    require_folder(out, "--out", may_be_made=True)
    target = out / files[name].name
    if target.exists():
        raise ArgumentError(f"{target} exists already", "choose another folder by --out")
    out.mkdir(parents=True, exist_ok=True)
    text = files[name].read_text(encoding="utf-8")
    for reference in sorted(set(_DATA.findall(text))):
        data = out / "data" / Path(reference).name
        data.parent.mkdir(exist_ok=True)
        if not data.exists():
            shutil.copyfile(files[name].parent / reference, data)
        text = text.replace(f'"{reference}"', f'"data/{data.name}"')
    write_text(target, text)
    typer.echo(f"{target}: solve it by codegen solve {target}")


def build(
    problem: options.Problem,
    set_: options.Set = [],  # noqa: B006  typer copies it
    scheme: options.Scheme = None,
    method: options.Method = None,
    controls: options.ControlSites = options.Controls.INTERVAL,
    sensitivities: Annotated[
        bool, typer.Option("--sensitivities", help="Include the functions for derivatives of solutions.")
    ] = False,
    standalone: Annotated[
        bool, typer.Option("--standalone", help="Write one file that needs numpy and numba alone; compile later.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder for the module.")] = Path("generated"),
    no_compile: Annotated[bool, typer.Option("--no-compile", help="Compile at the first solve.")] = False,
    time_limit: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="Time limit of the derivation in seconds.")
    ] = BUILD,
) -> None:
    """Derive, write and compile the module that solves a problem."""
    from codegen.problem.sources import parse_arguments
    from codegen.solving import compiler
    from codegen.solving.loading import load
    from codegen.solving.machine_code.processes import compilers, require
    from codegen.solving.results import output

    output.require_folder(out, "--out", may_be_made=True)
    begin, arguments = time.perf_counter(), parse_arguments(set_, problem)
    with nullcontext() if no_compile or standalone else compilers() as processes:
        with working("Deriving"):
            result = compiler.build(
                problem, arguments, scheme=scheme, method=method, controls=controls.value, out=out,
                time_limit=time_limit, sensitivities=sensitivities, standalone=standalone,
                deriving=(lambda: None) if processes is None else processes.start,
            )  # fmt: skip
        messages: list[str] = []
        if processes is not None:
            messages = require(result.path, load(result.path), result.written, working, processes)[1]
    for line in messages:
        typer.echo(line, err=True)
    seconds = time.perf_counter() - begin
    state = "written" if result.written else "up to date"
    typer.echo(f"{result.path}: {state} ({seconds:.2f} s{', derivation cached' if result.cached else ''})")
    for note in output.notes_of_file(result.path):
        typer.echo(f"codegen: note: {note}", err=True)


def show(
    problem: options.Problem,
    set_: options.Set = [],  # noqa: B006
    scheme: options.Scheme = None,
    method: options.Method = None,
    controls: options.ControlSites = options.Controls.INTERVAL,
    latex: Annotated[bool, typer.Option("--latex", help="Print LaTeX.")] = False,
) -> None:
    """Print the derived discrete equations."""
    from codegen.problem.sources import parse_arguments
    from codegen.show.equations import equations

    arguments = parse_arguments(set_, problem)
    with working("Deriving"):
        text = equations(problem, arguments, scheme=scheme, method=method, controls=controls.value, latex=latex)
    typer.echo(text)


def check(
    problem: options.Problem,
    set_: options.Set = [],  # noqa: B006
    scheme: options.Scheme = None,
    method: options.Method = None,
    controls: options.ControlSites = options.Controls.INTERVAL,
    steps: options.Steps = None,
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


def analyse(
    problem: options.Problem,
    set_: options.Set = [],  # noqa: B006
    scheme: Annotated[str | None, typer.Option(help="Discretisation, or alpha for the whole family.")] = None,
    method: options.Method = None,
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


def stress(
    problem: Annotated[Path | None, typer.Argument(metavar="PROBLEM.py", help="The problem file.")] = None,
    set_: options.Set = [],  # noqa: B006
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
