"""An author's problem as mathematics in LaTeX, as it is written and before anything is derived or checked."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import sympy

from codegen.author.description import quantities_in
from codegen.author.particles import Connect, Pairwise
from codegen.author.problem import Control, Phases, Problem
from codegen.author.symbols import Coordinate, Velocity

_RATES = r"\frac{d}{dt} "


def latex(problem: Problem | Phases) -> str:
    """The problem as aligned rows, phase by phase; what cannot be printed stands as it is, since nothing is checked."""
    if isinstance(problem, Phases):
        parts = [_aligned(part) for part in problem.phases]
        return "\n".join(rf"\text{{Phase {number}:}}\quad {part}\\[1ex]" for number, part in enumerate(parts, start=1))
    return _aligned(problem)


def displayed(problem: Problem | Phases) -> str:
    """The same between the signs by which notebooks know mathematics."""
    body = latex(problem)
    return "$$" + (rf"\begin{{array}}{{l}}{body}\end{{array}}" if isinstance(problem, Phases) else body) + "$$"


def _aligned(problem: Problem) -> str:
    print_ = _Printer(problem)
    return r"\begin{aligned}" + r" \\ ".join(_rows(problem, print_)) + r"\end{aligned}"


class _Printer:
    """LaTeX of expressions, with a dot for the velocity of a coordinate that is called by its name."""

    def __init__(self, problem: Problem) -> None:
        velocities = [symbol for symbol in quantities_in(problem) if isinstance(symbol, Velocity)]
        self.names = {v: rf"\dot{{{sympy.latex(v.partner)}}}" for v in velocities if v.name == f"d{v.partner.name}"}

    def __call__(self, value: Any) -> str:
        try:
            return str(sympy.latex(sympy.sympify(value), symbol_names=self.names))
        except (sympy.SympifyError, TypeError, ValueError, AttributeError):
            return rf"\text{{{type(value).__name__}}}"


def _rows(problem: Problem, print_: _Printer) -> Iterator[str]:
    if isinstance(problem, Control):
        yield from _objective(problem, print_)
    elif isinstance(problem, Connect):
        yield r"&\text{connect particles that start at given points with their targets}"
    else:
        yield r"&\text{follow the motion}"
    yield from _motion(problem, print_)
    yield f"T &= {print_(problem.duration)}"
    for mapping, mark in ((problem.start, "0"), (getattr(problem, "end", {}), "T")):
        if isinstance(mapping, Mapping):
            yield from (f"{print_(key)}({mark}) &= {print_(value)}" for key, value in mapping.items())
    if isinstance(problem, Control):
        yield from _conditions(problem, print_)


def _objective(problem: Control, print_: _Printer) -> Iterator[str]:
    is_greatest = _is_given(problem.maximise) or _is_given(problem.terminal_maximise)
    rate = problem.maximise if is_greatest else problem.cost
    last = problem.terminal_maximise if is_greatest else problem.terminal_cost
    terms = [rf"\int_0^T \left({print_(rate)}\right) dt"] if _is_given(rate) else []
    terms += [rf"\left.\left({print_(last)}\right)\right|_{{t = T}}"] if _is_given(last) else []
    yield (r"\text{maximise}\quad &" if is_greatest else r"\text{minimise}\quad &") + (" + ".join(terms) or "0")


def _is_given(value: Any) -> bool:
    return not (isinstance(value, (int, float)) and value == 0)


def _motion(problem: Problem, print_: _Printer) -> Iterator[str]:
    if problem.lagrangian is not None:
        yield f"L &= {print_(problem.lagrangian)}"
    if isinstance(problem.hamiltonian, Pairwise):
        yield rf"H &= \sum_i h(z_i) + \sum_{{i<j}} {print_(problem.hamiltonian.term_of_pair)}"
    elif problem.hamiltonian is not None:
        yield f"H &= {print_(problem.hamiltonian)}"
    if isinstance(problem.dynamics, Mapping):
        for state, rate in problem.dynamics.items():
            yield rf"\dot{{{print_(state)}}} &= {print_(rate)}"
    if isinstance(problem.force, Mapping):
        for coordinate, value in problem.force.items():
            of = coordinate if isinstance(coordinate, Coordinate) else sympy.Symbol("q")
            yield f"f_{{{print_(of)}}} &= {print_(value)}"


def _conditions(problem: Control, print_: _Printer) -> Iterator[str]:
    for given, where in (
        (problem.start_conditions, r"\quad\text{at } t = 0"),
        (problem.end_conditions, r"\quad\text{at } t = T"),
        (problem.path, r"\quad\text{at every time}"),
        (problem.integral, r"\quad\text{for the integral over } [0, T]"),
    ):
        listed = given.values() if isinstance(given, Mapping) else given
        yield from (f"&{print_(relation)}{where}" for relation in listed)
    for relation in problem.constraint:
        yield rf"0 &= {print_(relation)}\quad\text{{(holonomic)}}"
    if isinstance(problem.bounds, Mapping):
        for symbol, (low, high) in problem.bounds.items():
            lower = rf"{print_(low)} \le " if low is not None else ""
            upper = rf" \le {print_(high)}" if high is not None else ""
            yield f"&{lower}{print_(symbol)}{upper}"
    for time, relations in problem.at.items() if isinstance(problem.at, Mapping) else ():
        listed = relations.values() if isinstance(relations, Mapping) else relations
        yield from (rf"&{print_(relation)}\quad\text{{at }} t = {print_(time)}" for relation in listed)
