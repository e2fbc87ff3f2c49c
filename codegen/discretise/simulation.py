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

`elimination` leaves to Newton's method only the unknowns without a symbolic solution.

Velocities and energy are functions of a state (q, p). For a large mass matrix they do not contain its symbolic inverse,
which for n coordinates that all depend on each other has about 4^n terms. The factorisation M = L D L^T, as a sequence
of assignments, needs about n^3/6 products. Source: Golub and Van Loan (2013), Matrix computations, section 4.1.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import sympy
from sympy import Add, Expr, S, Symbol, diff, expand_mul

from codegen.discretise import events
from codegen.discretise.conditions import holonomic, rolling
from codegen.discretise.degenerate import for_method, step_interval
from codegen.discretise.elimination import PIVOT_LIMIT, Elimination, eliminate, in_bands
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
from codegen.symbolic.derivatives import accumulate, gradient, hessian_samples, partials, program_of
from codegen.symbolic.graph import ONE, Assignment, Graph

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
    longest = PIVOT_LIMIT if phase.form == "first-order" else None
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
