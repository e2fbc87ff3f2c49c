"""The command `codegen new`: copy a problem of the gallery."""

from __future__ import annotations

import ast
import re
import shutil
from pathlib import Path
from typing import Annotated

import typer

from codegen.errors import ArgumentError, clause

EXAMPLES = ("codegen new", "codegen new cart_pole")
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

        from codegen.terminal import console

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
