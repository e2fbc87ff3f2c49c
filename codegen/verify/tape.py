"""Sympy expressions as they stand, evaluated operation by operation in any arithmetic, with equal parts only once.

Nothing here is shared with differentiation, with the search for common parts, or with printing.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import sympy
from sympy import Basic, Expr, Symbol

from codegen.expressions.table_functions import TableBase
from codegen.tables.evaluation import derivative


@dataclass(frozen=True)
class Arithmetic:
    """What a tape is evaluated with: `number` of a string of digits, `function` by the name it has in `math`."""

    number: Callable[[str], Any]
    function: Callable[[str], Callable[..., Any]]
    power: Callable[[Any, Any], Any]
    maximum: Callable[..., Any]
    minimum: Callable[..., Any]
    absolute: Callable[[Any], Any]
    sign: Callable[[Any], Any]
    where: Callable[[Any, Any, Any], Any]
    real: Callable[[Any], Any]


class Tape:
    """The parts of some expressions, each after those that it is made of."""

    def __init__(self, expressions: Sequence[Expr]) -> None:
        self.indices: dict[Basic, int] = {}
        self.parts: list[tuple[Basic, tuple[int, ...]]] = []
        self.results = [self._placed(sympy.sympify(e)) for e in expressions]

    def _placed(self, root: Basic) -> int:
        waiting = [root]
        while waiting:
            part = waiting[-1]
            missing = [] if part in self.indices else [a for a in part.args if a not in self.indices]
            if missing:
                waiting += missing
                continue
            waiting.pop()
            if part not in self.indices:
                self.indices[part] = len(self.parts)
                self.parts.append((part, tuple(self.indices[a] for a in part.args)))
        return self.indices[root]

    def evaluate(self, values: Mapping[Symbol, Any], arithmetic: Arithmetic) -> list[Any]:
        """The values of the expressions, given those of their symbols."""
        known: list[Any] = []
        for part, indices in self.parts:
            known.append(_value(part, [known[index] for index in indices], values, arithmetic))
        return [known[index] for index in self.results]


def _value(part: Basic, given: list[Any], values: Mapping[Symbol, Any], a: Arithmetic) -> Any:
    if part.is_Symbol:
        return values[part]
    if part.is_Rational:
        return a.number(str(part.p)) / a.number(str(part.q)) if part.q != 1 else a.number(str(part.p))
    if part.is_Number or isinstance(part, sympy.NumberSymbol):
        return a.number(str(part.evalf(130)))
    if part.is_Add:
        return reduce(operator.add, given)
    if part.is_Mul:
        return reduce(operator.mul, given)
    if part.is_Pow:
        exponent = part.exp
        if exponent.is_Integer:
            return a.power(given[0], int(exponent))
        return a.function("sqrt")(given[0]) if exponent == sympy.S.Half else a.power(*given)
    if isinstance(part, sympy.Piecewise):
        return reduce(lambda rest, pair: a.where(pair[1], pair[0], rest), reversed(given), a.number("nan"))
    if isinstance(part, sympy.functions.elementary.piecewise.ExprCondPair):
        return tuple(given)
    if part.is_Boolean or part.is_Relational:
        if part.is_Relational:
            return _RELATIONS[part.rel_op](*map(a.real, given))
        if isinstance(part, sympy.Not):
            return given[0] == False  # noqa: E712  # arrays are negated one by one
        if isinstance(part, (sympy.And, sympy.Or)):
            return reduce(operator.and_ if isinstance(part, sympy.And) else operator.or_, given)
        return bool(part)
    if isinstance(part, TableBase):
        return derivative(part.table, part.order, given, a.real)
    name = type(part).__name__
    own = {"Abs": a.absolute, "Max": a.maximum, "Min": a.minimum, "sign": a.sign}
    if name in own:
        return own[name](*given)
    if name == "Heaviside":
        return (a.sign(given[0]) + 1) / 2
    return a.function(name)(*given)


_RELATIONS: dict[str, Callable[[Any, Any], Any]] = {
    **{"<": operator.lt, "<=": operator.le, ">": operator.gt, ">=": operator.ge},
    **{"==": operator.eq, "!=": operator.ne},
}
