"""What the values and equations at an end of the time interval decide there already.

An inequality whose left side is given at an end, or is determined by the equations that hold there, has no unknown
left to satisfy it: its slack has one value, which may be zero. Neither an interior point method nor a count of
equations can do with that, so that such a condition, or such a bound, is left out at that end.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from codegen.discretise import STEP, PathValue, at_nodes
from codegen.errors import BoundaryError
from codegen.expressions import checks as expressions
from codegen.expressions.rounding import rounding_at
from codegen.transcribe.program import ControlProgram, EndElement


@dataclass(frozen=True)
class EndEquations:
    """The equations between the unknowns of an end: solved ones as substitutions, and others that vanish.

    `numbers` are the default values of parameters and boundary values, `given` the unknowns that have a value there.
    """

    where: str
    unknowns: frozenset[Symbol]
    solved: Mapping[Symbol, Expr]
    others: tuple[Expr, ...]
    numbers: Mapping[Symbol, float]
    given: Mapping[Symbol, Expr]

    @staticmethod
    def of(
        where: str,
        equations: Sequence[Expr],
        unknowns: frozenset[Symbol],
        numbers: Mapping[Symbol, float],
        given: Mapping[Symbol, Expr],
    ) -> EndEquations:
        """Solve those equations that are linear in the unknowns; all are expressions that vanish."""
        linear = [e for e in equations if _is_linear(e, unknowns)]
        present = sorted(set[Symbol]().union(*(e.free_symbols for e in linear)) & unknowns, key=str)
        solutions = sympy.linsolve(linear, present) if linear else sympy.EmptySet
        values = next(iter(solutions), ())
        solved = {symbol: value for symbol, value in zip(present, values, strict=False) if value != symbol}
        others = (e.subs(solved, simultaneous=True) for e in equations if e not in linear)
        left = tuple(e for e in others if e.free_symbols & unknowns)
        return EndEquations(where, unknowns, solved, left, numbers, given)

    def value(self, expression: Expr) -> Expr | None:
        """What an expression is equal to at this end, in given quantities alone; None where it may vary."""
        value = expression.xreplace(dict(self.given)).subs(self.solved, simultaneous=True)
        if not value.free_symbols & self.unknowns:
            return value
        found = (_without_multiple(value, equation, self.unknowns) for equation in self.others)
        return next((rest for rest in found if rest is not None), None)

    def touched(self, condition: str, expression: Expr) -> str | None:
        """None where expression <= 0 is not decided here; else the condition if its limit is met, or "" if not.

        Raises BoundaryError where what decides it violates it.
        """
        value = self.value(expression)
        if value is None:
            return None
        excess = expressions.rounded_at(value, self.numbers)
        if excess is None:
            return ""
        rounding = max(rounding_at(value, self.numbers), self._rounding_before(expression))
        if excess > rounding:
            raise BoundaryError(f"the {self.where} violates {condition} by {excess:g}", "correct one of them")
        return condition if excess >= -rounding else ""

    def _rounding_before(self, expression: Expr) -> float:
        """The rounding of an expression in whose value, numbers put in, the terms are no longer seen; else zero."""
        known = {**self.given, **self.solved}
        numbers = {s: expressions.rounded_at(known[s], self.numbers) for s in expression.free_symbols & set(known)}
        at = {**self.numbers, **{symbol: number for symbol, number in numbers.items() if number is not None}}
        return rounding_at(expression, at) if expression.free_symbols <= set(at) else 0.0


def with_determined_values(program: ControlProgram, inequalities: Sequence[PathValue]) -> ControlProgram:
    """The program whose ends say what is decided there; `inequalities` belong to the slacks of an interval."""
    if not program.has_inequalities:
        return program
    return replace(
        program,
        start=_with_determined_values(program, "start", inequalities),
        end=_with_determined_values(program, "end", inequalities),
    )


def _with_determined_values(program: ControlProgram, where: str, inequalities: Sequence[PathValue]) -> EndElement:
    end = program.start if where == "start" else program.end
    node = program.left_symbols if where == "start" else program.right_symbols
    given = {node[index]: value for index, value in end.pins}
    equations = _equations(program, where, given)
    candidates = [(s.name, s.meaning.subject, v.value) for s, v in zip(program.slacks, inequalities, strict=True)]
    if equations.solved or equations.others:
        candidates += _of_the_node(program, end, node)
    found = ((name, equations.touched(text, value)) for name, text, value in candidates)
    decided = dict[str, str]()
    for name, touched in found:
        if touched is not None:
            decided[name] = decided.get(name) or touched
    return replace(end, determined=tuple(decided.items()))


def _of_the_node(program: ControlProgram, end: EndElement, node: Sequence[Symbol]) -> list[tuple[str, str, Expr]]:
    """Slacks and bounded unknowns of an end node: name, condition, and the expression that is not positive."""
    found = []
    names = {f"-{program.node[slack].name}": program.node[slack].name for slack, _ in end.slacks}
    for text, value in end.conditions:
        head, _, condition = text.partition(" ")
        if head in names:
            found.append((names[head], condition[1:-1], value))
    fixed = {index for index, _ in end.pins} | {index for index, _, _ in end.shared}
    for index, unknown in enumerate(program.node):
        if index in fixed:
            continue
        if unknown.lower is not None:
            found.append((unknown.name, f"{unknown.name} >= {unknown.lower}", unknown.lower - node[index]))
        if unknown.upper is not None:
            found.append((unknown.name, f"{unknown.name} <= {unknown.upper}", node[index] - unknown.upper))
    return found


def _equations(program: ControlProgram, where: str, given: Mapping[Symbol, Expr]) -> EndEquations:
    """The equations on coordinates and rates that the author wrote for an end, at its node."""
    model, suffix = program.model, "_k" if where == "start" else "_k1"
    boundary = model.start if where == "start" else model.end
    assert boundary is not None, "a control problem has an end"
    quantities = (*model.coordinates, *model.rates)
    substitution: dict[Symbol, Expr] = dict(zip(quantities, at_nodes(quantities, suffix), strict=True))
    substitution |= {v: value for v, value in zip(model.rates, boundary.rates, strict=True) if value is not None}
    unknowns = {*program.element_symbols, *at_nodes(model.rates, suffix)} - set(given)
    duration = expressions.rounded_at(model.duration, model.default_values)
    if where == "end":
        substitution[model.time] = model.time + STEP
        if model.duration.free_symbols & set(program.shared_symbols):
            unknowns |= {model.time, STEP}
    conditions = model.start_conditions if where == "start" else model.end_conditions
    numbers = {**model.default_values, STEP: 0.0, model.time: 0.0 if where == "start" else duration}
    values = {v.symbol: expressions.rounded_at(v.value, model.default_values) for v in program.boundary_values}
    return EndEquations.of(
        where,
        [g.expression.subs(substitution, simultaneous=True).xreplace(given) for g in conditions if g.equality],
        frozenset(unknowns),
        {symbol: number for symbol, number in {**numbers, **values}.items() if number is not None},
        given,
    )


def _is_linear(equation: Expr, unknowns: frozenset[Symbol]) -> bool:
    present = sorted(equation.free_symbols & unknowns, key=str)
    slopes = [sympy.diff(equation, symbol) for symbol in present]
    return bool(present) and not any(slope.free_symbols & unknowns for slope in slopes)


def _without_multiple(value: Expr, equation: Expr, unknowns: frozenset[Symbol]) -> Expr | None:
    """What is left of a value when a multiple of something that vanishes is taken off, if no unknown is left."""
    symbol = min(value.free_symbols & unknowns, key=str)
    slope = sympy.diff(equation, symbol)
    if slope == 0:
        return None
    ratio = sympy.cancel(sympy.diff(value, symbol) / slope)
    if ratio.free_symbols & unknowns:
        return None
    rest = sympy.expand(value - ratio * equation)
    return None if rest.free_symbols & unknowns else rest
