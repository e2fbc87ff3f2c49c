"""What the equations at an inner time decide there already: bounds and path inequalities that hold or are met there.

As at the ends (`determined_ends`), such an inequality has no unknown left to satisfy it, and is left out at that node.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sympy import Expr, Symbol

from codegen.discretise import PathValue, at_nodes
from codegen.errors import BoundaryError
from codegen.model.relations import text
from codegen.transcribe.program import ControlProgram
from codegen.transcribe.redundancy.determined_ends import EndEquations


def with_determined_inner_values(program: ControlProgram, inequalities: Sequence[PathValue]) -> ControlProgram:
    """The program that says what is decided at inner times; `inequalities` belong to the slacks of an interval.

    Raises BoundaryError where equations violate a bound, or decide an inequality at the same inner time.
    """
    if not program.inner.times or not program.has_inequalities:
        return program
    found = tuple(
        (number, name, behind)
        for number in range(len(program.inner.times))
        for name, behind in _decided(program, number, inequalities)
    )
    return replace(program, inner=replace(program.inner, determined=found))


def _decided(program: ControlProgram, number: int, inequalities: Sequence[PathValue]) -> list[tuple[str, int]]:
    """Names of unknowns of the node, or with 1 and 0 of slacks of the intervals before and after it."""
    names = list[tuple[str, int]]()
    for suffix, before in (("_k", 0), ("_k1", 1)):
        equations = _equations(program, number, suffix)
        if not equations.solved and not equations.others:
            return []
        pairs = zip(program.slacks, inequalities, strict=True)
        candidates = [(slack.name, slack.meaning.subject, value.value) for slack, value in pairs]
        if not before:
            _require_undecided(program, number, equations)
            candidates += _bounds(program)
        decided = [name for name, condition, value in candidates if equations.touched(condition, value) is not None]
        names += [(name, before) for name in dict.fromkeys(decided)]
    return names


def _bounds(program: ControlProgram) -> list[tuple[str, str, Expr]]:
    """Bounded unknowns of a node, each with what says so and what is not positive."""
    found = []
    inner = program.inner.unknowns
    for index, (unknown, symbol) in enumerate(zip(program.node, program.left_symbols, strict=True)):
        if unknown.lower is not None and index not in inner:
            found.append((unknown.name, f"{unknown.name} >= {unknown.lower}", unknown.lower - symbol))
        if unknown.upper is not None and index not in inner:
            found.append((unknown.name, f"{unknown.name} <= {unknown.upper}", symbol - unknown.upper))
    return found


def _equations(program: ControlProgram, number: int, suffix: str) -> EndEquations:
    model = program.model
    there = [c.expression for c in model.inner_conditions if c.number == number and c.equality]
    values = [expression.subs(_at(program, number, suffix), simultaneous=True) for expression in there]
    unknowns: set[Symbol] = {*program.element_symbols, *at_nodes(model.rates, suffix)}
    time = model.inner_times[number].time
    where = f"waypoint {number + 1}" if time is None else f"inner time {text(time)}"
    return EndEquations.of(where, values, frozenset(unknowns), model.default_values, {})


def _at(program: ControlProgram, number: int, suffix: str) -> dict[Symbol, Expr]:
    model = program.model
    quantities = (*model.coordinates, *model.rates)
    values: dict[Symbol, Expr] = dict(zip(quantities, at_nodes(quantities, suffix), strict=True))
    time = model.inner_times[number].time
    return values if time is None else values | {model.time: time}


def _require_undecided(program: ControlProgram, number: int, equations: EndEquations) -> None:
    for condition in program.model.inner_conditions:
        if condition.number != number or condition.equality:
            continue
        if equations.touched(condition.name, condition.expression.subs(_at(program, number, "_k"))) is not None:
            raise BoundaryError(f"the equations there decide {condition}", "leave it out")
