"""An author's problem as mathematics in LaTeX, as it is written and before anything is derived or checked.

Solutions, closed loops and findings of checks in a notebook: tables in HTML that need no script, and figures.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

import sympy
from sympy.logic.boolalg import Boolean
from sympy.printing.latex import LatexPrinter

from codegen.discretise.conditions import CONDITIONS
from codegen.discretise.model.from_file import load_problem
from codegen.errors import ArgumentError, CodegenError
from codegen.problem.description import quantities_in
from codegen.problem.particles import Connect, Pairwise
from codegen.problem.problem import Control, Phases, Problem
from codegen.problem.quantities import Delayed, Moving, Parameter, Quantity
from codegen.problem.sources import ProblemObject
from codegen.problem.symbols import Coordinate, FreeParameter, Velocity
from codegen.show import films
from codegen.show.figures.picture import Film, Picture, finished, using
from codegen.show.figures.simulation import References, closed_loop_figure
from codegen.solving import loading
from codegen.solving.request import with_values
from codegen.solving.results import output
from codegen.solving.results.display import Background
from codegen.solving.results.output import with_unit
from codegen.solving.results.result import Result
from codegen.symbolic import latex as lettering
from codegen.symbolic.latex import in_latex, written_unit


class Printer(LatexPrinter):  # type: ignore[misc]  # sympy is untyped
    """LaTeX of what stands in a problem with these quantities, between two ends of time that are called so.

    A velocity of its coordinate's name has a dot.

    Where a name is a word, factors stand apart.
    """

    def __init__(self, quantities: list[Quantity], first: str, last: str) -> None:
        has_words = any(_name(symbol).startswith(r"\mathrm") for symbol in quantities)
        super().__init__({"mul_symbol": r" \, "} if has_words else None)
        self.first, self.last = first, last

    def __call__(self, value: Any) -> str:
        """What an author gave as an expression, or the name of its type where that is no mathematics."""
        try:
            return str(self.doprint(sympy.sympify(value)))
        except (sympy.SympifyError, TypeError, ValueError, AttributeError):
            return rf"\text{{{type(value).__name__}}}"

    def relation(self, value: Any) -> str:
        """A relation, or an expression that is to vanish, as a symbol alone may be."""
        return self(value) if isinstance(value, Boolean) and not isinstance(value, Quantity) else f"{self(value)} = 0"

    def at(self, value: Any, time: str) -> str:
        """A quantity, or an expression of them, at a time."""
        return f"{self(value)}({time})" if isinstance(value, Quantity) else f"[{self(value)}]({time})"

    def between(self, written: str, limits: Sequence[Any]) -> str:
        """Something that is written so between a lower and an upper limit, each of which may be None."""
        low, high = limits
        lower = rf"{self(low)} \le " if low is not None else ""
        upper = rf" \le {self(high)}" if high is not None else ""
        return f"{lower}{written}{upper}"

    def rate(self, state: Any) -> str:
        """The derivative of a state by time."""
        return rf"\dot{{{self(state)}}}"

    def _print_Symbol(self, expr: sympy.Symbol, style: str = "plain") -> str:
        if isinstance(expr, Delayed):
            return rf"{_name(expr.partner)}\left(t - {self._print(expr.lag)}\right)"
        return _name(expr)


def _name(symbol: sympy.Symbol) -> str:
    if isinstance(symbol, Velocity) and symbol.name == f"d{symbol.partner.name}":
        return rf"\dot{{{_name(symbol.partner)}}}"
    return lettering.in_latex(symbol.name)


_IN_A_ROW = 4
"""Quantities with units that stand side by side."""


def latex(problem: Problem | Phases) -> str:
    """The problem as aligned rows, phase by phase; what cannot be printed stands as it is, since nothing is checked."""
    if not isinstance(problem, Phases):
        return _aligned(_rows(_Part.alone(problem)))
    parts = [_Part.phase(problem, number) for number in range(1, len(problem.phases) + 1)]
    blocks = [rf"\text{{Phase {part.number}:}}\quad {_aligned(_rows(part))}\\[1ex]" for part in parts]
    written = [row for part, jump in zip(parts, problem.jumps, strict=False) for row in _jump(part, jump)]
    return "\n".join([*blocks, *([rf"\text{{Jumps:}}\quad {_aligned(written)}\\[1ex]"] if written else [])])


def displayed(problem: Problem | Phases) -> str:
    """The same between the signs by which notebooks know mathematics."""
    body = latex(problem)
    return "$$" + (rf"\begin{{array}}{{l}}{body}\end{{array}}" if isinstance(problem, Phases) else body) + "$$"


def _aligned(rows: Iterator[str] | Sequence[str]) -> str:
    return r"\begin{aligned}" + r" \\ ".join(rows) + r"\end{aligned}"


@dataclass(frozen=True)
class _Part:
    """A problem, or one of several phases, and what writes it; alone its number is 0.

    Of free parameters those are its `own` that no earlier phase has; `quantities` are those of the whole problem.
    """

    problem: Problem
    print_: Printer
    own: tuple[FreeParameter, ...]
    number: int = 0
    quantities: tuple[Quantity, ...] = ()

    @classmethod
    def alone(cls, problem: Problem) -> _Part:
        """Time ends at the duration, where that is one symbol, else at T, or t_f where T is another quantity."""
        quantities, duration = quantities_in(problem), problem.duration
        is_taken = any(symbol.name == "T" for symbol in quantities)
        last = in_latex(duration.name) if isinstance(duration, Quantity) else r"t_\mathrm{f}" if is_taken else "T"
        printer = Printer(quantities, "0", last)
        return cls(problem, printer, _free(quantities), quantities=tuple(quantities))

    @classmethod
    def phase(cls, problem: Phases, number: int) -> _Part:
        """Time goes on from phase to phase."""
        earlier, phase = problem.phases[: number - 1], problem.phases[number - 1]
        known = {symbol for part in earlier for symbol in _free(quantities_in(part))}
        own = tuple(symbol for symbol in _free(quantities_in(phase)) if symbol not in known)
        first = f"t_{{{number - 1}}}" if number > 1 else "0"
        whole = quantities_in(problem)
        return cls(phase, Printer(whole, first, f"t_{{{number}}}"), own, number, tuple(whole))


def _free(quantities: Sequence[Quantity]) -> tuple[FreeParameter, ...]:
    return tuple(symbol for symbol in quantities if isinstance(symbol, FreeParameter))


def _rows(part: _Part) -> Iterator[str]:
    problem, print_ = part.problem, part.print_
    if isinstance(problem, Control):
        yield from _objective(problem, part)
    elif isinstance(problem, Connect):
        yield r"&\text{connect particles that start at given points with their targets}"
    else:
        yield r"&\text{follow the motion}"
    yield from _motion(problem, print_)
    yield from _time(part)
    for mapping, time in ((problem.start, print_.first), (getattr(problem, "end", {}), print_.last)):
        if isinstance(mapping, Mapping):
            yield from (f"{print_.at(key, time)} &= {print_(value)}" for key, value in mapping.items())
    if isinstance(problem, Control):
        yield from _history(problem, print_)
        yield from (row for kind in CONDITIONS for row in kind.displayed(problem, print_))
        yield from _bounds(problem, part)
    if part.number <= 1:
        # What has a unit, in a row: parameters with their values, others in brackets.
        written = []
        for symbol in part.quantities:
            if hasattr(symbol, "unit"):
                unit = rf"\text{{{written_unit(symbol.unit) or '1'}}}"
                given = rf" = {symbol.value:g}\," if isinstance(symbol, Parameter) else r"\;"
                written.append(part.print_(symbol) + given + (unit if isinstance(symbol, Parameter) else f"[{unit}]"))
        for first in range(0, len(written), _IN_A_ROW):
            yield (r"\text{units}\quad &" if first == 0 else "&") + r",\quad ".join(written[first : first + _IN_A_ROW])


def _objective(problem: Control, part: _Part) -> Iterator[str]:
    print_ = part.print_
    is_greatest = _is_given(problem.maximise) or _is_given(problem.terminal_maximise)
    rate = problem.maximise if is_greatest else problem.cost
    last = problem.terminal_maximise if is_greatest else problem.terminal_cost
    terms = [rf"\int_{{{print_.first}}}^{{{print_.last}}} \left({print_(rate)}\right) dt"] if _is_given(rate) else []
    if _is_given(last):
        moves = not isinstance(last, sympy.Expr) or any(isinstance(symbol, Moving) for symbol in last.free_symbols)
        terms += [rf"\left.\left({print_(last)}\right)\right|_{{t = {print_.last}}}" if moves else print_(last)]
    terms += [term for kind in CONDITIONS for term in kind.costs(problem, print_)]
    if terms:
        yield (r"\text{maximise}\quad &" if is_greatest else r"\text{minimise}\quad &") + " + ".join(terms)
    elif not part.number:
        yield r"&\text{find a motion}"


def _is_given(value: Any) -> bool:
    return not (isinstance(value, (int, float)) and value == 0)


def _motion(problem: Problem, print_: Printer) -> Iterator[str]:
    if problem.lagrangian is not None:
        yield f"L &= {print_(problem.lagrangian)}"
    if isinstance(problem.hamiltonian, Pairwise):
        yield rf"H &= \sum_i h(z_i) + \sum_{{i<j}} {print_(problem.hamiltonian.term_of_pair)}"
    elif problem.hamiltonian is not None:
        yield f"H &= {print_(problem.hamiltonian)}"
    if isinstance(problem.dynamics, Mapping):
        yield from (f"{print_.rate(state)} &= {print_(rate)}" for state, rate in problem.dynamics.items())
    if isinstance(problem.force, Mapping):
        named = [print_(key) if isinstance(key, Coordinate) else "q" for key in problem.force]
        values = [print_(value) for value in problem.force.values()]
        letter = "Q" if any(f"f_{{{name}}}" in value for name in named for value in values) else "f"
        yield from (f"{letter}_{{{name}}} &= {value}" for name, value in zip(named, values, strict=True))


def _time(part: _Part) -> Iterator[str]:
    """The end of time, where it has another name than the duration; a number of bodies."""
    print_ = part.print_
    duration = print_(part.problem.duration)
    if duration != print_.last:
        yield f"{print_.last} &= " + (f"{print_.first} + {duration}" if part.number > 1 else duration)
    if getattr(part.problem, "bodies", 1) != 1:
        yield rf"&\text{{for each of }} {print_(part.problem.bodies)} \text{{ bodies}}"  # type: ignore[attr-defined]


def _history(problem: Control, print_: Printer) -> Iterator[str]:
    for symbol, value in _items(problem.history):
        yield rf"{print_.at(symbol, 't')} &= {print_(value)}\quad\text{{for }} t \le 0"


def _bounds(problem: Control, part: _Part) -> Iterator[str]:
    """Bounds of what moves and of free parameters; a duration is not negative."""
    given, print_ = dict(_items(problem.bounds)), part.print_
    for symbol in part.own:
        low, high = given.pop(symbol, (symbol.lower, symbol.upper))
        low = 0 if low is None and symbol == problem.duration and not problem.periodic else low
        yield rf"&{print_.between(print_(symbol), (low, high))}\quad\text{{(free)}}"
    yield from (f"&{print_.between(print_(symbol), pair)}" for symbol, pair in given.items())


def _jump(part: _Part, jump: Mapping[Any, Any]) -> Iterator[str]:
    """Values after a switch in terms of those before it."""
    print_ = part.print_
    for symbol, value in jump.items():
        yield rf"&{print_(symbol)} \mapsto {print_(value)}\quad\text{{at }} t = {print_.last}"


def _items(given: Any) -> Sequence[tuple[Any, Any]]:
    return list(given.items()) if isinstance(given, Mapping) else []


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
