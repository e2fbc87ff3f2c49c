"""Solutions, closed loops and findings of checks in a notebook: tables in HTML that need no script, and figures."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Sequence
from html import escape
from pathlib import Path
from typing import Any

from codegen.discretise.model.from_problem import load_problem
from codegen.errors import ArgumentError, CodegenError
from codegen.problem.sources import ProblemObject
from codegen.show import films
from codegen.show.figures.closed_loop import References, closed_loop_figure
from codegen.show.figures.picture import Film, Picture, finished, using
from codegen.solving import loading
from codegen.solving.request import with_values
from codegen.solving.results import output
from codegen.solving.results.display import Background
from codegen.solving.results.output import with_unit
from codegen.solving.results.result import Result

_LEFT = 'style="text-align:left"'


def table(rows: Iterable[Sequence[str]], headings: Sequence[str] = (), caption: str = "") -> str:
    """A table of texts, which are escaped, with the first column as heading of each row."""
    head = "".join(f'<th scope="col" {_LEFT}>{escape(text)}</th>' for text in headings)
    lines = [f"<caption {_LEFT}>{escape(caption)}</caption>"] if caption else []
    lines += [f"<thead><tr>{head}</tr></thead>"] if headings else []
    for first, *others in rows:
        cells = "".join(f"<td {_LEFT}>{escape(text)}</td>" for text in others)
        lines.append(f'<tr><th scope="row" {_LEFT}>{escape(first)}</th>{cells}</tr>')
    return f"<table>{''.join(lines)}</table>"


def number(value: float | None, digits: int = 6) -> str:
    """A number as text, or that there is none."""
    return "not available" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


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
    return Picture(films.figure_of(module, _model(own), result, unit, style), style)


def film(result: Result) -> Film:
    """The film of its problem's drawing."""
    own = _background(result)
    model = _model(own)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.gif"
        films.save_film(model, result, path)
        return Film(path.read_bytes(), result.title, lambda file: films.save_film(model, result, file))


def _background(result: Result) -> Background:
    if result.background is None:
        raise ArgumentError(f"{result.problem}: this solution does not know its module", "solve by codegen.solve")
    return result.background


def _model(own: Background) -> Any:
    return None if own.source is None else load_problem(own.source, own.arguments)


def _unit(own: Background) -> str:
    return "" if isinstance(own.source, ProblemObject) else films.unit_of(own.source)


def loop_html(loop: Any) -> str:
    """How the sampling times ended, how long they took, and the figure."""
    ended = ", ".join(f"{count} {status}" for status, count in loop.counts.items())
    times = f"median {number(1e3 * loop.latency(50), 3)} ms, 99.9 % below {number(1e3 * loop.latency(99.9), 3)} ms"
    rows = [
        ("sampling times", f"{loop.latencies.size}, every {number(loop.sample)}"),
        ("status", ended or "none"),
        *([("ended early", loop.message)] if loop.message else []),
        ("fell back", str(int(loop.fell_back.sum()))),
        ("latency", times),
        *([("deadlines missed", str(loop.missed))] if loop.deadline is not None else []),
    ]
    own = table(rows, caption=loop.title)
    return own + loop_picture(loop, {})._repr_html_() if loop.latencies.size else own


def loop_picture(loop: Any, references: References) -> Picture:
    """The figure of states, inputs and latencies, with what they were to follow."""
    with using("page"):
        return Picture(finished(closed_loop_figure(loop, references)))
