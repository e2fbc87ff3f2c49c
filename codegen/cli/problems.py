"""The commands `new`, `build` and `show`: problem files of the gallery, modules, and discrete equations."""

from __future__ import annotations

import ast
import re
import shutil
import time
from contextlib import nullcontext
from pathlib import Path
from typing import Annotated

import typer

from codegen.cli import options
from codegen.emit.deadline import BUILD
from codegen.errors import ArgumentError, clause
from codegen.terminal import console, working

EXAMPLES = {
    "new": ("codegen new", "codegen new cart_pole"),
    "build": (
        "codegen build problems/pendulum.py --scheme stormer-verlet",
        "codegen build problems/cart_pole.py --standalone --out modules",
    ),
    "show": ("codegen show problems/pendulum.py", "codegen show problems/cart_pole.py --scheme midpoint --latex"),
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
    time_limit: Annotated[float, typer.Option(min=0.1, metavar="S", help="Most seconds of derivation.")] = BUILD,
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
