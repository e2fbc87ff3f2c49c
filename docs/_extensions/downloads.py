"""Notebooks that readers download: without what only this site can show, and without links that lead nowhere else."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import nbformat

_OF_THE_SITE = re.compile(r"^\{nb-download\}.*\n*|^```\{\w+\}.*\n(?:.*\n)*?```\n*", re.MULTILINE)
_LINK = re.compile(r"\[([^]]+)\]\((?!https?:)[^)\s]+\)")


def plain(text: str) -> str:
    """The Markdown of a page as JupyterLab shows it: roles and directives left out, links to other pages as words."""
    return _LINK.sub(r"\1", _OF_THE_SITE.sub("", text + "\n")).strip("\n")


def clean(app: Any, error: Exception | None) -> None:
    """Rewrite the notebooks of a finished build; one that is clean already stays as it is."""
    for path in [] if error else sorted(Path(app.outdir, "_downloads").rglob("*.ipynb")):
        notebook = nbformat.read(path, as_version=4)
        for cell in notebook.cells:
            if cell.cell_type == "markdown":
                cell.source = plain(cell.source)
        notebook.cells = [cell for cell in notebook.cells if cell.source]
        nbformat.write(notebook, path)


def setup(app: Any) -> dict[str, bool]:
    """Clean notebooks once they have been copied."""
    app.connect("build-finished", clean)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
