"""Equations of motion and everything beside them -> ControlProgram."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

from sympy import Expr, S, Symbol

from codegen.discretise.conditions.ends import End, Ends, pinned_at_zero, with_bounds
from codegen.discretise.conditions.inner_times import Clock, InnerTerms, clock_of, inner_terms
from codegen.discretise.conditions.integral import end_share, integral_equations, interval_share, own_unknowns
from codegen.discretise.conditions.linking import Shared
from codegen.discretise.conditions.measurements import sample_element
from codegen.discretise.conditions.path import NodalTerms, bounded_stages, interval_terms, stage_inequalities
from codegen.discretise.determined_values import with_determined_inner_values, with_determined_values
from codegen.discretise.interval import STEP, OneStepInterval, VariationalInterval, at_nodes
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.guesses import at_guess, control_guess, inner_guess
from codegen.discretise.program import BoundaryValue, ControlProgram, EndElement, InnerTimes, Names, Unknown, symbols
from codegen.errors import ExpressionError
from codegen.runtime.record import Kind, Meaning


@dataclass(frozen=True)
class Motion:
    """The discrete equations of motion: unknowns of nodes and intervals, their share of l, what the scheme made.

    The symbols of a node's unknowns in `element` are their names with suffix `_k` and `_k1`. `left_rates` makes the
    rates at the left node of an interval.
    """

    method: str
    scheme: str
    node: tuple[Unknown, ...]
    interval: tuple[Unknown, ...]
    interval_symbols: tuple[Symbol, ...]
    discrete: VariationalInterval | OneStepInterval
    element: Expr
    equations: tuple[tuple[str, Expr], ...]
    node_guess: tuple[Expr, ...]
    left_rates: Callable[[], tuple[Expr, ...]]
    stage_guess: tuple[Expr, ...] = ()


def assemble(
    model: Model,
    motion: Motion,
    boundary_values: tuple[BoundaryValue, ...],
    nodal: NodalTerms,
    start: End,
    end: End,
    shared: Shared,
    names: Names,
) -> ControlProgram:
    """Lay out all unknowns, and add up the shares of the interval and of both ends."""
    clock = clock_of(model, names)
    if clock is not None:
        motion, start, end = _with_clock(motion, clock), start + clock.start(), end + clock.end(names)
    inner = inner_terms(model, lambda expression: _at_left_node(model, motion, expression), names, clock)
    nodal += inner.nodal
    integrals = integral_equations(model, names)
    ends = Ends(
        start + End(aliases=shared.start_aliases) + pinned_at_zero(nodal.start_pins),
        end + End(aliases=shared.end_aliases) + end_share(integrals) + pinned_at_zero(nodal.end_pins),
    )
    quadratures = motion.discrete.integrals
    inside = motion.discrete.inside
    motion = replace(motion, interval=bounded_stages(model, inside, motion.interval))
    path = interval_terms(
        model, (*motion.discrete.path, *stage_inequalities(model, inside)), len(motion.interval), names
    )
    motion = replace(motion, element=motion.element + path.element + interval_share(integrals, quadratures))
    program = _laid_out(model, motion, boundary_values, nodal, ends)
    program = _with_shared(program, replace(shared, own=(*shared.own, *own_unknowns(integrals))))
    shares = ((f"Gd_{i}", value) for i, value in enumerate(quadratures, start=1))
    program = replace(
        program,
        start=ends.start_element(program.node, program.shared),
        end=ends.end_element(program.node, program.shared, _idle_controls(program)),
    )
    program = replace(
        program,
        interval=(*program.interval, *path.multipliers),
        interval_symbols=(*program.interval_symbols, *symbols([y.name for y in path.multipliers], "_k")),
        equations=(*program.equations, *path.equations, *nodal.equations, *shares),
        path_multipliers=len(path.multipliers),
        integrals=integrals,
        inner=_placed(program, inner, motion, len(motion.node) + len(nodal.unknowns)),
        sample=sample_element(model, motion.discrete.observed, names),
        slacks=path.slacks,
        slack_symbols=symbols([slack.name for slack in path.slacks], "_k"),
        slack_multipliers=path.slack_multipliers,
    )
    _require_identical_bodies(program)
    program = with_determined_values(program, path.inequalities)
    return with_determined_inner_values(program, path.inequalities)


def _laid_out(
    model: Model,
    motion: Motion,
    boundary_values: tuple[BoundaryValue, ...],
    nodal: NodalTerms,
    ends: Ends,
) -> ControlProgram:
    """The unknowns of nodes and intervals and the share of an interval; the ends' own shares are still empty."""
    before = with_bounds((*motion.node, *nodal.unknowns), model)
    sites = motion.discrete.q
    controls = _controls(model, len(sites.stage_controls))
    node = (*before, *ends.extra, *(controls if sites.nodal else ()))
    empty = EndElement((), S.Zero, ())
    return ControlProgram(
        model=model,
        method=motion.method,
        scheme=motion.scheme,
        controlled=sites.controlled,
        node=node,
        interval=motion.interval,
        controls=() if sites.nodal else controls,
        left_symbols=symbols([unknown.name for unknown in node], "_k"),
        interval_symbols=motion.interval_symbols,
        control_symbols=() if sites.nodal else sites.of_interval,
        right_symbols=symbols([unknown.name for unknown in node], "_k1"),
        element=motion.element + nodal.element + ends.filling(),
        cost=motion.discrete.cost,
        equations=motion.equations,
        boundary_values=boundary_values,
        node_guess=motion.node_guess,
        stage_guess=motion.stage_guess,
        control_guess=control_guess(model) * max(1, len(sites.stage_controls)),
        only_at_ends=tuple(range(len(before), len(before) + len(ends.extra))),
        start=empty,
        end=empty,
    )


def _at_left_node(model: Model, motion: Motion, expression: Expr) -> Expr:
    """An expression in coordinates and rates at the left node of an interval, in the symbols there."""
    left: dict[Symbol, Expr] = dict(zip(model.coordinates, at_nodes(model.coordinates, "_k"), strict=True))
    if expression.has(*model.rates):
        left |= dict(zip(model.rates, motion.left_rates(), strict=True))
    return expression.subs(left, simultaneous=True)


def _with_clock(motion: Motion, clock: Clock) -> Motion:
    """The motion with times of its own, behind its own unknowns."""
    guess = (*motion.node_guess, *(S.Zero for _ in motion.node[len(motion.node_guess) :]), *clock.guess)
    return replace(
        motion,
        node=(*motion.node, *clock.node),
        node_guess=guess,
        interval=(*motion.interval, *clock.interval),
        interval_symbols=(*motion.interval_symbols, *symbols(clock.multipliers, "_k")),
    )


def _placed(program: ControlProgram, inner: InnerTerms, motion: Motion, behind: int) -> InnerTimes:
    """With indices of unknowns in a node, where those of inner times are the last before `behind`."""
    pinned = [[i for i, _ in end.pins] for end in (program.start, program.end)]
    first, times = behind - len(inner.nodal.unknowns), inner.times
    return replace(
        times,
        unknowns=tuple(first + i for i in times.unknowns),
        multipliers=tuple((name, time, first + i) for name, time, i in times.multipliers),
        guess=tuple((i, values, i in pinned[0], i in pinned[1]) for i, values in inner_guess(program.model)),
        clock=len(motion.node) - 2 if times.scales else None,
        lacking=(len(motion.interval) - 1,) if times.scales else (),
    )


def _controls(model: Model, stages: int) -> tuple[Unknown, ...]:
    """The controls of an interval or a node, or of each stage of an interval, with their bounds."""
    once = with_bounds([Unknown(u.name, Meaning(Kind.CONTROL, u.name)) for u in model.controls], model)
    return (
        tuple(
            replace(u, name=f"{u.name}_stage{i}", meaning=Meaning(Kind.STAGE_CONTROL, u.meaning.of, i))
            for i in range(1, stages + 1)
            for u in once
        )
        or once
    )


def _with_shared(program: ControlProgram, shared: Shared) -> ControlProgram:
    return replace(
        program,
        shared=tuple(own.unknown for own in shared.all),
        shared_symbols=tuple(own.symbol for own in shared.all),
        shared_guess=tuple(at_guess(program.model, own.guess) for own in shared.all),
        own=len(shared.own),
        bodies=program.model.bodies,
        body=program.model.body,
        couplings=shared.couplings,
        redundant_couplings=shared.redundant,
        coupling_symbols=shared.coupling_symbols,
    )


def _idle_controls(program: ControlProgram) -> list[str]:
    """Nodal controls at the last node that no interval reads, because a one-sided scheme takes those of the left."""
    if not program.nodal_controls:
        return []
    first = len(program.node) - len(program.model.controls)
    pairs = zip(program.node[first:], program.right_symbols[first:], strict=True)
    return [unknown.name for unknown, symbol in pairs if symbol not in program.element.free_symbols]


def in_scaled_time(program: ControlProgram) -> ControlProgram:
    """Measure t and h in fractions of a duration that is optimised along: h -> D h and t -> D t everywhere.

    Where nodes have times of their own, these tell what t and h are on an interval.
    """
    model, clock = program.model, dict(program.inner.scales)
    if not clock and not model.duration.free_symbols & {parameter.symbol for parameter in model.free_parameters}:
        return program
    scales = _scales(model)
    on_interval = clock or scales

    def pairs(
        written: Sequence[tuple[str, Expr]], scales: Mapping[Symbol, Expr] = scales
    ) -> tuple[tuple[str, Expr], ...]:
        return tuple((name, value.xreplace(scales)) for name, value in written)

    def end(element: EndElement) -> EndElement:
        return replace(
            element,
            element=element.element.xreplace(scales),
            cost=element.cost.xreplace(scales),
            conditions=pairs(element.conditions),
        )

    return replace(
        program,
        element=program.element.xreplace(on_interval),
        cost=program.cost.xreplace(on_interval),
        equations=pairs(program.equations, on_interval),
        start=end(program.start),
        end=end(program.end),
        scaled_time=True,
    )


def scaled_in_time(model: Model, expression: Expr) -> Expr:
    """An expression of t and h in which both are fractions of the duration."""
    return expression.xreplace(_scales(model))


def _scales(model: Model) -> dict[Symbol, Expr]:
    return {STEP: model.duration * STEP, model.time: model.duration * model.time}


def _require_identical_bodies(program: ControlProgram) -> None:
    """Only fixed numbers may differ from body to body."""
    body: Symbol | None = program.body
    shares = {
        "dynamics, cost or path": program.element,
        "conditions at the start": program.start.element,
        "conditions at the end or the terminal cost": program.end.element,
    }
    for what, share in shares.items():
        if body is not None and share.has(body):
            raise ExpressionError(
                f"{what} depend on the body's number", "use it in boundary values, bounds and guesses only"
            )
