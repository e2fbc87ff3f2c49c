"""A solve with other numbers in the tables of a module, which was built for as many breakpoints."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from codegen.errors import ArgumentError, TableError
from codegen.interfaces import GeneratedModule, Vector, is_connect
from codegen.runtime.record import TableRecord
from codegen.tables.files import read_table


def with_tables(module: GeneratedModule, files: Mapping[str, Path | str] | None) -> Any:
    """The module with the tables of some files in place of its own, by their names, or itself where there are none.

    Raises ArgumentError for a name that is no table's, and TableError for a file that is no such table.
    """
    if not files:
        return module
    known = module.metadata.tables
    numbers = {name: _numbers(name, Path(file), known) for name, file in files.items()}
    return with_arguments(module, tables=numbers)


def with_arguments(module: Any, **given: Any) -> Any:
    """The module with arguments given to whatever makes its grids, or its cases."""
    other = ModuleType(getattr(module, "__name__", "generated"))
    other.__dict__.update(vars(module))
    makers = ("make_case", "solve") if is_connect(module) else ("make_grid", "nlp", "solve")
    other.__dict__.update({name: partial(getattr(module, name), **given) for name in makers if hasattr(module, name)})
    return other


def _numbers(name: str, file: Path, known: Mapping[str, TableRecord]) -> Vector:
    if name not in known:
        remedy = f"name one of {', '.join(known)}" if known else "leave it out"
        raise ArgumentError(f"--table {name}={file}: the problem has no table {name}", remedy)
    own = known[name]
    columns = (own.inputs, own.output, own.kind, own.outside)
    table = read_table(file, file.as_posix(), name, *columns)
    if table.shape.sizes != own.sizes:
        found, wanted = (" and ".join(map(str, sizes)) for sizes in (table.shape.sizes, own.sizes))
        raise TableError(
            f"{file}: table {name} has {found} breakpoints, and the module is built for {wanted}",
            "give as many, or change the problem's own file",
        )
    return np.array(table.numbers)
