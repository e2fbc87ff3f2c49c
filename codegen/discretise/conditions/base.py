"""What the stages ask of a kind of condition."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Protocol

import sympy
from sympy import Expr

from codegen.discretise.model.definitions import Condition, Model
from codegen.discretise.model.relations import Entry, relation_entries
from codegen.errors import CodegenError
from codegen.problem.problem import Control
from codegen.problem.symbols import Quantity
from codegen.symbolic import checks as expressions

Points = Sequence[Mapping[sympy.Symbol, float]]
Scope = Mapping[str, tuple[type[Quantity], ...]]
Remedies = Mapping[type[Quantity], str]


class Latex(Protocol):
    """What writes an author's problem in LaTeX: an expression when it is called, and the names of time's two ends."""

    first: str
    last: str

    def __call__(self, value: Any) -> str: ...

    def relation(self, value: Any) -> str: ...

    def at(self, value: Any, time: str) -> str: ...

    def between(self, written: str, limits: Sequence[Any]) -> str: ...


class ConditionKind:
    """A kind of condition, which answers for itself from what is written to what is said of it.

    `argument` is that of `Control`, `field` that of the model, `words` is what a problem with such conditions has.
    `scope` says for each role of its expressions which symbols they may hold, `remedies` what to do about others;
    `not_in_phases` is the error, finding and remedy where a phase of several cannot have them. `check` names the check
    that is about nothing else, if there is one.
    Methods that a kind does not have say that it asks for nothing.
    """

    argument: ClassVar[str]
    field: ClassVar[str]
    words: ClassVar[str]
    scope: ClassVar[Scope]
    remedies: ClassVar[Remedies] = {}
    not_in_phases: ClassVar[tuple[type[CodegenError], str, str] | None] = None
    check: ClassVar[str] = ""

    def written(self, control: Control) -> Iterator[Entry]:
        """The expressions of what an author wrote; raises a kind of CodegenError for what is none of this kind."""
        return relation_entries(self.argument, getattr(control, self.argument))

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        """Refuse an expression of this kind that contradicts other arguments, whatever the numbers are."""

    def of_model(self, model: Model) -> tuple[Any, ...]:
        """The conditions of this kind that a model has."""
        return tuple(getattr(model, self.field))

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """The model with the conditions that were written, in plain symbols, behind those that it has."""
        fields: dict[str, Any] = {self.field: (*self.of_model(model), *self.conditions(entries))}
        return replace(model, **fields)

    def conditions(self, entries: Sequence[Entry]) -> tuple[Any, ...]:
        """The conditions in the order in which they were written."""
        return conditions_of(entries, self.argument)

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Expressions that need a real value somewhere, each with what messages call it."""
        yield from ((condition.name, condition.expression) for condition in self.of_model(model))

    def numbers(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Expressions that have to be finite numbers at the default parameters."""
        yield from ()

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        """What holds at the `start` or `end`, where given values have to agree with it."""
        yield from ()

    def require_regular(self, model: Model, points: Points) -> None:
        """Refuse conditions that say nothing, or follow from each other, at trial points."""

    def sentences(self, model: Model) -> list[str]:
        """What a module's docstring says of the conditions, a line each."""
        return []

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        """Headings and rows (name, value) of what `codegen show` adds to the continuous problem."""
        yield from ()

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        """Rows in LaTeX of what an author wrote, aligned at their &, for notebooks; nothing is checked before."""
        for relation in listed(getattr(control, self.argument)):
            yield rf"&{latex.relation(relation)}\quad{self.when(latex)}"

    def when(self, latex: Latex) -> str:
        """When a condition holds, in LaTeX, or else what it is."""
        return rf"\text{{({self.argument})}}"

    def costs(self, control: Control, latex: Latex) -> Iterator[str]:
        """Terms in LaTeX that are added to what is minimised."""
        yield from ()


def listed(given: Any) -> Sequence[Any]:
    """Relations without the names that an author may have given them."""
    return list(given.values()) if isinstance(given, Mapping) else given


def conditions_of(entries: Sequence[Entry], role: str) -> tuple[Condition, ...]:
    """The relations of a role in the order in which they were written."""
    return tuple(Condition(entry.name, entry.expression, entry.equality) for entry in entries if entry.role == role)


def is_constant(condition: Condition, symbols: Sequence[sympy.Symbol], points: Points) -> bool:
    """Whether a condition does not depend on any of the symbols, wherever it is tried; short slopes come first."""
    inside = [symbol for symbol in symbols if symbol in condition.expression.free_symbols]
    inside.sort(key=lambda symbol: sympy.count_ops(sympy.diff(condition.expression, symbol)))
    return all(dependent([condition], [symbol], points) for symbol in inside)


def dependent(conditions: Sequence[Condition], symbols: Sequence[sympy.Symbol], points: Points) -> str:
    """The names of conditions that follow from each other to first order wherever they are tried, else nothing."""
    if not conditions:
        return ""
    slopes = [sympy.diff(c.expression, s) for c in conditions for s in symbols]
    weights = expressions.dependent_rows(sympy.Matrix(len(conditions), len(symbols), slopes), points)
    if weights is None:
        return ""
    return " and ".join(c.name for c, weight in zip(conditions, weights, strict=True) if abs(weight) > 1e-6)
