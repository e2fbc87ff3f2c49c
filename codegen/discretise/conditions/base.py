"""The interface of a kind of condition to the stages of the pipeline."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import sympy
from sympy import Expr

from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.model.relations import Entry, relation_entries
from codegen.errors import CodegenError
from codegen.problem.problem import Control, Expression, Relation, Relations
from codegen.problem.symbols import Quantity
from codegen.symbolic import checks as expressions

Points = Sequence[Mapping[sympy.Symbol, float]]
Scope = Mapping[str, tuple[type[Quantity], ...]]
Remedies = Mapping[type[Quantity], str]


class Latex(Protocol):
    """The writer of an author's problem in LaTeX: a call writes an expression; `first` and `last` name the ends."""

    first: str
    last: str

    def __call__(self, value: Expression) -> str: ...

    def relation(self, value: Relation) -> str: ...

    def at(self, value: Expression, time: str) -> str: ...

    def between(self, written: str, limits: Sequence[Expression | None]) -> str: ...


class ConditionKind:
    """A kind of condition: its reading, its checks and its descriptions.

    `argument` is the argument of `Control`, `field` the field of the model, and `words` describes problems with such
    conditions. `scope` gives for each role of its expressions the symbols that may occur, `remedies` the advice for
    other symbols. `not_in_phases` is the error, finding and remedy where phases cannot have such conditions. `check` is
    the name of a numerical check of these conditions alone, or "".
    The methods of this class are the defaults: a kind without a method has no requirement.
    """

    argument: ClassVar[str]
    field: ClassVar[str]
    words: ClassVar[str]
    scope: ClassVar[Scope]
    remedies: ClassVar[Remedies] = {}
    not_in_phases: ClassVar[tuple[type[CodegenError], str, str] | None] = None
    check: ClassVar[str] = ""

    def written(self, control: Control) -> Iterator[Entry]:
        """Yield the author's expressions; raises a kind of CodegenError for objects that are not of this kind."""
        return relation_entries(self.argument, getattr(control, self.argument))

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        """Refuse an expression that contradicts other arguments, independently of numbers."""

    def of_model(self, model: Model) -> tuple[Condition, ...]:
        """Return the conditions of this kind in a model."""
        return tuple(getattr(model, self.field))

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """Add the author's conditions, in plain symbols, to a model."""
        fields: dict[str, Any] = {self.field: (*self.of_model(model), *self.conditions(entries))}
        return replace(model, **fields)

    def conditions(self, entries: Sequence[Entry]) -> tuple[object, ...]:
        """Return the conditions in the order in which they were written."""
        return conditions_of(entries, self.argument)

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Yield the expressions that need a real value somewhere, with their names in messages."""
        yield from ((condition.name, condition.expression) for condition in self.of_model(model))

    def numbers(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Yield the expressions that must be finite numbers at the default parameters, with their names in messages."""
        yield from ()

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        """Yield the conditions at the `start` or `end` with which prescribed values must agree."""
        yield from ()

    def require_regular(self, model: Model, points: Points) -> None:
        """Refuse conditions that are void or dependent at trial points."""

    def sentences(self, model: Model) -> list[str]:
        """Return the lines of a module's docstring about the conditions."""
        return []

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        """Yield headings and rows (name, value) that `codegen show` adds to the continuous problem."""
        yield from ()

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        """Yield the author's conditions, unchecked, as rows in LaTeX, aligned at their &, for notebooks."""
        for relation in listed(getattr(control, self.argument)):
            yield rf"&{latex.relation(relation)}\quad{self.when(latex)}"

    def when(self, latex: Latex) -> str:
        """Return the times at which a condition holds, in LaTeX, or its kind."""
        return rf"\text{{({self.argument})}}"

    def costs(self, control: Control, latex: Latex) -> Iterator[str]:
        """Yield terms in LaTeX that are added to the cost."""
        yield from ()


def listed(given: Relations) -> Sequence[Relation]:
    """Return relations without the author's names."""
    return list(given.values()) if isinstance(given, Mapping) else given


def conditions_of(entries: Sequence[Entry], role: str) -> tuple[Condition, ...]:
    """Return the relations of a role in the order in which they were written."""
    return tuple(Condition(entry.name, entry.expression, entry.equality) for entry in entries if entry.role == role)


def is_constant(condition: Condition, symbols: Sequence[sympy.Symbol], points: Points) -> bool:
    """Return True if a condition depends on none of the symbols at trial points; short derivatives come first."""
    present = [symbol for symbol in symbols if symbol in condition.expression.free_symbols]
    present.sort(key=lambda symbol: sympy.count_ops(sympy.diff(condition.expression, symbol)))
    return all(dependent([condition], [symbol], points) for symbol in present)


def dependent(conditions: Sequence[Condition], symbols: Sequence[sympy.Symbol], points: Points) -> str:
    """Return the names of conditions that depend on each other to first order at all trial points, or ""."""
    if not conditions:
        return ""
    slopes = [sympy.diff(c.expression, s) for c in conditions for s in symbols]
    weights = expressions.dependent_rows(sympy.Matrix(len(conditions), len(symbols), slopes), points)
    if weights is None:
        return ""
    return " and ".join(c.name for c, weight in zip(conditions, weights, strict=True) if abs(weight) > 1e-6)
