"""Transcription of a simulation: one step from (q_k, p_k) to (q_k1, p_k1), solved explicitly as far as possible.

Variational method: the position-momentum form of the forced discrete Euler-Lagrange equations, p_k = -D1 Ld - f- and
p_k1 = D2 Ld + f+. They are solved for the velocity (q_k1 - q_k)/h instead of q_k1, because the difference of two nearby
positions would lose digits. Inner points of a Galerkin variational integrator are replaced by velocities in the same
way. Source: Marsden and West (2001), section 1.5.3.

Hamiltonian method, and first-order dynamics: the equations of a one-step method, inner stages included. A composition
is one step of its base scheme, which the generated module repeats with other lengths: the code does not grow with their
number.

Holonomic constraints c(q, t) = 0, variational method: impulses along the normals G = dc/dq act at both nodes of a step,

    p_k + h/2 G(q_k)^T kappa_k = -D1 Ld - f-,    c(q_k1) = 0,
    p_k1 = D2 Ld + f+ + h/2 G(q_k1)^T kappa_k1,    G(q_k1) v(q_k1, p_k1) + dc/dt = 0.

The second pair is a projection of p_k1, so that a state (q, p) satisfies the constraint and its time derivative. For
the trapezoidal rule and a constant mass matrix the scheme is RATTLE. The impulses h/2 kappa are unknowns in place of
the forces, whose rounding errors grow like 1/h^2. Source: Hairer, Lubich and Wanner (2006), VII.1.3 and VII.1.4;
Marsden and West (2001), section 3.5.

A rolling constraint A(q, t) v + b(q, t) = 0 has A in place of G, and its mean on the step in place of c(q_k1) = 0; see
`conditions/rolling.py`.

Explicit elimination leaves to Newton's method only the unknowns without a symbolic solution. Equation i belongs to
unknown i: for a consistent scheme the coefficient of the unknown is 1 + O(h), or an entry of the mass matrix, and does
not vanish. An equation that is linear in an unknown is solved for it, and the solution is substituted into the other
equations. The procedure is known as tearing. Source: Duff, Erisman and Reid (2017), Direct methods for sparse matrices,
chapters 5 and 7.

Velocities and energy are functions of a state (q, p). For a large mass matrix they do not contain its symbolic inverse,
which for n coordinates that all depend on each other has about 4^n terms. The factorisation M = L D L^T, as a sequence
of assignments, needs about n^3/6 products. Source: Golub and Van Loan (2013), Matrix computations, section 4.1.
"""

from __future__ import annotations

import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import sympy
from scipy.sparse import csr_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from sympy import Add, Expr, S, Symbol, diff, expand, expand_mul

from codegen.discretise import events
from codegen.discretise.conditions import holonomic, rolling
from codegen.discretise.degenerate import for_method, step_interval
from codegen.discretise.forms import with_symbolic_boundaries
from codegen.discretise.interval import (
    STEP,
    at_nodes,
    repeated,
    variational_interval,
)
from codegen.discretise.model import legendre
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.relations import text
from codegen.discretise.model.values import sample_points
from codegen.discretise.program import ConstraintAtNode, Names, StepProgram, Unknown, symbols
from codegen.discretise.rotations import in_body_frames, in_quaternions, step_with_rotations, velocities_of
from codegen.discretise.schemes.base import Scheme
from codegen.runtime.record import Kind, Meaning
from codegen.symbolic import checks as expressions
from codegen.symbolic import parts
from codegen.symbolic.derivatives import accumulate, gradient, hessian_samples, partials, program_of
from codegen.symbolic.graph import ONE, Assignment, Graph
from codegen.symbolic.zeros import identically_zero

_EXPANSION_LIMIT = 200
"""Greatest number of operations, and of terms, of sums that are expanded to test linearity."""
_PIVOT_LIMIT = 20
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


_WRITTEN_OUT = 3
"""Greatest number of coordinates that the mass matrix couples for which its inverse is written out."""
_PIVOT = 1e-6
"""A pivot below this fraction of the largest entry of its row is postponed."""
_HALF = ONE / 2


@dataclass(frozen=True)
class PhaseFunctions:
    """The velocities dH/dp and the energy H in (q, p, t) and in the symbols of `assignments`, which are in order."""

    assignments: tuple[Assignment, ...]
    velocities: tuple[Expr, ...]
    energy: Expr


def phase_functions(model: Model) -> PhaseFunctions | None:
    """Return velocities and energy by elimination in p = dL/dv; None if the Hamiltonian is to be written out.

    The Hamiltonian is written out if the mass matrix couples at most three coordinates, or depends on velocities, so
    that momenta are not linear in them. The momenta have the names of `legendre.conjugate_symbols`.
    """
    if model.form != "lagrangian" or len(model.coordinates) <= _WRITTEN_OUT:
        return None
    momenta, count = legendre.conjugate_symbols(model), len(model.rates)
    leaves = (*model.rates, *model.coordinates, *momenta)
    graph = Graph(leaves)
    derivatives = accumulate(graph, graph.of(model.function), range(len(leaves)))
    mass = {pair: node for pair, node in derivatives.second.items() if max(pair) < count}
    mass |= {(j, i): node for (i, j), node in mass.items()}
    pattern = sympy.zeros(count, count)
    for index in mass:
        pattern[index] = 1
    largest_block = max(map(len, pattern.connected_components()))
    if not graph.independent(mass.values(), range(count)) or largest_block <= _WRITTEN_OUT:
        return None
    order = _pivots(hessian_samples(model.function, model.rates, sample_points(model)))
    if order is None:
        return None
    still = dict.fromkeys(model.rates, sympy.S.Zero)
    slopes = (slope.xreplace(still) for slope in gradient(model.function, model.rates))
    impulses = [graph.of(p - slope) for p, slope in zip(momenta, slopes, strict=True)]
    at_rest = graph.of(model.function.xreplace(still))
    solver = _Elimination(graph, mass, order)
    kinetic = solver.forward(impulses)
    velocities = solver.backward()
    energy = graph.sum([(kinetic, _HALF), (at_rest, -ONE)])
    program = program_of(graph, [*(velocities[i] for i in range(count)), energy])
    return PhaseFunctions(program.assignments, program.values[:-1], program.values[-1])


def _pivots(samples: Iterable[np.ndarray | None]) -> list[int] | None:
    """Return an order of rows in which no pivot of a symmetric elimination vanishes at one of the samples, or None."""
    for values in samples:
        if values is None:
            continue
        order: list[int] = []
        rows = list(range(len(values)))
        while rows:
            pivot = next((i for i in rows if abs(values[i, i]) > _PIVOT * np.abs(values[i, rows]).max()), None)
            if pivot is None:
                break
            rows.remove(pivot)
            order.append(pivot)
            values = values - np.outer(values[:, pivot], values[pivot]) / values[pivot, pivot]
        else:
            return order
    return None


class _Elimination:
    """The factorisation M = L D L^T of a symmetric matrix of graph nodes, and the solution of M v = y."""

    def __init__(self, graph: Graph, mass: Mapping[tuple[int, int], int], order: Sequence[int]) -> None:
        self.graph = graph
        self.order = list(order)
        self.pivots: dict[int, int] = {}
        self.factors: dict[tuple[int, int], int] = {}
        self.solved: dict[int, int] = {}
        zero = self.graph.sum(())
        for index, i in enumerate(self.order):
            column: dict[int, int] = {}
            for j in self.order[:index]:
                products = [(self.factors[j, k], column[k]) for k in column if (j, k) in self.factors]
                entry = self._reduced(mass.get((i, j), zero), products)
                if entry != zero:
                    column[j] = entry
            for j, entry in column.items():
                self.factors[i, j] = self.graph.product([(entry, ONE), (self.pivots[j], -ONE)])
            self.pivots[i] = self._reduced(mass[i, i], [(self.factors[i, j], entry) for j, entry in column.items()])

    def forward(self, right: Sequence[int]) -> int:
        """Solve L z = y, and return y.v = sum of z_i^2 / d_i."""
        for i in self.order:
            products = [(self.factors[i, j], z) for j, z in self.solved.items() if (i, j) in self.factors]
            self.solved[i] = self._reduced(right[i], products)
        squares = (self.graph.product([(z, ONE * 2), (self.pivots[i], -ONE)]) for i, z in self.solved.items())
        return self.graph.sum((square, ONE) for square in squares)

    def backward(self) -> dict[int, int]:
        """Solve D L^T v = z."""
        solution: dict[int, int] = {}
        for i in reversed(self.order):
            products = [(self.factors[j, i], v) for j, v in solution.items() if (j, i) in self.factors]
            scaled = self.graph.product([(self.solved[i], ONE), (self.pivots[i], -ONE)])
            solution[i] = self._reduced(scaled, products)
        return solution

    def _reduced(self, node: int, products: Sequence[tuple[int, int]]) -> int:
        """Return the node of a value minus the products."""
        return self.graph.sum([(node, ONE), *((self.graph.times(a, b), -ONE) for a, b in products)])


Equation = tuple[str, Expr]


@dataclass(frozen=True)
class _Step:
    """One step: its equations, the formulas behind them (`summary`), their solution, and the initial guesses.

    `multipliers` are the forces of holonomic constraints, without the suffix of a node.
    """

    equations: tuple[Equation, ...]
    summary: tuple[Equation, ...]
    velocities: tuple[tuple[Symbol, Symbol, Symbol, Expr], ...]
    stages: tuple[Symbol, ...]
    solution: Elimination
    guesses: dict[Symbol, Expr]
    multipliers: tuple[Unknown, ...] = ()


def simulate(model: Model, scheme: Scheme, method: str) -> StepProgram:
    """Return the program of an initial value problem, by the "variational", "hamiltonian" or "one-step" method.

    First-order dynamics have no momenta and no energy. Raises SchemeError when the scheme belongs to another method, or
    has inner points beside holonomic constraints; ArgumentError for such constraints in another method; and the errors
    of the Legendre transforms.
    """
    if method != "variational":
        holonomic.refuse(model, method)
    model, start_values = with_symbolic_boundaries(for_method(model, method))
    phase, stepwise = _phase_space(model, method)
    left = (*at_nodes(phase.coordinates, "_k"), *at_nodes(phase.rates, "_k"))
    right = (*at_nodes(phase.coordinates, "_k1"), *at_nodes(phase.rates, "_k1"))
    lengths, part = repeated(scheme)
    constraints, speeds = tuple[ConstraintAtNode, ...](), list[Assignment]()
    assigned = [(w, _at(phase, value, left)) for w, value in stepwise.assignments] if stepwise else []
    if method == "variational":
        lagrangian = legendre.lagrangian_form(model)
        velocities = [_at(phase, v, left) for v in stepwise.velocities] if stepwise else _mean_velocities(phase, left)
        if model.rotations:
            step = _rotating_step(lagrangian, part, left, right, velocities)
            assert stepwise, "rotations have phase functions"
            at_left = [_at(phase, v, left) for v in velocities_of(model, stepwise.velocities, phase.rates)]
        else:
            at_left = velocities if stepwise else rates_of_change(phase, left)[: len(phase.coordinates)]
            step = _variational_step(lagrangian, part, left, right, velocities, at_left)
        speed = Symbol(Names(lagrangian).numbered("speed"), real=True)
        constraints = _constraints(lagrangian, left, at_left, speed)
        speeds = [(speed, sympy.sqrt(Add(*(v**2 for v in at_left))))] if constraints else []
    else:
        step, at_left = _one_step(phase, part, left, right, lengths), []
    is_mechanical = phase.form != "first-order"
    found = events.NONE
    if model.events or model.gaps:
        moving: Sequence[Expr] = left[len(model.coordinates) :]
        if model.form == "lagrangian":
            moving = at_left or rates_of_change(phase, left)[: len(moving)]
        linear = (assigned, moving) if stepwise else None
        held = (*holonomic.rates(model), *model.rolling)
        found = events.at_node(model, events.Rates(model, left, moving, held, Names(model).numbered, linear))
    kind = Kind.COORDINATE if is_mechanical else Kind.STATE
    kinds = [*((kind, q) for q in phase.coordinates), *((Kind.MOMENTUM, p) for p in phase.rates)]
    solution = in_bands(step.solution)
    energy = stepwise.energy if stepwise else phase.function if is_mechanical else model.linear and model.linear.energy
    return StepProgram(
        model=model,
        method=method,
        scheme=scheme.name,
        order=scheme.order,
        state=tuple(Unknown(symbol.name, Meaning(kind, symbol.name)) for kind, symbol in kinds),
        left_symbols=left,
        velocities=step.velocities,
        stage_symbols=step.stages,
        right_symbols=right,
        before=solution.before,
        unknowns=solution.unknowns,
        guess=tuple(step.guesses[y] for y in solution.unknowns),
        residual=solution.residual,
        after=solution.after,
        linear=solution.linear,
        equations=step.equations,
        summary=step.summary,
        energy=None if energy is None else _at(phase, energy, left),
        state_assignments=(*assigned, *speeds),
        start_values=start_values,
        start=tuple(value for value in (*phase.start.positions, *phase.start.rates) if value is not None),
        lengths=lengths,
        fractions=scheme.parts,
        holonomic_multipliers=step.multipliers,
        constraints=constraints,
        events=found.events,
        gaps=found.gaps,
        event_assignments=found.assignments,
    )


def _phase_space(model: Model, method: str) -> tuple[Model, PhaseFunctions | None]:
    """Return the model with momenta, and velocities and energy if they are not those of a Hamiltonian.

    With rotations the velocities are those of positions and the angular velocities of `in_body_frames`.
    """
    if method == "variational" and model.rotations:
        body, phase = in_body_frames(model), legendre.in_phase_space(model)
        functions = phase_functions(body)
        if functions is None:
            energy = legendre.hamiltonian_form(body).function
            momenta = legendre.conjugate_symbols(body)
            functions = PhaseFunctions((), tuple(diff(energy, p) for p in momenta), energy)
        values = in_quaternions(model, phase.rates)
        return phase, PhaseFunctions(
            tuple((w, value.xreplace(values)) for w, value in functions.assignments),
            tuple(v.xreplace(values) for v in functions.velocities),
            functions.energy.xreplace(values),
        )
    stepwise = phase_functions(model) if method == "variational" else None
    return legendre.in_phase_space(model) if stepwise else legendre.hamiltonian_form(model), stepwise


def _constraints(
    model: Model, left: Sequence[Symbol], velocities: Sequence[Expr], speed: Symbol
) -> tuple[ConstraintAtNode, ...]:
    """Return the constraints at the left node, where the coordinates have the given velocities.

    `speed` is the length of the vector of all velocities.

    A rolling constraint A v + b has the value zero, the rate A v + b and the gradient A.
    """
    positions = dict(zip(model.coordinates, left, strict=False))
    at_node = {**positions, **dict(zip(model.rates, velocities, strict=True))}
    at_rest = dict.fromkeys(model.rates, S.Zero)
    held = [
        *(
            (c, c, rate, gradient(c, model.coordinates), diff(c, model.time))
            for c, rate in zip(model.holonomic, holonomic.rates(model), strict=True)
        ),
        *((c, S.Zero, c, rolling.coefficients(model, c), c.xreplace(at_rest)) for c in model.rolling),
    ]
    rows = list[ConstraintAtNode]()
    for c, value, rate, normal, drift in held:
        slopes = tuple(slope.xreplace(positions) for slope in normal)
        rate_at_rest = drift.xreplace(positions)
        scale = speed * sympy.sqrt(Add(*(slope**2 for slope in slopes))) + sympy.sqrt(rate_at_rest**2)
        rows.append(ConstraintAtNode(text(c), value.xreplace(positions), rate.xreplace(at_node), scale, slopes))
    return tuple(rows)


def _variational_step(
    model: Model,
    scheme: Scheme,
    left: Sequence[Symbol],
    right: Sequence[Symbol],
    mean_velocities: Sequence[Expr],
    left_velocities: Sequence[Expr],
) -> _Step:
    interval = variational_interval(model, scheme)
    holonomic.require_no_inner_points(model, interval.inner, scheme.name)
    normal = _NormalForces(model, scheme, right)
    dimension = len(model.coordinates)
    impulses = normal.constraints.force("_k"), normal.constraints.force("_k1")
    transforms = [
        *((p, value - i) for p, value, i in zip(left[dimension:], interval.left_momentum, impulses[0], strict=True)),
        *((p, value + i) for p, value, i in zip(right[dimension:], interval.right_momentum, impulses[1], strict=True)),
    ]
    names = [q.name for q in model.coordinates]
    summary = [("Ld", interval.lagrangian)]
    for mark, forces in (("f-", interval.force_minus), ("f+", interval.force_plus)):
        summary += [(f"{mark}_{name}", f) for name, f in zip(names, forces, strict=True) if f != 0]
    inner = [(f"inner balance of {q}", value) for q, value in zip(interval.inner, interval.inner_balance, strict=True)]
    velocities = at_nodes(model.rates, "_k")
    points = range(1, len(interval.inner) // dimension + 1)
    velocities += tuple(v for i in points for v in at_nodes(model.rates, f"_stage{i}"))
    # Triples: a position at the right node or an inner point, the position at the left node, the time between them.
    differences = [(q1, q, STEP) for q1, q in zip(interval.q.right, interval.q.left, strict=True)]
    for i, (q, c) in enumerate(zip(interval.inner, interval.inner_abscissae, strict=True)):
        differences.append((q, interval.q.left[i % dimension], c * STEP))
    dimension = len(model.coordinates)
    arriving = interval.right_momentum
    if interval.inner:
        # The sum of all equations, without coefficients of velocities: their rounding errors make the energy drift.
        arriving = tuple(p + gained for p, gained in zip(left[dimension:], interval.impulse, strict=True))
    arrival: dict[Symbol, Expr] = {
        q1: q + STEP * v for q1, q, v in zip(interval.q.right, interval.q.left, velocities, strict=False)
    }
    inside = zip(interval.inner, interval.inner_abscissae, velocities[dimension:], strict=True)
    for i, (q, c, v) in enumerate(inside):
        arrival[q] = interval.q.left[i % dimension] + c * STEP * v

    def in_velocities(momentum: Expr) -> Expr:
        # (q_k1 - q_k)/h stays one sum, so that sympy cancels q_k and v_k remains.
        terms = Add.make_args(momentum.xreplace(arrival))
        return Add(*(expand_mul(term, deep=False) if term.has(1 / STEP) else term for term in terms))

    leaving, gained = (list(map(normal.in_impulses, side)) for side in impulses)
    equations = [
        *(p + i - in_velocities(m) for p, i, m in zip(left[dimension:], leaving, interval.left_momentum, strict=True)),
        *(in_velocities(value) for value in interval.inner_balance),
        *(q1 - value for q1, value in arrival.items()),
        *(p - i - in_velocities(value) for p, i, value in zip(right[dimension:], gained, arriving, strict=True)),
        *normal.solved(in_velocities),
    ]
    unknowns = (*velocities, *arrival, *right[dimension:], *normal.unknowns)
    guesses = dict(zip(velocities, list(mean_velocities) * (1 + len(points)), strict=True))
    if model.holonomic or model.rolling:  # elimination may leave any of the unknowns
        guesses |= {q1: q + STEP * v for q1, q, v in zip(right, left, mean_velocities, strict=False)}
        guesses |= dict(zip(right[dimension:], left[dimension:], strict=True))
        guesses |= dict.fromkeys(normal.unknowns, S.Zero) | dict(zip(normal.velocities, left_velocities, strict=True))
    written = [*inner, *normal.equations]
    return _Step(
        equations=(*written, *((p.name, p - momentum) for p, momentum in transforms)),
        summary=(
            *summary,
            *((f"0 = {name}", value) for name, value in written),
            *((p.name, momentum) for p, momentum in transforms),
        ),
        velocities=tuple((v, *d) for v, d in zip(velocities, differences, strict=True)),
        stages=(*interval.inner, *normal.stages),
        solution=eliminate(equations, unknowns, model.parameters),
        guesses=guesses,
        multipliers=normal.constraints.kappa,
    )


def _rotating_step(
    model: Model, scheme: Scheme, left: Sequence[Symbol], right: Sequence[Symbol], left_rates: Sequence[Expr]
) -> _Step:
    step = step_with_rotations(model, scheme, left, right, left_rates)
    return _Step(
        equations=step.written,
        summary=tuple((f"0 = {name}", value) for name, value in step.written),
        velocities=(),
        stages=step.stages,
        solution=eliminate(step.equations, step.unknowns, model.parameters),
        guesses=step.guesses,
    )


class _NormalForces:
    """The forces kappa of constraints at both nodes of a step, and the velocities at the right node.

    `equations` of the scheme, with names, determine the `stages`: kappa at the left node, velocities and kappa at the
    right node. `solved` returns equations for the `unknowns` in the same order, for an elimination.
    """

    def __init__(self, model: Model, scheme: Scheme, right: Sequence[Symbol]) -> None:
        names, dimension = Names(model), len(model.coordinates)
        self.constraints = holonomic.Constraints(model, names)
        multipliers = [unknown.name for unknown in self.constraints.kappa]
        forces = [symbols(multipliers, suffix) for suffix in ("_k", "_k1")]
        numbered = [names.numbered("impulse") for _ in multipliers]
        impulses = [symbols(numbered, suffix) for suffix in ("_k", "_k1")]
        moving = model.coordinates if multipliers else ()
        self.velocities = symbols([names.named("velocity", q) for q in moving], "_k1")
        at_right: dict[Symbol, Expr] = dict(zip(model.coordinates, right, strict=False))
        at_right |= dict(zip(model.rates, self.velocities, strict=False))
        at_right[model.time] = model.time + STEP
        self._positions = [c.xreplace(at_right) for c in model.holonomic]
        self._means = rolling.discrete(model, scheme) if model.rolling else []
        self._rates = [rate.xreplace(at_right) for rate in (*holonomic.rates(model), *model.rolling)]
        momenta = [value.xreplace(at_right) for value in gradient(model.function, model.rates)]
        transforms = [p - value for p, value in zip(right[dimension:], momenta, strict=True)] if multipliers else []
        self._transforms = transforms
        self.stages = (*forces[0], *self.velocities, *forces[1])
        holding = [*(f"constraint {text(c)}" for c in model.holonomic), *(f"mean of {text(c)}" for c in model.rolling)]
        leaving = [*(f"rate of constraint {text(c)}" for c in model.holonomic), *(text(c) for c in model.rolling)]
        self.equations = [
            *zip(holding, (*self._positions, *self._means), strict=True),
            *((f"{v} of momenta", value) for v, value in zip(self.velocities, transforms, strict=True)),
            *zip(leaving, self._rates, strict=True),
        ]
        self._impulses: dict[Symbol, Expr] = {
            kappa: 2 * impulse / STEP
            for pair in zip(forces, impulses, strict=True)
            for kappa, impulse in zip(*pair, strict=True)
        }
        self.unknowns = (*impulses[0], *self.velocities, *impulses[1], *self._impulses)

    def solved(self, in_velocities: Callable[[Expr], Expr]) -> list[Expr]:
        """Return the equations for the unknowns; the function replaces differences of positions by velocities."""
        return [
            *(value / STEP for value in self._positions),
            *map(in_velocities, self._means),
            *self._transforms,
            *self._rates,
            *(kappa - value for kappa, value in self._impulses.items()),
        ]

    def in_impulses(self, expression: Expr) -> Expr:
        """Return an expression of forces kappa in terms of the impulses h/2 kappa."""
        return expression.xreplace(self._impulses)


def _one_step(
    phase: Model,
    scheme: Scheme,
    left: Sequence[Symbol],
    right: Sequence[Symbol],
    lengths: Sequence[Symbol],
) -> _Step:
    interval = step_interval(phase, scheme)
    unknowns = (*interval.stages, *right)
    equations = tuple((f"step of {y}", e) for y, e in zip(unknowns, interval.equations, strict=True))
    # The initial guesses of stages and of the right node are explicit Euler steps from the left node.
    rates = {x.name: (x, rate) for x, rate in zip(left, rates_of_change(phase, left), strict=True)}
    step, guesses = scheme.step(), dict[Symbol, Expr]()
    abscissae = step.abscissae
    if phase.linear and phase.linear.pairs:
        abscissae = (*(point.abscissa for point in step.points), abscissae[-1])
    for y in unknowns:
        stage = re.search(r"_stage(\d+)$", y.name)
        c = abscissae[int(stage[1]) - 1] if stage else abscissae[-1]
        x, rate = rates[f"{y.name[: stage.start()] if stage else y.name.removesuffix('_k1')}_k"]
        guesses[y] = x + sympy.expand(c * STEP) * rate
    longest = _PIVOT_LIMIT if phase.form == "first-order" else None
    return _Step(
        equations=equations,
        summary=tuple((f"0 = {name}", value) for name, value in equations),
        velocities=(),
        stages=interval.stages,
        solution=eliminate(interval.equations, unknowns, (*phase.parameters, *lengths), longest),
        guesses=guesses,
    )


def _mean_velocities(phase: Model, left: Sequence[Symbol]) -> list[Expr]:
    """Return guesses of the mean velocities of a step: at the left node, or half a step later if that is cheap."""
    dimension = len(phase.coordinates)
    rates = rates_of_change(phase, left)
    velocities, slopes = rates[:dimension], rates[dimension:]
    if any(velocity.has(*left[:dimension]) for velocity in velocities):
        return velocities
    momenta = left[dimension:]
    later = {p: p + STEP * slope / 2 for p, slope in zip(momenta, slopes, strict=True)}
    return [velocity.xreplace(later) for velocity in velocities]


def rates_of_change(phase: Model, left: Sequence[Symbol]) -> list[Expr]:
    """Return the time derivatives of the state at the left node: of (q, p), or of x in first-order dynamics."""
    if phase.form == "first-order":
        return [_at(phase, rate, left) for rate in phase.dynamics]
    slopes = partials(phase.function, (*phase.coordinates, *phase.rates))
    velocity = [slopes.get(p, S.Zero) for p in phase.rates]
    slope = [f - slopes.get(q, S.Zero) for q, f in zip(phase.coordinates, phase.force, strict=True)]
    return [_at(phase, value, left) for value in (*velocity, *slope)]


def _at(phase: Model, expression: Expr, left: Sequence[Symbol]) -> Expr:
    return expression.xreplace(dict(zip((*phase.coordinates, *phase.rates), left, strict=True)))
