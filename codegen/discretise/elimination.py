"""Symbolic elimination of unknowns from equations, one by one.

Explicit elimination leaves to Newton's method only the unknowns without a symbolic solution. Equation i belongs to
unknown i: for a consistent scheme the coefficient of the unknown is 1 + O(h), or an entry of the mass matrix, and does
not vanish. An equation that is linear in an unknown is solved for it, and the solution is substituted into the other
equations. The procedure is known as tearing. Source: Duff, Erisman and Reid (2017), Direct methods for sparse matrices,
chapters 5 and 7.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import sympy
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from sympy import Add, Expr, S, Symbol, expand

from codegen.discretise.interval import STEP
from codegen.symbolic import checks as expressions
from codegen.symbolic import parts
from codegen.symbolic.graph import Assignment
from codegen.symbolic.zeros import identically_zero

_EXPANSION_LIMIT = 200
"""Greatest number of operations, and of terms, of sums that are expanded to test linearity."""
PIVOT_LIMIT = 20
"""Greatest number of operations of a coefficient with roots by which an equation of first-order dynamics is divided."""
_MANY, _LONG = 100, 20_000
"""Numbers of equations, and of their operations, from which unknowns are eliminated without fill-in."""
_SUBSTITUTED = 20
"""Greatest number of operations of a solution that is substituted into one of many equations."""
_GROWTH_LIMIT = 150
"""Greatest number of operations that substitutions add to the equations; more make a numerical solution cheaper."""


@dataclass(frozen=True)
class Elimination:
    """The unknowns and the residual of Newton's method, with the assignments `before` and `after` it in order.

    `linear` is True if the residual is linear in the unknowns. Without unknowns all assignments are in `before`.
    """

    before: tuple[Assignment, ...]
    unknowns: tuple[Symbol, ...]
    residual: tuple[Expr, ...]
    after: tuple[Assignment, ...]
    linear: bool


def eliminate(
    equations: Sequence[Expr], unknowns: Sequence[Symbol], constants: Iterable[Symbol], longest: int | None = None
) -> Elimination:
    """Solve equations (expressions that must vanish) for as many unknowns as possible, one by one.

    `constants` are the symbols that are constant along a trajectory. Equations are tried in both orders; the result has
    the fewest unknowns for Newton's method, then the fewest operations. No equation is divided by a coefficient with
    roots, such as sqrt(6), that has more operations than `longest`: sympy takes minutes for the signs of polynomials in
    roots, and a numerical solution with exchange of rows is cheap. Many and long equations are solved without fill-in.
    """

    def cost(result: Elimination) -> tuple[int, bool, int]:
        assigned = (value for _, value in (*result.before, *result.after))
        operations = sum(map(parts.operations, (*result.residual, *assigned)))
        return len(result.unknowns), not result.linear, operations

    forward = range(len(unknowns))
    if len(unknowns) >= _MANY or expressions.longer_than(_LONG, equations):
        return _System(equations, unknowns, frozenset(constants), longest).solved(forward, is_large=True)
    first = _System(equations, unknowns, frozenset(constants), longest).solved(forward)
    if len(first.unknowns) in (0, len(unknowns)):
        return first  # another order leaves the same number
    return min(first, _System(equations, unknowns, frozenset(constants), longest).solved(forward[::-1]), key=cost)


@dataclass(frozen=True)
class _Equation:
    """An expression that must vanish, with its symbols and its number of operations."""

    expression: Expr
    symbols: AbstractSet[Symbol]
    operations: int

    @classmethod
    def of(cls, expression: Expr) -> _Equation:
        return cls(expression, parts.symbols_of(expression), parts.operations(expression))


class _System:
    """The equations and unknowns that are still open, and the assignments of the solved unknowns."""

    def __init__(
        self,
        equations: Sequence[Expr],
        unknowns: Sequence[Symbol],
        constants: AbstractSet[Symbol],
        longest: int | None,
    ) -> None:
        self.equations = {i: _Equation.of(e) for i, e in enumerate(equations)}
        self.unknowns = tuple(unknowns)
        self.places = {y: i for i, y in enumerate(unknowns)}
        self.constants = constants
        self.longest = longest
        self.open = set(unknowns)
        self.assignments: list[Assignment] = []
        self.rejected: set[tuple[int, Symbol]] = set()
        self.limit = sum(e.operations for e in self.equations.values()) + _GROWTH_LIMIT

    def solved(self, order: Sequence[int], is_large: bool = False) -> Elimination:
        if is_large:
            self._eliminate_without_fill()
        while not is_large and (self._solve_determined(order) or self._eliminate(order)):
            pass
        # Sort: an assignment follows the values that it reads. Those that read no open unknown come first.
        waiting, before, after = list(self.assignments), list[Assignment](), list[Assignment]()
        for readable, sequence in ((frozenset[Symbol](), before), (self.open, after)):
            while True:
                missing = ({y for y, _ in waiting} | self.open) - readable
                ready = [assignment for assignment in waiting if not parts.symbols_of(assignment[1]) & missing]
                if not ready:
                    break
                sequence += ready
                placed = {y for y, _ in ready}
                waiting = [assignment for assignment in waiting if assignment[0] not in placed]
        equations = self.equations.values()
        residual = tuple(e.expression for e in equations)
        unknowns = tuple(y for y in self.unknowns if y in self.open)
        longest = sorted(equations, key=lambda e: -e.operations)  # which are most often nonlinear
        linear = all(linear_in(e.expression, y, self.open) is not None for e in longest for y in e.symbols & self.open)
        return Elimination(tuple(before), unknowns, residual, tuple(after), linear)

    def _solve_determined(self, order: Sequence[int]) -> bool:
        """Solve one equation that is linear in its single open unknown; return False if there is no such equation."""
        for i in order:
            present = self._present(i)
            if len(present) == 1:
                (y,) = present
                solution = self._solution(i, y)
                if solution is not None:
                    # Other equations keep the symbol, because its value depends on no open unknown.
                    del self.equations[i]
                    self.open.discard(y)
                    self.assignments.append((y, solution[1]))
                    return True
        return False

    def _eliminate(self, order: Sequence[int]) -> bool:
        """Solve one equation for an unknown in terms of open unknowns, and substitute; return False if none fits.

        Equation i is first tried for unknown i, then the pair with the least fill-in (Markowitz's count).
        """
        present = {i: self._present(i) for i in order}
        occurrences = Counter(y for symbols in present.values() for y in symbols)
        ranked = [
            (y != self.unknowns[i], (occurrences[y] - 1) * (len(present[i]) - 1), position, self.places[y])
            for position, i in enumerate(order)
            for y in present[i]
            if (i, y) not in self.rejected
        ]
        for is_foreign, _, position, index in sorted(ranked):
            i, y = order[position], self.unknowns[index]
            solution = self._solution(i, y)
            # The pivot must not vanish where the system is regular. In equation i, constants are safe pivots of unknown
            # i. In other equations a parameter, such as a friction, may be zero; numbers and powers of h are safe.
            trusted = {STEP} if is_foreign else self.constants | {STEP}
            if (
                solution is None
                or not parts.symbols_of(solution[0]) <= trusted
                or (is_foreign and self._is_small(i, y))
            ):
                self.rejected.add((i, y))
                continue
            if (others := self._substituted(i, y, solution[1])) is not None:
                changed = {j for j, e in others.items() if e is not self.equations[j]}
                self.rejected = {(j, z) for j, z in self.rejected if j not in changed}
                self.equations = others
                self.open.discard(y)
                self.assignments.append((y, solution[1]))
                return True
            self.rejected.add((i, y))
        return False

    def _substituted(self, i: int, y: Symbol, value: Expr) -> dict[int, _Equation] | None:
        """Return the equations other than i with a value in place of y; None if they are too long together."""
        others = {j: e for j, e in self.equations.items() if j != i}
        total = sum(e.operations for e in others.values() if y not in e.symbols)
        for j, e in others.items():
            if total > self.limit:
                return None
            if y in e.symbols:
                others[j] = _Equation.of(parts.replaced(e.expression, {y: value}))
                total += others[j].operations
        return others if total <= self.limit else None

    def _is_small(self, i: int, y: Symbol) -> bool:
        """Return True if, for a short step, the coefficient of y is small relative to another one in equation i.

        Such a coefficient, as of a slow rotation of the frame or of a stiffness times h, is a bad pivot: it amplifies
        the errors of the initial guesses of the other unknowns.
        """
        present, short = self._present(i), {STEP: _SHORT}
        slopes = [abs(self.equations[i].expression.diff(z).xreplace(short)) for z in present if z != y]
        own = abs(self.equations[i].expression.diff(y).xreplace(short))
        return any(slope.is_number and own < _SMALL * slope for slope in slopes)

    def _eliminate_without_fill(self) -> None:
        """Solve equations for unknowns that occur in no other equation, or depend on at most one other unknown.

        No equation gets more unknowns. The work is proportional to the number of equations, and alike equations are
        treated alike. Solutions are short, so that a series of substitutions cannot grow.
        """
        readers: dict[Symbol, set[int]] = {y: set() for y in self.unknowns}
        for i in self.equations:
            for y in self._present(i):
                readers[y].add(i)
        waiting = deque(self.equations)
        while waiting:
            i = waiting.popleft()
            present = self._present(i)
            for y in sorted(present, key=lambda y: (y != self.unknowns[i], self.places[y])):
                others = {j for j in readers[y] if j != i and j in self.equations}
                if (len(present) > 2 and others) or (i, y) in self.rejected:
                    continue
                solution = self._solution(i, y)
                trusted = {STEP} if y != self.unknowns[i] else self.constants | {STEP}
                is_determined = len(present) == 1  # then other equations keep the symbol
                if (
                    solution is None
                    or not (is_determined or parts.symbols_of(solution[0]) <= trusted)
                    or (others and not is_determined and expressions.longer_than(_SUBSTITUTED, [solution[1]]))
                    or (y != self.unknowns[i] and self._is_small(i, y))
                ):
                    self.rejected.add((i, y))
                    continue
                del self.equations[i]
                self.open.discard(y)
                self.assignments.append((y, solution[1]))
                for j in sorted(others):
                    if not is_determined:
                        self.equations[j] = _Equation.of(parts.replaced(self.equations[j].expression, {y: solution[1]}))
                    for z in self._present(j):
                        readers[z].add(j)
                        self.rejected.discard((j, z))
                for z in present:
                    readers[z].discard(i)
                waiting += sorted({*others, *(j for z in present & self.open for j in readers[z])})
                break

    def _present(self, i: int) -> AbstractSet[Symbol]:
        return self.equations[i].symbols & self.open if i in self.equations else frozenset()

    def _solution(self, i: int, y: Symbol) -> tuple[Expr, Expr] | None:
        """Return the coefficient of y in equation i and the solution; None if y is not linear, or cancels.

        None, too, for a coefficient with roots that is longer than `eliminate` allows.
        """
        equation = self.equations[i].expression
        coefficient = linear_in(equation, y, self.open)
        if coefficient is None:
            return None
        has_roots = any(power.base.is_Integer and not power.exp.is_Integer for power in coefficient.atoms(sympy.Pow))
        if self.longest is not None and has_roots and expressions.longer_than(self.longest, [coefficient]):
            return None
        if identically_zero(coefficient):
            return None
        rest = equation.xreplace({y: S.Zero})
        if rest.has(S.ComplexInfinity, S.NaN):  # terms such as 1/y cancel, but not as they are written
            rest = expand(equation).xreplace({y: S.Zero})
            if rest.has(S.ComplexInfinity, S.NaN):
                return None
        return coefficient, rest if coefficient == -1 else -rest / coefficient


def linear_in(expression: Expr, y: Symbol, variables: AbstractSet[Symbol]) -> Expr | None:
    """Return the coefficient of y if it contains none of the `variables`, else None.

    Long expressions are tested as they are written; short expressions are also expanded, so that terms may cancel.
    """
    terms = [term for term in Add.make_args(expression) if y in _symbols_of(term)]
    nonlinear = [term for term in terms if y in _nonlinear_symbols(term, variables)]
    if expressions.longer_than(_EXPANSION_LIMIT, nonlinear):
        return None
    coefficient = Add(*terms).diff(y)
    if nonlinear and expressions.multiplied_out(coefficient) <= _EXPANSION_LIMIT:
        coefficient = expand(coefficient)
    return None if parts.symbols_of(coefficient) & variables else coefficient


def _nonlinear_symbols(expression: Expr, variables: AbstractSet[Symbol]) -> AbstractSet[Symbol]:
    """Return the variables in which an expression, as written, is not linear with a coefficient without variables."""
    varying = [part for part in expression.args if _symbols_of(part) & variables]
    if expression.is_Add or (expression.is_Mul and len(varying) == 1):
        return frozenset[Symbol]().union(*(_nonlinear_symbols(part, variables) for part in varying))
    return _symbols_of(expression) & variables if varying else frozenset()


@lru_cache(maxsize=10_000)
def _symbols_of(expression: Expr) -> AbstractSet[Symbol]:
    """Return the symbols of a term, cached because every unknown is tested."""
    return frozenset(parts.symbols_of(expression))


_SHORT, _SMALL = sympy.Rational(1, 10**4), sympy.Rational(1, 100)
"""A short time step; the least size of a pivot relative to other coefficients of its equation for this step."""
_LARGE = 12
"""Number of unknowns from which they are put into an order that makes the Jacobian a narrow band."""


def in_bands(solution: Elimination) -> Elimination:
    """Return a solution whose many unknowns and equations are in an order in which coupled ones are near each other.

    The order of the unknowns is that of Cuthill and McKee for the graph of unknowns with a common equation; equations
    follow their middle unknown. Source: George and Liu (1981), Computer solution of large sparse positive definite
    systems, chapter 4.
    """
    if len(solution.unknowns) < _LARGE:
        return solution
    present = [parts.symbols_of(equation) for equation in solution.residual]
    pattern = np.array([[y in symbols for y in solution.unknowns] for symbols in present])
    order = reverse_cuthill_mckee(csr_array(pattern.T.astype(int) @ pattern.astype(int)), symmetric_mode=True)
    middles = [np.flatnonzero(row).mean() for row in pattern[:, order]]
    rows = np.argsort(middles, kind="stable")
    return replace(
        solution,
        unknowns=tuple(solution.unknowns[i] for i in order),
        residual=tuple(solution.residual[i] for i in rows),
    )
