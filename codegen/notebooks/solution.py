"""A solution in a notebook: a table with its figure, the figure alone, and its film."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

from codegen import loading, pictures
from codegen.author.sources import ProblemObject
from codegen.errors import ArgumentError, CodegenError
from codegen.model.from_file import load_problem
from codegen.notebooks.tables import number, table
from codegen.plots.picture import Film, Picture
from codegen.solutions import output
from codegen.solutions.display import Background
from codegen.solutions.output import with_unit
from codegen.solutions.result import Result
from codegen.solving.other_values import with_values


def html(result: Result) -> str:
    """How it ended, with its figure where there may be one."""
    units = result.units
    rows = [
        ("problem", f"{result.problem} ({result.task})"),
        ("discretisation", f"{result.method}, {result.scheme}, {result.intervals}"),
        *([("given", given)] if (given := output.given(result)) else []),
        ("status", f"{result.status}: {result.message}"),
        *([("cost", with_unit(number(result.cost, 12), units.get("cost", "")))] if result.cost is not None else []),
        ("residual", number(result.residual)),
        ("iterations", f"{result.iterations} ({result.driver})"),
        *(
            (result.label(name), with_unit(number(value), result.unit_of(name)))
            for name, value in result.summary.items()
        ),
        ("seconds", number(result.seconds_solve, 3)),
    ]
    own = table(rows, caption=result.title)
    try:
        return own + picture(result)._repr_html_()
    except CodegenError:  # the table says what there is; `plot` says why there is no figure
        return own


def picture(result: Result, style: str = "page") -> Picture:
    """The figure of everything about a solution; ArgumentError for a style that there is not."""
    own = _background(result)
    module: Any = own.module
    if module is None:  # of a pickle
        module = with_values(loading.load(own.path or ""), result.parameters)
    unit = "" if own.source is None else _unit(own)
    return Picture(pictures.figure_of(module, _model(own), result, unit, style), style)


def film(result: Result) -> Film:
    """The film of its problem's drawing."""
    own = _background(result)
    model = _model(own)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.gif"
        pictures.save_film(model, result, path)
        return Film(path.read_bytes(), result.title, lambda file: pictures.save_film(model, result, file))


def _background(result: Result) -> Background:
    if result.background is None:
        raise ArgumentError(f"{result.problem}: this solution does not know its module", "solve by codegen.solve")
    return result.background


def _model(own: Background) -> Any:
    """What the author has written, checked; nothing for a module that was given without it."""
    return None if own.source is None else load_problem(own.source, own.arguments)


def _unit(own: Background) -> str:
    return "" if isinstance(own.source, ProblemObject) else pictures.unit_of(own.source)
