"""Control task -> ControlProgram: the scalar whose stationarity over all intervals is the optimal-control problem.

Variational method: l = Cd + lambda_k . (D1 Ld + f-) + lambda_k1 . (D2 Ld + f+). Summed over intervals the
multipliers of a node meet both halves of its forced discrete Euler-Lagrange equation; at the two end nodes the
momentum boundary conditions (thesis (3.1.3)) arise once lambda_0 . p(0) and -lambda_N . p(T) are added.

Hamiltonian method: l = Cd + mu_k . r_k with the equations r_k of one step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import sympy
from sympy import Expr, Symbol

from codegen import legendre
from codegen.discretise import at_nodes, one_step_interval, variational_interval
from codegen.model import Boundary, Model
from codegen.schemes import DiscreteLagrangian, OneStep
from codegen.transcribe.boundary import with_symbolic_boundaries
from codegen.transcribe.program import ControlProgram, EndElement, Unknown

DURATION = Symbol("duration", positive=True)
"""The length of the whole time interval, in guesses."""


def variational(model: Model, scheme: DiscreteLagrangian, nodal_controls: bool) -> ControlProgram:
    """Transcribe with unknowns q and lambda on nodes and u on intervals (or nodes)."""
    model, boundary_values = with_symbolic_boundaries(legendre.lagrangian_form(model))
    interval = variational_interval(model, scheme, nodal_controls)
    names = [q.name for q in model.coordinates]
    multipliers = [f"lambda_{name}" for name in names]
    ends = _Ends(_momentum_end(model, model.start, "_k", 1), _momentum_end(model, _end(model), "_k1", -1))
    nodal = _control_unknowns(model) if nodal_controls else ()
    pairs = zip(multipliers, names, strict=True)
    node = (
        *(Unknown(name, f"coordinate {name}") for name in names),
        *(Unknown(m, f"multiplier of the equation of motion of {name}", True) for m, name in pairs),
        *ends.extra,
        *nodal,
    )
    left_lambda, right_lambda = _symbols(multipliers, "_k"), _symbols(multipliers, "_k1")
    left_half = [-p for p in interval.left_momentum]
    right_half = list(interval.right_momentum)
    element = (
        interval.cost
        + sum(m * e for m, e in zip(left_lambda, left_half, strict=True))
        + sum(m * e for m, e in zip(right_lambda, right_half, strict=True))
        + ends.filling()
    )
    left = (*interval.q.left, *left_lambda, *ends.symbols("_k"), *(interval.q.left_controls if nodal_controls else ()))
    right = (
        *(*interval.q.right, *right_lambda, *ends.symbols("_k1")),
        *(interval.q.right_controls if nodal_controls else ()),
    )
    return ControlProgram(
        model=model,
        method="variational",
        scheme=scheme.name,
        nodal_controls=nodal_controls,
        node=node,
        interval=(),
        controls=() if nodal_controls else _control_unknowns(model),
        left_symbols=left,
        interval_symbols=(),
        control_symbols=() if nodal_controls else interval.q.left_controls,
        right_symbols=right,
        element=element,
        cost=interval.cost,
        equations=(
            ("Ld", interval.lagrangian),
            *((f"f-_{n}", f) for n, f in zip(names, interval.force_minus, strict=True) if f != 0),
            *((f"f+_{n}", f) for n, f in zip(names, interval.force_plus, strict=True) if f != 0),
            ("Cd", interval.cost),
        ),
        boundary_values=boundary_values,
        node_guess=_coordinate_guess(model),
        stage_guess=(),
        control_guess=_control_guess(model),
        only_at_ends=tuple(range(2 * len(names), 2 * len(names) + len(ends.extra))),
        start=ends.start_element(2 * len(names)),
        end=ends.end_element(2 * len(names), element, right),
    )


def hamiltonian(model: Model, scheme: OneStep, nodal_controls: bool) -> ControlProgram:
    """Transcribe with unknowns q and p on nodes, stages, mu and u on intervals (or u on nodes)."""
    model, boundary_values = with_symbolic_boundaries(model)
    free = Boundary((None,) * len(model.coordinates), (None,) * len(model.coordinates))
    phase = legendre.hamiltonian_form(replace(model, start=free, end=free))
    interval = one_step_interval(phase, scheme, nodal_controls)
    names = [s.name for s in (*phase.coordinates, *phase.rates)]
    stage_names = [s.name for s in interval.stages]
    equation_names = [*stage_names, *names]
    multipliers = [f"mu_{name}" for name in equation_names]
    known = {*model.parameters, *(value.symbol for value in boundary_values)}
    ends = _Ends(
        _phase_end(model, phase, model.start, "_k", known), _phase_end(model, phase, _end(model), "_k1", known)
    )
    nodal = _control_unknowns(model) if nodal_controls else ()
    mu = _symbols(multipliers, "_k")
    state_guess = (*_coordinate_guess(model), *_momentum_guess(model))
    element = interval.cost + sum(m * r for m, r in zip(mu, interval.equations, strict=True)) + ends.filling()
    kinds = ["coordinate"] * len(phase.coordinates) + ["momentum"] * len(phase.rates)
    node = (*(Unknown(n, f"{kind} {n}") for n, kind in zip(names, kinds, strict=True)), *ends.extra, *nodal)
    left = (
        *(*interval.q.left, *interval.p.left, *ends.symbols("_k")),
        *(interval.q.left_controls if nodal_controls else ()),
    )
    right = (
        *(*interval.q.right, *interval.p.right, *ends.symbols("_k1")),
        *(interval.q.right_controls if nodal_controls else ()),
    )
    return ControlProgram(
        model=phase,
        method="hamiltonian",
        scheme=scheme.name,
        nodal_controls=nodal_controls,
        node=node,
        interval=(
            *(Unknown(n, f"stage value {n}") for n in stage_names),
            *(
                Unknown(m, f"multiplier of the step of {n}", True)
                for m, n in zip(multipliers, equation_names, strict=True)
            ),
        ),
        controls=() if nodal_controls else _control_unknowns(model),
        left_symbols=left,
        interval_symbols=(*interval.stages, *mu),
        control_symbols=() if nodal_controls else interval.q.left_controls,
        right_symbols=right,
        element=element,
        cost=interval.cost,
        equations=(
            *(("0", r) for r in interval.equations),
            ("Cd", interval.cost),
        ),
        boundary_values=boundary_values,
        node_guess=state_guess,
        stage_guess=state_guess * (len(interval.stages) // len(names)),
        control_guess=_control_guess(model),
        only_at_ends=tuple(range(len(names), len(names) + len(ends.extra))),
        start=ends.start_element(len(names)),
        end=ends.end_element(len(names), element, right),
    )


@dataclass(frozen=True)
class _End:
    """Pins, own unknowns, own share of the Lagrangian and conditions of one end."""

    pins: tuple[tuple[int, Expr], ...]
    extra: tuple[Unknown, ...]
    element: Expr
    conditions: tuple[tuple[str, Expr], ...]


@dataclass(frozen=True)
class _Ends:
    """Both ends, whose own unknowns become unknowns of every node, with value zero wherever they have no meaning."""

    start: _End
    end: _End

    @property
    def extra(self) -> tuple[Unknown, ...]:
        named = {unknown.name: unknown for unknown in (*self.start.extra, *self.end.extra)}
        return tuple(named.values())

    def symbols(self, suffix: str) -> tuple[Symbol, ...]:
        return _symbols([unknown.name for unknown in self.extra], suffix)

    def filling(self) -> Expr:
        """A share of every interval's l that makes the end's unknowns vanish at its left node."""
        return sum((symbol**2 / 2 for symbol in self.symbols("_k")), sympy.S.Zero)

    def start_element(self, first: int) -> EndElement:
        """The start's share; own unknowns of the end, the first of which is at place `first`, are pinned."""
        own = {unknown.name for unknown in self.start.extra}
        element = self.start.element - sum((symbol**2 / 2 for symbol in _symbols(sorted(own), "_k")), sympy.S.Zero)
        pins = [(first + i, sympy.S.Zero) for i, unknown in enumerate(self.extra) if unknown.name not in own]
        return EndElement((*self.start.pins, *pins), element, self.start.conditions)

    def end_element(self, first: int, element: Expr, right: Sequence[Symbol]) -> EndElement:
        """The end's share; pins what has no meaning at the last node, of which `first` is the place of own unknowns.

        Besides unknowns of the start these are controls that no interval reads (nodal ones in a one-sided scheme).
        """
        own = {unknown.name for unknown in self.end.extra}
        pins = [(first + i, sympy.S.Zero) for i, unknown in enumerate(self.extra) if unknown.name not in own]
        controls = range(first + len(self.extra), len(right))
        pins += [(i, sympy.S.Zero) for i in controls if right[i] not in element.free_symbols]
        return EndElement((*self.end.pins, *pins), self.end.element, self.end.conditions)


def _momentum_end(model: Model, boundary: Boundary, suffix: str, sign: int) -> _End:
    """Fix positions; match the discrete momentum with D2 L(q, v) wherever a velocity is fixed.

    Free velocities on which a matched momentum depends (through the mass matrix) become unknowns of this end, and
    their momenta are matched too, so that each fixed velocity costs exactly one condition.
    """
    dimension = len(model.coordinates)
    momentum = [sympy.diff(model.function, v) for v in model.rates]
    matched = {i for i in range(dimension) if boundary.rates[i] is not None}
    extra: set[int] = set()
    while True:
        coupled = {j for i in matched for j in range(dimension) if momentum[i].has(model.rates[j])}
        missing = {j for j in coupled if boundary.rates[j] is None} - extra
        if not missing:
            break
        extra |= missing
        matched |= missing
    here = _symbols([q.name for q in model.coordinates], suffix)
    multipliers = _symbols([f"lambda_{q.name}" for q in model.coordinates], suffix)
    extra_symbols = tuple(Symbol(f"{model.rates[j].name}{suffix}", real=True) for j in sorted(extra))
    velocity = {v: value for v, value in zip(model.rates, boundary.rates, strict=True) if value is not None}
    velocity |= dict(zip((model.rates[j] for j in sorted(extra)), extra_symbols, strict=True))
    place = dict(zip(model.coordinates, here, strict=True))
    matched_momenta = [(i, momentum[i].subs({**place, **velocity}, simultaneous=True)) for i in sorted(matched)]
    pins = [(i, value) for i, value in enumerate(boundary.positions) if value is not None]
    pins += [(dimension + i, sympy.S.Zero) for i in range(dimension) if i not in matched]
    return _End(
        pins=tuple(pins),
        extra=tuple(Unknown(model.rates[j].name, f"velocity {model.rates[j].name} at an end") for j in sorted(extra)),
        element=sum((sign * multipliers[i] * p for i, p in matched_momenta), sympy.S.Zero),
        conditions=tuple((f"p_{model.coordinates[i].name}", p) for i, p in matched_momenta),
    )


def _phase_end(model: Model, phase: Model, boundary: Boundary, suffix: str, known: set[Symbol]) -> _End:
    """Fix positions and momenta; velocities that do not fix a momentum by themselves become equations."""
    dimension = len(model.coordinates)
    pins = [(i, value) for i, value in enumerate(boundary.positions) if value is not None]
    fixed_positions = {q: v for q, v in zip(model.coordinates, boundary.positions, strict=True) if v is not None}
    fixed_rates = {v: x for v, x in zip(model.rates, boundary.rates, strict=True) if x is not None}
    quantities = (*phase.coordinates, *phase.rates)
    node = dict(zip(quantities, _symbols([s.name for s in quantities], suffix), strict=True))
    names, terms, conditions = [], [], []
    for i, value in enumerate(boundary.rates):
        if value is None:
            continue
        momentum = value
        if model.form == "lagrangian":
            momentum = sympy.diff(model.function, model.rates[i]).subs(
                {**fixed_positions, **fixed_rates}, simultaneous=True
            )
        if momentum.free_symbols <= known:
            pins.append((dimension + i, momentum))
            conditions.append((phase.rates[i].name, momentum))
            continue
        velocity = sympy.diff(phase.function, phase.rates[i]).subs(node, simultaneous=True)
        names.append(f"nu_{model.rates[i].name}")
        terms.append(velocity - value)
        conditions.append((model.rates[i].name, velocity))
    symbols = _symbols(names, suffix)
    return _End(
        pins=tuple(pins),
        extra=tuple(Unknown(n, f"multiplier of the condition on {n.removeprefix('nu_')}", True) for n in names),
        element=sum((nu * term for nu, term in zip(symbols, terms, strict=True)), sympy.S.Zero),
        conditions=tuple(conditions),
    )


def _control_unknowns(model: Model) -> tuple[Unknown, ...]:
    return tuple(Unknown(u.name, f"control {u.name}") for u in model.controls)


def _symbols(names: Sequence[str], suffix: str) -> tuple[Symbol, ...]:
    return at_nodes([Symbol(name) for name in names], suffix)


def _end(model: Model) -> Boundary:
    assert model.end is not None, "a control problem has an end"
    return model.end


def _coordinate_guess(model: Model) -> tuple[Expr, ...]:
    """The author's guess for each coordinate as a function of time, else the straight line between its end values."""
    given = dict(model.guess)
    end = _end(model)
    return tuple(
        given.get(q, _line(model, first, last))
        for q, first, last in zip(model.coordinates, model.start.positions, end.positions, strict=True)
    )


def _momentum_guess(model: Model) -> tuple[Expr, ...]:
    """Momenta along the guessed motion (Lagrangian form), or straight lines between their end values."""
    if model.form == "hamiltonian":
        pairs = zip(model.start.rates, _end(model).rates, strict=True)
        return tuple(_line(model, first, last) for first, last in pairs)
    motion = _coordinate_guess(model)
    values = dict(zip(model.coordinates, motion, strict=True))
    values |= {v: sympy.diff(q, model.time) for v, q in zip(model.rates, motion, strict=True)}
    return tuple(sympy.diff(model.function, v).subs(values, simultaneous=True) for v in model.rates)


def _control_guess(model: Model) -> tuple[Expr, ...]:
    given = dict(model.guess)
    return tuple(given.get(u, sympy.S.Zero) for u in model.controls)


def _line(model: Model, first: Expr | None, last: Expr | None) -> Expr:
    if first is None or last is None:
        return first if first is not None else last if last is not None else sympy.S.Zero
    return first + (last - first) * model.time / DURATION
