"""Explicit elimination: solve what can be solved symbolically, so that Newton's method keeps only the rest.

Equation i and unknown i belong together: for a consistent scheme its coefficient is 1 + O(h), or an entry of the mass
matrix, and does not vanish. Where an equation is linear in one unknown, it is solved for that unknown and the result is
put into the other equations. The procedure is known as tearing; source: Duff, Erisman and Reid (2017), Direct methods
for sparse matrices, chapters 5 and 7.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from functools import lru_cache

from sympy import Add, Expr, S, Symbol, expand

from codegen.discretise import STEP
from codegen.expressions import checks as expressions
from codegen.expressions.zeros import identically_zero

Assignment = tuple[Symbol, Expr]

_EXPANSION_LIMIT = 200
"""Operations, and terms, up to which sums are multiplied out to see that an expression is linear."""
_GROWTH_LIMIT = 150
"""Operations by which substitutions may lengthen the equations; beyond it a numerical solution is cheaper."""


@dataclass(frozen=True)
class Elimination:
    """Assignments before Newton's method, its unknowns and residual, and assignments after it, each in order.

    `linear` says that the residual is linear in the unknowns. Without unknowns everything is in `before`.
    """

    before: tuple[Assignment, ...]
    unknowns: tuple[Symbol, ...]
    residual: tuple[Expr, ...]
    after: tuple[Assignment, ...]
    linear: bool


def eliminate(equations: Sequence[Expr], unknowns: Sequence[Symbol], constants: Iterable[Symbol]) -> Elimination:
    """Solve equations (expressions that must vanish) for unknowns as far as that is possible one by one.

    `constants` are the symbols that keep their value along a trajectory. Several orders are tried; the one that
    leaves the fewest unknowns to Newton's method is taken, and of those the shortest.
    """
    forward = range(len(unknowns))
    first = _System(equations, unknowns, frozenset(constants)).solved(forward)
    if len(first.unknowns) in (0, len(unknowns)):
        return first  # another order leaves no fewer
    return min(first, _System(equations, unknowns, frozenset(constants)).solved(forward[::-1]), key=_labour)


def _labour(result: Elimination) -> tuple[int, bool, int]:
    assigned = (value for _, value in (*result.before, *result.after))
    operations = sum(int(e.count_ops()) for e in (*result.residual, *assigned))
    return len(result.unknowns), not result.linear, operations


@dataclass(frozen=True)
class _Equation:
    """An expression that must vanish, with what is asked of it again and again."""

    expression: Expr
    symbols: AbstractSet[Symbol]
    operations: int

    @classmethod
    def of(cls, expression: Expr) -> _Equation:
        return cls(expression, frozenset(expression.free_symbols), int(expression.count_ops()))

    def with_value(self, y: Symbol, value: Expr) -> _Equation:
        return _Equation.of(self.expression.xreplace({y: value})) if y in self.symbols else self


class _System:
    """The equations and unknowns that are still open, and what has been solved so far."""

    def __init__(self, equations: Sequence[Expr], unknowns: Sequence[Symbol], constants: AbstractSet[Symbol]) -> None:
        self.equations = {i: _Equation.of(e) for i, e in enumerate(equations)}
        self.unknowns = tuple(unknowns)
        self.constants = constants
        self.open = set(unknowns)
        self.found: list[Assignment] = []
        self.rejected: set[tuple[int, Symbol]] = set()
        self.limit = sum(e.operations for e in self.equations.values()) + _GROWTH_LIMIT

    def solved(self, order: Sequence[int]) -> Elimination:
        while self._solve_determined(order) or self._eliminate(order):
            pass
        before, after = _sorted(self.found, self.open)
        residual = tuple(e.expression for e in self.equations.values())
        left = tuple(y for y in self.unknowns if y in self.open)
        linear = all(linear_in(e, y, self.open) is not None for e in residual for y in left if e.has(y))
        return Elimination(before, left, residual, after, linear)

    def _solve_determined(self, order: Sequence[int]) -> bool:
        """Solve one equation that holds a single open unknown, linearly."""
        for i in order:
            present = self._present(i)
            if len(present) == 1:
                (y,) = present
                solution = self._solution(i, y)
                if solution is not None:
                    del self.equations[i]
                    self._record(y, solution[1])
                    return True
        return False

    def _eliminate(self, order: Sequence[int]) -> bool:
        """Express one unknown by other open ones, and substitute; False when none is admissible.

        Of the admissible pairs the one that fills in least is taken (Markowitz's count).
        """
        for i, y in self._candidates(order):
            solution = self._solution(i, y)
            if solution is None or not self._is_safe(solution[0], y != self.unknowns[i]):
                self.rejected.add((i, y))
                continue
            others = {j: e.with_value(y, solution[1]) for j, e in self.equations.items() if j != i}
            if sum(e.operations for e in others.values()) <= self.limit:
                changed = {j for j, e in others.items() if e is not self.equations[j]}
                self.rejected = {(j, z) for j, z in self.rejected if j not in changed}
                self.equations = others
                self._record(y, solution[1])
                return True
            self.rejected.add((i, y))
        return False

    def _candidates(self, order: Sequence[int]) -> list[tuple[int, Symbol]]:
        """Pairs of an equation and an unknown in it: the unknown's own equation first, then those with least fill."""
        present = {i: self._present(i) for i in order}
        occurrences = {y: sum(y in symbols for symbols in present.values()) for y in self.open}
        ranked = [
            (y != self.unknowns[i], (occurrences[y] - 1) * (len(present[i]) - 1), position, self.unknowns.index(y))
            for position, i in enumerate(order)
            for y in present[i]
            if (i, y) not in self.rejected
        ]
        return [(order[position], self.unknowns[index]) for _, _, position, index in sorted(ranked)]

    def _is_safe(self, coefficient: Expr, foreign: bool) -> bool:
        """Whether a pivot cannot vanish where the system as a whole is regular.

        Constants of the unknown's own equation do not; elsewhere only numbers and powers of h are trusted, since a
        parameter (a friction, say) may be zero.
        """
        trusted = {STEP} if foreign else self.constants | {STEP}
        return bool(coefficient.free_symbols <= trusted)

    def _present(self, i: int) -> AbstractSet[Symbol]:
        return self.equations[i].symbols & self.open if i in self.equations else frozenset()

    def _solution(self, i: int, y: Symbol) -> tuple[Expr, Expr] | None:
        """Coefficient of y in equation i and the value of y, if y enters linearly and surely."""
        equation = self.equations[i].expression
        coefficient = linear_in(equation, y, self.open)
        if coefficient is None or identically_zero(coefficient):
            return None
        rest = equation.xreplace({y: S.Zero})
        return coefficient, rest if coefficient == -1 else -rest / coefficient

    def _record(self, y: Symbol, value: Expr) -> None:
        """Close an unknown; one whose value holds no open unknown keeps its name in the equations that remain."""
        self.open.discard(y)
        self.found.append((y, value))


def linear_in(expression: Expr, y: Symbol, variables: AbstractSet[Symbol]) -> Expr | None:
    """The coefficient of y, free of all `variables`, or None when the expression is not linear in y in that sense.

    Long expressions are looked at as they stand; in short ones terms may cancel once they are multiplied out.
    """
    terms = [term for term in Add.make_args(expression) if y in _symbols_of(term)]
    curved = [term for term in terms if y in _curved(term, variables)]
    if expressions.longer_than(_EXPANSION_LIMIT, curved):
        return None
    coefficient = Add(*terms).diff(y)
    if curved and expressions.multiplied_out(coefficient) <= _EXPANSION_LIMIT:
        coefficient = expand(coefficient)
    return None if coefficient.free_symbols & variables else coefficient


def _curved(expression: Expr, variables: AbstractSet[Symbol]) -> AbstractSet[Symbol]:
    """The variables in which an expression, as it is written, is not linear with a coefficient free of variables."""
    varying = [part for part in expression.args if _symbols_of(part) & variables]
    if expression.is_Add or (expression.is_Mul and len(varying) == 1):
        return frozenset[Symbol]().union(*(_curved(part, variables) for part in varying))
    return _symbols_of(expression) & variables if varying else frozenset()


@lru_cache(maxsize=10_000)
def _symbols_of(expression: Expr) -> AbstractSet[Symbol]:
    """The symbols of a term, which is asked about each unknown in turn."""
    return frozenset(expression.free_symbols)


def _sorted(found: Sequence[Assignment], open_unknowns: AbstractSet[Symbol]) -> tuple[tuple[Assignment, ...], ...]:
    """Order assignments so that each follows what it reads; first those that read no open unknown, then the others."""
    waiting, before, after = list(found), list[Assignment](), list[Assignment]()
    for known, done in ((frozenset(), before), (open_unknowns, after)):
        while True:
            missing = ({y for y, _ in waiting} | open_unknowns) - known
            ready = [assignment for assignment in waiting if not assignment[1].free_symbols & missing]
            if not ready:
                break
            done += ready
            waiting = [assignment for assignment in waiting if assignment not in ready]
    return tuple(before), tuple(after)
