"""Conditions that tie bodies together -> a few kernels, one for each kind of term, and tables of their instances.

Code does not grow with the number of bodies (see `codegen.expressions.terms`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy import Symbol

from codegen.expressions.terms import Instance, Kind, sorted_terms
from codegen.lower.control.layout import integers, parameters
from codegen.lower.kernels import INNER, Kernel, Line, Output, kernel
from codegen.transcribe.program import ControlProgram


@dataclass(frozen=True)
class Couplings:
    """Kernels (value, slopes, curvatures of a kind of term) and the tables that say where terms occur."""

    kernels: tuple[Kernel, ...]
    constants: tuple[Line, ...]


def lower_couplings(program: ControlProgram) -> Couplings:
    """Find the kinds of terms, and write them and the tables of their instances."""
    if not program.couplings:
        return Couplings((), ())
    kinds, instances = sorted_terms([c.expression for c in program.couplings], _indices(program))
    kernels = tuple(_kernel(program, i, kind) for i, kind in enumerate(kinds))
    return Couplings(kernels, tuple(_tables(instances)))


def term_kinds(program: ControlProgram) -> tuple[Kind, ...]:
    """The kinds of terms in the conditions."""
    return sorted_terms([c.expression for c in program.couplings], _indices(program))[0] if program.couplings else ()


def _indices(program: ControlProgram) -> dict[Symbol, int]:
    """Index of every shared unknown, of every body and of the whole problem, among those that no node owns."""
    indices = {symbol: body * program.own + j for symbol, body, j in program.coupling_symbols}
    first = program.bodies * program.own
    return indices | {symbol: first + j for j, symbol in enumerate(program.shared_symbols[program.own :])}


def _kernel(program: ControlProgram, number: int, kind: Kind) -> Kernel:
    term, read = kind.expression, kind.arguments
    codes = {symbol: f"values[{i}]" for i, symbol in enumerate(read)}
    codes |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(parameters(program))}
    slopes = [Output(f"slopes[{i}]", sympy.diff(term, a), f"by {a}") for i, a in enumerate(read)]
    curvatures = [
        Output(f"curvatures[{i * len(read) + j}]", sympy.diff(term, a, b), f"by {a} and {b}")
        for i, a in enumerate(read)
        for j, b in enumerate(read)
    ]
    detail = "with its first and second derivatives" if read else "which depends on no unknown"
    summary = f"{sympy.sstr(term)}, {detail}."
    arguments = ("values", "parameters", "slopes", "curvatures")
    return kernel(f"coupling_{number}", summary, arguments, codes, [*slopes, *curvatures], term, decorators=INNER)


def _tables(instances: Sequence[Instance]) -> list[Line]:
    width = max(1, *(len(instance.indices) for instance in instances))
    rows = [[*instance.indices, *[0] * (width - len(instance.indices))] for instance in instances]
    return [
        Line("COUPLING_KINDS", integers([i.kind for i in instances]), "kind of every term of the conditions"),
        Line("COUPLING_ROWS", integers([i.row for i in instances]), "condition to which it belongs"),
        Line("COUPLING_COUNTS", integers([len(i.indices) for i in instances]), "how many shared unknowns it reads"),
        Line("COUPLING_INDICES", f"np.array({rows}, dtype=np.int64)", "and which"),
    ]
