"""The display of problems, solutions, closed loops and findings in notebooks.

A problem is shown as LaTeX in the author's form, before anything is derived or checked. Results are shown as HTML
tables with a figure, without scripts.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import sympy
from sympy.logic.boolalg import Boolean
from sympy.printing.latex import LatexPrinter

from codegen.discretise.conditions import CONDITIONS, SIMULATED
from codegen.discretise.conditions.base import listed
from codegen.discretise.model.from_problem import load_problem
from codegen.errors import ArgumentError, CodegenError
from codegen.identifiers import in_latex, written_unit
from codegen.problem.description import quantities_in
from codegen.problem.particles import Connect, Pairwise
from codegen.problem.problem import Control, Event, Phases, Problem, Simulate
from codegen.problem.sources import ProblemFile
from codegen.problem.symbols import Coordinate, Delayed, FreeParameter, Moving, Parameter, Quantity, Velocity
from codegen.solving.results import output
from codegen.solving.results.display import Background
from codegen.solving.results.output import with_unit
from codegen.solving.results.result import Result

if TYPE_CHECKING:
    from codegen.discretise.model.definitions import Model
    from codegen.discretise.model.pairwise import PairwiseModel
    from codegen.show.figures.picture import Film, Picture
    from codegen.show.figures.simulation import References


class Printer(LatexPrinter):  # type: ignore[misc]  # sympy is untyped
    """A LaTeX printer for the expressions of a problem; `first` and `last` are the names of the first and last time.

    A velocity named d<coordinate> has a dot. If some names are words, factors are separated by a space.
    """

    def __init__(self, quantities: list[Quantity], first: str, last: str) -> None:
        has_words = any(_name(symbol).startswith(r"\mathrm") for symbol in quantities)
        super().__init__({"mul_symbol": r" \, "} if has_words else None)
        self.first, self.last = first, last

    def __call__(self, value: object) -> str:
        """Return the LaTeX of an expression, or the name of its type for other objects."""
        try:
            return str(self.doprint(sympy.sympify(value)))
        except (sympy.SympifyError, TypeError, ValueError, AttributeError):
            return rf"\text{{{type(value).__name__}}}"

    def relation(self, value: object) -> str:
        """Return the LaTeX of a relation; any other expression is equated to zero."""
        return self(value) if isinstance(value, Boolean) and not isinstance(value, Quantity) else f"{self(value)} = 0"

    def at(self, value: object, time: str) -> str:
        """Return the LaTeX of a quantity or expression at the time with the given name."""
        return f"{self(value)}({time})" if isinstance(value, Quantity) else f"[{self(value)}]({time})"

    def between(self, written: str, limits: Sequence[object]) -> str:
        """Return a text of LaTeX between the lower and upper limits; a limit may be None."""
        low, high = limits
        lower = rf"{self(low)} \le " if low is not None else ""
        upper = rf" \le {self(high)}" if high is not None else ""
        return f"{lower}{written}{upper}"

    def rate(self, state: object) -> str:
        """Return the LaTeX of the time derivative of a state."""
        return rf"\dot{{{self(state)}}}"

    def _print_Symbol(self, expr: sympy.Symbol, style: str = "plain") -> str:
        if isinstance(expr, Delayed):
            return rf"{_name(expr.partner)}\left(t - {self._print(expr.lag)}\right)"
        return _name(expr)


def _name(symbol: sympy.Symbol) -> str:
    if isinstance(symbol, Velocity) and symbol.name == f"d{symbol.partner.name}":
        return rf"\dot{{{_name(symbol.partner)}}}"
    return in_latex(symbol.name)


_IN_A_ROW = 4  # number of quantities in a row of the list of units


def latex(problem: Problem | Phases) -> str:
    """Return a problem as aligned rows of LaTeX, phase by phase; unprintable objects are shown by their type."""
    quantities = quantities_in(problem)
    if not isinstance(problem, Phases):
        # Time ends at the symbol of the duration, else at T, or t_f if T is taken.
        duration, is_taken = problem.duration, any(symbol.name == "T" for symbol in quantities)
        last = in_latex(duration.name) if isinstance(duration, Quantity) else r"t_\mathrm{f}" if is_taken else "T"
        free = [symbol for symbol in quantities if isinstance(symbol, FreeParameter)]
        return _aligned(_rows(problem, Printer(quantities, "0", last), 0, free, quantities))
    blocks, printers, before = list[str](), list[Printer](), set[Quantity]()
    for number, phase in enumerate(problem.phases, start=1):  # time continues from phase to phase
        printer = Printer(quantities, f"t_{{{number - 1}}}" if number > 1 else "0", f"t_{{{number}}}")
        own = quantities_in(phase)
        free = [symbol for symbol in own if isinstance(symbol, FreeParameter) and symbol not in before]
        aligned = _aligned(_rows(phase, printer, number, free, quantities))
        blocks.append(rf"\text{{Phase {number}:}}\quad {aligned}\\[1ex]")
        printers.append(printer)
        before |= set(own)
    jumps = [
        rf"&{print_(symbol)} \mapsto {print_(value)}\quad\text{{at }} t = {print_.last}"
        for print_, jump in zip(printers, problem.jumps, strict=False)
        for symbol, value in jump.items()
    ]
    return "\n".join([*blocks, *([rf"\text{{Jumps:}}\quad {_aligned(jumps)}\\[1ex]"] if jumps else [])])


def displayed(problem: Problem | Phases) -> str:
    """Return the LaTeX of a problem between $$ signs, for notebooks."""
    body = latex(problem)
    return "$$" + (rf"\begin{{array}}{{l}}{body}\end{{array}}" if isinstance(problem, Phases) else body) + "$$"


def _aligned(rows: Iterator[str] | Sequence[str]) -> str:
    return r"\begin{aligned}" + r" \\ ".join(rows) + r"\end{aligned}"


def _rows(
    problem: Problem, print_: Printer, number: int, free: Sequence[FreeParameter], quantities: Sequence[Quantity]
) -> Iterator[str]:
    """Yield the rows of a problem (`number` 0) or of phase 1, 2, ... (`number`), without line ends.

    `free` are the free parameters that no earlier phase has; `quantities` are the quantities of all phases.
    """
    if isinstance(problem, Control):

        def is_zero(value: object) -> bool:
            return isinstance(value, (int, float)) and value == 0

        is_maximised = not (is_zero(problem.maximise) and is_zero(problem.terminal_maximise))
        rate = problem.maximise if is_maximised else problem.cost
        last = problem.terminal_maximise if is_maximised else problem.terminal_cost
        terms = [] if is_zero(rate) else [rf"\int_{{{print_.first}}}^{{{print_.last}}} \left({print_(rate)}\right) dt"]
        if not is_zero(last):
            moves = not isinstance(last, sympy.Expr) or any(isinstance(symbol, Moving) for symbol in last.free_symbols)
            at_end = rf"\left.\left({print_(last)}\right)\right|_{{t = {print_.last}}}"
            terms.append(at_end if moves else print_(last))
        terms += [term for kind in CONDITIONS for term in kind.costs(problem, print_)]
        if terms:
            yield (r"\text{maximise}\quad &" if is_maximised else r"\text{minimise}\quad &") + " + ".join(terms)
        elif not number:
            yield r"&\text{find a motion}"
    elif isinstance(problem, Connect):
        yield r"&\text{connect particles that start at given points with their targets}"
    else:
        yield r"&\text{follow the motion}"
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
    duration = print_(problem.duration)
    if duration != print_.last:
        yield f"{print_.last} &= " + (f"{print_.first} + {duration}" if number > 1 else duration)
    if getattr(problem, "bodies", 1) != 1:
        yield rf"&\text{{for each of }} {print_(problem.bodies)} \text{{ bodies}}"  # type: ignore[attr-defined]
    for mapping, time in ((problem.start, print_.first), (getattr(problem, "end", {}), print_.last)):
        yield from (f"{print_.at(key, time)} &= {print_(value)}" for key, value in _items(mapping))
    if isinstance(problem, Simulate):
        yield from (row for kind in SIMULATED for row in kind.displayed(problem, print_))
        yield from (rf"&{print_.relation(gap)}\quad\text{{(gap)}}" for gap in listed(problem.unilateral))
        for _, event in _items(problem.events):
            yield rf"0 &= {print_(event.expression if isinstance(event, Event) else event)}\quad\text{{(event)}}"
    if isinstance(problem, Control):
        for symbol, value in _items(problem.history):
            yield rf"{print_.at(symbol, 't')} &= {print_(value)}\quad\text{{for }} t \le 0"
        yield from (row for kind in CONDITIONS for row in kind.displayed(problem, print_))
        bounds = dict(_items(problem.bounds))
        for symbol in free:
            low, high = bounds.pop(symbol, (symbol.lower, symbol.upper))
            # A duration is not negative.
            low = 0 if low is None and symbol == problem.duration and not problem.periodic else low
            yield rf"&{print_.between(print_(symbol), (low, high))}\quad\text{{(free)}}"
        yield from (f"&{print_.between(print_(symbol), pair)}" for symbol, pair in bounds.items())
    if number <= 1:
        # Quantities with units: parameters with their values, others with the unit in brackets.
        units = []
        for symbol in quantities:
            if hasattr(symbol, "unit"):
                unit = rf"\text{{{written_unit(symbol.unit) or '1'}}}"
                is_parameter = isinstance(symbol, Parameter)
                units.append(print_(symbol) + (rf" = {symbol.value:g}\,{unit}" if is_parameter else rf"\;[{unit}]"))
        for first in range(0, len(units), _IN_A_ROW):
            yield (r"\text{units}\quad &" if first == 0 else "&") + r",\quad ".join(units[first : first + _IN_A_ROW])


def _items(mapping: object) -> Sequence[tuple[Any, Any]]:
    return list(mapping.items()) if isinstance(mapping, Mapping) else []


_LEFT = 'style="text-align:left"'


def table(rows: Iterable[Sequence[str]], headings: Sequence[str] = (), caption: str = "") -> str:
    """Return rows of texts as an HTML table; texts are escaped, and the first column has row headings."""
    head = "".join(f'<th scope="col" {_LEFT}>{escape(text)}</th>' for text in headings)
    lines = [f"<caption {_LEFT}>{escape(caption)}</caption>"] if caption else []
    lines += [f"<thead><tr>{head}</tr></thead>"] if headings else []
    for first, *others in rows:
        cells = "".join(f"<td {_LEFT}>{escape(text)}</td>" for text in others)
        lines.append(f'<tr><th scope="row" {_LEFT}>{escape(first)}</th>{cells}</tr>')
    return f"<table>{''.join(lines)}</table>"


def number(value: float | None, digits: int = 6) -> str:
    """Return a number as text, or "not available" for None, NaN and infinity."""
    return "not available" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def html(result: Result) -> str:
    """Return the outcome of a solve as an HTML table, with its figure if the figure can be drawn."""
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
    summary = table(rows, caption=result.title)
    try:
        return summary + picture(result)._repr_html_()
    except CodegenError:  # `plot` gives the reason
        return summary


def picture(result: Result, style: str = "page", panels: Sequence[str] | None = None) -> Picture:
    """Return the figure of a solution; raises ArgumentError for an unknown style."""
    from codegen.show import films
    from codegen.show.figures.picture import Picture

    background = _background(result)
    module = background.loaded(result.parameters)
    unit = films.unit_of(background.source) if isinstance(background.source, ProblemFile) else ""
    return Picture(films.figure_of(module, _model(background), result, unit, style, panels), style)


def film(result: Result) -> Film:
    """Return the film of the drawing of a solution."""
    from codegen.show import films
    from codegen.show.figures.picture import Film

    model = _model(_background(result))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "film.gif"
        films.save_film(model, result, path)
        return Film(path.read_bytes(), result.title, lambda file: films.save_film(model, result, file))


def _background(result: Result) -> Background:
    if result.background is None:
        raise ArgumentError(f"{result.problem}: this solution does not know its module", "solve by codegen.solve")
    return result.background


def _model(background: Background) -> Model | PairwiseModel | None:
    return None if background.source is None else load_problem(background.source, background.arguments)


def loop_html(loop: Any) -> str:
    """Return the outcome of a closed loop as an HTML table, with its figure."""
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
    summary = table(rows, caption=loop.title)
    return summary + loop_picture(loop, {})._repr_html_() if loop.latencies.size else summary


def loop_picture(loop: Any, references: References) -> Picture:
    """Return the figure of a closed loop: states and inputs with references, and latencies."""
    from codegen.show.figures.picture import Picture, finished, using
    from codegen.show.figures.simulation import closed_loop_figure

    with using("page"):
        return Picture(finished(closed_loop_figure(loop, references)))
