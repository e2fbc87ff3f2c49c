"""Points where a problem is solved: near the guess of its module, with its boundary values and default parameters.

Away from there an exponential atmosphere, a reaction rate or a Gaussian may be flat, and a check would be blind.
"""

from __future__ import annotations

from sympy import Symbol

from codegen.checks.base import Context
from codegen.lower.control.layout import parameters
from codegen.transcribe.program import ControlProgram
from codegen.verify.control import part_of_chain
from codegen.verify.points import Values, with_time

_PREFERRED = (5, 2, 10, 7, 3, 6, 1, 0)
"""The order in which points of three places, each moved by ever more, are taken."""


def near_interval(context: Context, program: ControlProgram, stem: str) -> list[dict[Symbol, float]]:
    """Values of all symbols on intervals of a kind."""
    if context.guessed is None:
        return []
    local = program.element_symbols[: len(program.element_symbols) - len(program.shared)]
    return _points(context.guessed.on_intervals(local, parameters(program), part_of_chain(program, stem)), program)


def near_end(context: Context, program: ControlProgram, end: str) -> list[dict[Symbol, float]]:
    """Values of all symbols at the first or last node."""
    if context.guessed is None:
        return []
    node = program.left_symbols if end == "start" else program.right_symbols
    return _points(context.guessed.at_node(end == "end", node, parameters(program)), program)


def _points(values: Values, program: ControlProgram) -> list[dict[Symbol, float]]:
    named, inner = with_time(values, program.model.time), program.inner
    for column, symbol in enumerate(inner.symbols, start=1):
        named[symbol] = named[inner.parameters[column * len(inner.times)]]
    count = len(next(iter(named.values())))
    return [{s: float(array[index]) for s, array in named.items()} for index in _PREFERRED if index < count]
