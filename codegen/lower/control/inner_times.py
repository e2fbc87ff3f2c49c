"""What conditions at inner times need as strings: code that reads a node's numbers, tables, and the grid."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from sympy import Expr, Symbol

from codegen.lower.control.layout import integers
from codegen.lower.kernels import Line
from codegen.lower.printer import scalar_code
from codegen.transcribe.program import ControlProgram


def codes(program: ControlProgram) -> dict[Symbol, str]:
    """The code that reads, inside a kernel of an interval, the numbers of its left node."""
    first, count = _first(program), len(program.inner.times)
    symbols = enumerate(program.inner.symbols)
    return {symbol: f"inner_number(parameters, {first}, {count}, {i}, t, h)" for i, symbol in symbols}


def _first(program: ControlProgram) -> int:
    """Where inner times stand in the vector of parameters."""
    return len(program.model.parameters) + len(program.boundary_values)


def constants(program: ControlProgram) -> list[Line]:
    """How many times there are, and which unknowns belong to them."""
    inner = program.inner
    if not inner.times:
        return []
    lines = [
        Line("INNER_TIMES", str(len(inner.times)), "times between start and end at which conditions hold"),
        Line("INNER_FIRST", str(_first(program)), "where they stand among the parameters"),
        Line("INNER_UNKNOWNS", integers(inner.unknowns), "unknowns of nodes at such times; zero at others"),
        Line("INNER_PRESENT", f"np.array({[list(row) for row in inner.present]})", "which of them, time by time"),
    ]
    if inner.lacking:
        lacks = [len(program.node) + index for index in inner.lacking]
        lines.append(Line("INNER_LACKS", integers(lacks), "unknowns that intervals after them lack"))
    return lines


def times_and_values(program: ControlProgram, boundary_code: Callable[[Expr], str]) -> dict[str, Any]:
    """The inner times, and what stands among the parameters for them."""
    inner = program.inner
    values = zip(inner.values, inner.parameters, strict=True)
    return {
        "inner_times": (tuple(map(scalar_code, inner.times)),) if inner.times else (),
        "inner_values": tuple(Line("", boundary_code(value), symbol.name) for value, symbol in values),
    }


def grid_code(program: ControlProgram, duration: str) -> str:
    """Code that makes the grid of a duration, which has the inner times among its nodes."""
    made = f"checked_grid(problem, steps, {duration}, parameters, grid)"
    return f"with_inner_times({made})" if program.inner.times else made
