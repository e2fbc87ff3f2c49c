"""The interface that every kind of condition offers to the stages of the pipeline."""

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
from codegen.symbolic.derivatives import partials

Points = Sequence[Mapping[sympy.Symbol, float]]
Scope = Mapping[str, tuple[type[Quantity], ...]]
Remedies = Mapping[type[Quantity], str]


class Latex(Protocol):
    """A writer of LaTeX: a call writes an expression; `first` and `last` are the times of the start and the end."""

    first: str
    last: str

    def __call__(self, value: Expression) -> str: ...

    def relation(self, value: Relation) -> str: ...

    def at(self, value: Expression, time: str) -> str: ...

    def between(self, written: str, limits: Sequence[Expression | None]) -> str: ...


class ConditionKind:
    """A kind of condition: how it is read, checked and described.

    `argument` is the argument of `Control` with such conditions, `field` their field of `Model`, and `words` their name
    in messages. `scope` maps each role of an expression to the kinds of symbols that may occur in it. `remedies` maps
    other kinds of symbols to the advice of the error message. `not_in_phases` is the error, finding and remedy for
    phases with such conditions, or None. `check` is the name of a numerical check of these conditions alone, or "".
    The methods of this class are defaults without any requirement.
    """

    argument: ClassVar[str]
    field: ClassVar[str]
    words: ClassVar[str]
    scope: ClassVar[Scope]
    remedies: ClassVar[Remedies] = {}
    not_in_phases: ClassVar[tuple[type[CodegenError], str, str] | None] = None
    check: ClassVar[str] = ""

    def written(self, control: Control) -> Iterator[Entry]:
        """Yield the author's expressions as entries; raise a kind of CodegenError for unsuitable objects."""
        return relation_entries(self.argument, getattr(control, self.argument))

    def require_fitting(self, entry: Entry, control: Control, form: str) -> None:
        """Raise an error if an expression contradicts other arguments of `Control`, whatever the numbers are."""

    def of_model(self, model: Model) -> tuple[Condition, ...]:
        """Return the conditions of this kind in a model."""
        return tuple(getattr(model, self.field))

    def added(self, model: Model, entries: Sequence[Entry]) -> Model:
        """Return a model with the author's conditions added; the entries are in the symbols of the model."""
        fields: dict[str, Any] = {self.field: (*self.of_model(model), *self.conditions(entries))}
        return replace(model, **fields)

    def conditions(self, entries: Sequence[Entry]) -> tuple[object, ...]:
        """Return the conditions of this kind among the entries, in the order in which they were written."""
        return conditions_of(entries, self.argument)

    def values(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Yield (name in messages, expression) for expressions that must be real at one trial point or more."""
        yield from ((condition.name, condition.expression) for condition in self.of_model(model))

    def numbers(self, model: Model) -> Iterator[tuple[str, Expr]]:
        """Yield (name in messages, expression) for expressions that must be finite at the default parameters."""
        yield from ()

    def at(self, model: Model, end: str) -> Iterator[Condition]:
        """Yield the conditions that prescribed values at an end, "start" or "end", must satisfy."""
        yield from ()

    def require_regular(self, model: Model, points: Points) -> None:
        """Raise an error for conditions that are constant or linearly dependent at the trial points."""

    def sentences(self, model: Model) -> list[str]:
        """Return the lines about these conditions in the docstring of a generated module."""
        return []

    def shown(self, model: Model) -> Iterator[tuple[str, tuple[tuple[str, Expr], ...]]]:
        """Yield headings with rows (name, expression), which `codegen show` adds to the continuous problem."""
        yield from ()

    def displayed(self, control: Control, latex: Latex) -> Iterator[str]:
        """Yield the author's conditions, without checks, as rows of LaTeX aligned at &, for notebooks."""
        for relation in listed(getattr(control, self.argument)):
            yield rf"&{latex.relation(relation)}\quad{self.when(latex)}"

    def when(self, latex: Latex) -> str:
        """Return in LaTeX the times at which a condition holds, or the name of the argument."""
        return rf"\text{{({self.argument})}}"

    def costs(self, control: Control, latex: Latex) -> Iterator[str]:
        """Yield terms in LaTeX that are added to the cost."""
        yield from ()


def listed(given: Relations) -> Sequence[Relation]:
    """Return relations as a sequence, without the names that are the keys of a mapping."""
    return list(given.values()) if isinstance(given, Mapping) else given


def conditions_of(entries: Sequence[Entry], role: str) -> tuple[Condition, ...]:
    """Return the conditions of the entries with a role, in the order in which they were written."""
    return tuple(Condition(entry.name, entry.expression, entry.equality) for entry in entries if entry.role == role)


def is_constant(condition: Condition, symbols: Sequence[sympy.Symbol], points: Points) -> bool:
    """Return True if all derivatives with respect to the symbols, tested from the shortest, vanish at trial points."""
    present = [symbol for symbol in symbols if symbol in condition.expression.free_symbols]
    slopes = partials(condition.expression, present)
    present.sort(key=lambda symbol: sympy.count_ops(slopes[symbol]))
    return all(dependent([condition], [symbol], points) for symbol in present)


def dependent(conditions: Sequence[Condition], symbols: Sequence[sympy.Symbol], points: Points) -> str:
    """Return the names of conditions whose gradients are linearly dependent at all trial points, or ""."""
    if not conditions:
        return ""
    rows = [partials(c.expression, symbols) for c in conditions]
    slopes = [row.get(s, sympy.S.Zero) for row in rows for s in symbols]
    weights = expressions.dependent_rows(sympy.Matrix(len(conditions), len(symbols), slopes), points)
    if weights is None:
        return ""
    return " and ".join(c.name for c, weight in zip(conditions, weights, strict=True) if abs(weight) > 1e-6)
