"""Conditions that tie bodies together -> a few kernels, one for each kind of term, and tables of their instances.

A condition is a sum of terms. Terms that differ only in the shared unknowns that they read, such as the squared
differences in the sides of a polygon, are instances of one kind; code does not grow with the number of bodies.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Add, Expr, Symbol

from codegen.lower.control_layout import integers, parameters
from codegen.lower.kernels import INNER, Kernel, Line, Output, kernel
from codegen.transcribe.program import ControlProgram


@dataclass(frozen=True)
class Couplings:
    """Kernels (value, slopes, curvatures of a kind of term) and the tables that say where terms occur."""

    kernels: tuple[Kernel, ...]
    constants: tuple[Line, ...]


@dataclass(frozen=True)
class _Instance:
    """One term: its kind, its row, and the places of the shared unknowns that it reads."""

    kind: int
    row: int
    places: tuple[int, ...]


def lower_couplings(program: ControlProgram) -> Couplings:
    """Find the kinds of terms, and write them and the tables of their instances."""
    if not program.couplings:
        return Couplings((), ())
    places = _places(program)
    kinds: list[Expr] = []
    instances = []
    for row, coupling in enumerate(program.couplings):
        for term in Add.make_args(coupling.expression):
            read = sorted(term.free_symbols & places.keys(), key=lambda s: places[s])
            general = term.xreplace(dict(zip(read, _arguments(len(read)), strict=True)))
            if general not in kinds:
                kinds.append(general)
            instances.append(_Instance(kinds.index(general), row, tuple(places[s] for s in read)))
    kernels = tuple(_kernel(program, i, kind) for i, kind in enumerate(kinds))
    return Couplings(kernels, tuple(_tables(instances)))


def _places(program: ControlProgram) -> dict[Symbol, int]:
    """Place of every shared unknown, of every body and of the whole problem, among those that no node owns."""
    places = {symbol: body * program.own + j for symbol, body, j in program.coupling_symbols}
    first = program.bodies * program.own
    return places | {symbol: first + j for j, symbol in enumerate(program.shared_symbols[program.own :])}


def _arguments(count: int) -> tuple[Symbol, ...]:
    return tuple(Symbol(f"a{i}", real=True) for i in range(count))


def _kernel(program: ControlProgram, number: int, term: Expr) -> Kernel:
    read = [symbol for symbol in _arguments(_count(term)) if symbol in term.free_symbols]
    places = {symbol: f"values[{i}]" for i, symbol in enumerate(read)}
    places |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(parameters(program))}
    slopes = [Output(f"slopes[{i}]", sympy.diff(term, a), f"by {a}") for i, a in enumerate(read)]
    curvatures = [
        Output(f"curvatures[{i * len(read) + j}]", sympy.diff(term, a, b), f"by {a} and {b}")
        for i, a in enumerate(read)
        for j, b in enumerate(read)
    ]
    summary = f"{sympy.sstr(term)}, with its first and second derivatives."
    arguments = ("values", "parameters", "slopes", "curvatures")
    return kernel(f"coupling_{number}", summary, arguments, places, [*slopes, *curvatures], term, decorators=INNER)


def _count(term: Expr) -> int:
    """How many arguments a general term has at most: they are called a0, a1, ..."""
    names = [s.name for s in term.free_symbols]
    return sum(f"a{i}" in names for i in range(len(names)))


def _tables(instances: Sequence[_Instance]) -> list[Line]:
    width = max(1, *(len(instance.places) for instance in instances))
    rows = [[*instance.places, *[0] * (width - len(instance.places))] for instance in instances]
    return [
        Line("COUPLING_KINDS", integers([i.kind for i in instances]), "kind of every term of the conditions"),
        Line("COUPLING_ROWS", integers([i.row for i in instances]), "condition to which it belongs"),
        Line("COUPLING_COUNTS", integers([len(i.places) for i in instances]), "how many shared unknowns it reads"),
        Line("COUPLING_PLACES", f"np.array({rows}, dtype=np.int64)", "and which"),
    ]
