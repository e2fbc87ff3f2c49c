"""Explicit elimination: solve what can be solved symbolically, so that Newton's method keeps only the rest.

Equation i and unknown i belong together: for a consistent scheme its coefficient is 1 + O(h), or an entry of the mass
matrix, and does not vanish. Where an equation is linear in one unknown, it is solved for that unknown and the result is
put into the other equations. The procedure is known as tearing; source: Duff, Erisman and Reid (2017), Direct methods
for sparse matrices, chapters 5 and 7.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field

from sympy import Expr, S, Symbol, expand

from codegen.discretise import STEP
from codegen.legendre import vanishes

Assignment = tuple[Symbol, Expr]

_EXPANSION_LIMIT = 200
"""Operation count up to which it is worth expanding an expression to see that it is linear."""
_GROWTH_LIMIT = 100
"""Operations beyond twice the original number to which substitutions may lengthen the equations.

Longer than that, a numerical solution of more unknowns is cheaper."""


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
    attempts = [_System(list(equations), list(unknowns), frozenset(constants)) for _ in range(2)]
    results = [system.solved(order) for system, order in zip(attempts, (forward, forward[::-1]), strict=True)]
    return min(results, key=_labour)


def _labour(result: Elimination) -> tuple[int, bool, int]:
    assigned = (value for _, value in (*result.before, *result.after))
    operations = sum(int(e.count_ops()) for e in (*result.residual, *assigned))
    return len(result.unknowns), not result.linear, operations


@dataclass
class _System:
    """The equations that are still open (None: used up), the open unknowns, and what has been solved so far."""

    equations: list[Expr | None]
    unknowns: list[Symbol]
    constants: frozenset[Symbol]
    open: set[Symbol] = field(default_factory=set)
    found: list[Assignment] = field(default_factory=list)

    def solved(self, order: Sequence[int]) -> Elimination:
        self.open = set(self.unknowns)
        limit = 2 * self._operations() + _GROWTH_LIMIT
        while self._solve_determined(order) or self._eliminate(order, limit):
            pass
        before, after = _sorted(self.found, self.open)
        residual = tuple(e for e in self.equations if e is not None)
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
                    self._close(i, y, solution[1])
                    return True
        return False

    def _eliminate(self, order: Sequence[int], limit: int) -> bool:
        """Express one unknown by other open ones, and substitute; False when none is admissible.

        Of the admissible pairs the one that fills in least is taken (Markowitz's count).
        """
        candidates = []
        for place, i in enumerate(order):
            present = self._present(i)
            for y in sorted(present, key=self.unknowns.index):
                others = [j for j in range(len(self.equations)) if j != i and y in self._present(j)]
                fill = len(others) * (len(present) - 1)
                candidates.append((y != self.unknowns[i], fill, place, i, y))
        for foreign, _, _, i, y in sorted(candidates, key=lambda c: c[:3]):
            solution = self._solution(i, y)
            if solution is None or not self._is_safe(solution[0], foreign):
                continue
            kept, opened, length = list(self.equations), set(self.open), len(self.found)
            self._close(i, y, solution[1])
            if self._operations() <= limit:
                return True
            self.equations, self.open = kept, opened
            del self.found[length:]
        return False

    def _is_safe(self, coefficient: Expr, foreign: bool) -> bool:
        """Whether a pivot cannot vanish where the system as a whole is regular.

        Constants of the unknown's own equation do not; elsewhere only numbers and powers of h are trusted, since a
        parameter (a friction, say) may be zero.
        """
        trusted = {STEP} if foreign else self.constants | {STEP}
        return bool(coefficient.free_symbols <= trusted)

    def _present(self, i: int) -> AbstractSet[Symbol]:
        equation = self.equations[i]
        return frozenset() if equation is None else equation.free_symbols & self.open

    def _solution(self, i: int, y: Symbol) -> tuple[Expr, Expr] | None:
        """Coefficient of y in equation i and the value of y, if y enters linearly and surely."""
        equation = self.equations[i]
        assert equation is not None
        coefficient = linear_in(equation, y, self.open)
        if coefficient is None or vanishes(coefficient):
            return None
        rest = equation.xreplace({y: S.Zero})
        return coefficient, -rest / coefficient if coefficient != -1 else rest

    def _close(self, i: int, y: Symbol, value: Expr) -> None:
        """Use equation i for y; a value that open unknowns enter replaces y everywhere, another keeps its name."""
        self.equations[i] = None
        self.open.discard(y)
        self.found.append((y, value))
        if value.free_symbols & self.open:
            self.equations = [e if e is None else e.xreplace({y: value}) for e in self.equations]

    def _operations(self) -> int:
        return sum(int(e.count_ops()) for e in self.equations if e is not None)


def linear_in(expression: Expr, y: Symbol, variables: AbstractSet[Symbol]) -> Expr | None:
    """The coefficient of y, free of all `variables`, or None when the expression is not linear in y in that sense."""
    coefficient = expression.diff(y)
    if coefficient.free_symbols & variables and coefficient.count_ops() < _EXPANSION_LIMIT:
        coefficient = expand(coefficient)
    return None if coefficient.free_symbols & variables else coefficient


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
