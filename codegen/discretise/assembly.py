"""Assembly of a control program from the equations of motion, all conditions and the cost."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from sympy import Add, Expr, S, Symbol

from codegen.discretise import schemes
from codegen.discretise.conditions.ends import End, indexed, pinned_at_zero, with_bounds
from codegen.discretise.conditions.inner_times import clock_of, inner_terms
from codegen.discretise.conditions.integral import end_share, integral_equations, own_unknowns
from codegen.discretise.conditions.linking import Shared
from codegen.discretise.conditions.measurements import sample_element
from codegen.discretise.conditions.path import NodalTerms, bounded_stages, interval_terms, stage_inequalities
from codegen.discretise.determined_values import with_determined_values
from codegen.discretise.interval import STEP, OneStepInterval, PathValue, VariationalInterval, at_nodes
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.guesses import DURATION, at_guess, inner_guess
from codegen.discretise.program import (
    BoundaryValue,
    ControlProgram,
    EndElement,
    Equation,
    InitialGuess,
    LinkingVariables,
    Names,
    Unknown,
    in_scales,
    symbols,
)
from codegen.errors import ExpressionError
from codegen.runtime.record import Kind, Meaning


@dataclass(frozen=True)
class Motion:
    """The discrete equations of motion: unknowns of nodes and intervals, and expressions of the scheme.

    `element` is the contribution of an interval to the Lagrangian of the optimisation problem. In it, the unknowns of
    nodes have the suffixes `_k` and `_k1`. `left_rates` returns the rates at the left node of an interval. `contacts`
    are the inequalities of contact forces.
    """

    method: str
    scheme: str
    node: tuple[Unknown, ...]
    interval: tuple[Unknown, ...]
    interval_symbols: tuple[Symbol, ...]
    discrete: VariationalInterval | OneStepInterval
    element: Expr
    equations: tuple[Equation, ...]
    node_guess: tuple[Expr, ...]
    left_rates: Callable[[], tuple[Expr, ...]]
    stage_guess: tuple[Expr, ...] = ()
    stage_times: tuple[Expr, ...] = ()
    contacts: tuple[PathValue, ...] = ()


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
    """Return the program: the layout of all unknowns, and the sums of all terms of the interval and of both ends."""
    clock = clock_of(model, names)
    if clock is not None:
        start, end = start + clock.start, end + clock.end
        zeros = (S.Zero,) * len(motion.node[len(motion.node_guess) :])
        motion = replace(
            motion,
            node=(*motion.node, *clock.node),
            node_guess=(*motion.node_guess, *zeros, model.time, DURATION),  # intervals of the same length
            interval=(*motion.interval, *clock.interval),
            interval_symbols=(*motion.interval_symbols, *symbols([mu.name for mu in clock.interval], "_k")),
        )

    def at_left_node(expression: Expr) -> Expr:
        """Return an expression of coordinates and rates, written in the symbols of the left node of an interval."""
        left: dict[Symbol, Expr] = dict(zip(model.coordinates, at_nodes(model.coordinates, "_k"), strict=True))
        if expression.has(*model.rates):
            left |= dict(zip(model.rates, motion.left_rates(), strict=True))
        return expression.subs(left, simultaneous=True)

    at_inner_times, times = inner_terms(model, at_left_node, names, clock)
    nodal += at_inner_times
    integrals = integral_equations(model, names)
    start += End(aliases=shared.start_aliases) + pinned_at_zero(nodal.start_pins)
    end += End(aliases=shared.end_aliases) + end_share(integrals) + pinned_at_zero(nodal.end_pins)
    discrete, sites = motion.discrete, motion.discrete.q
    stages = bounded_stages(model, discrete.inside, motion.interval)
    on_interval = (*discrete.path, *stage_inequalities(model, discrete.inside), *motion.contacts)
    path = interval_terms(model, on_interval, len(stages), names)
    before = with_bounds((*motion.node, *nodal.unknowns), model)
    controls = _controls(model, len(sites.stage_controls))
    # Unknowns of one end become unknowns of every node, with the value zero at all other nodes.
    of_ends = tuple({unknown.name: unknown for unknown in (*start.extra, *end.extra)}.values())
    node = (*before, *of_ends, *(controls if sites.nodal else ()))
    element = motion.element + path.element
    element += Add(*(e.multiplier * value for e, value in zip(integrals, discrete.integrals, strict=True)))
    element += nodal.element + _filling(unknown.name for unknown in of_ends)
    # A one-sided scheme depends on the controls of the left node alone. Then the controls of the last node are zero.
    nodal_controls = zip(controls, symbols([u.name for u in controls], "_k1"), strict=True) if sites.nodal else ()
    idle = [u.name for u, symbol in nodal_controls if symbol not in element.free_symbols]
    linking = (*shared.own, *own_unknowns(integrals), *shared.common)
    shared_unknowns = tuple(own.unknown for own in linking)
    of_start, of_end = ({unknown.name for unknown in each.extra} for each in (start, end))
    start += pinned_at_zero([unknown.name for unknown in of_ends if unknown.name not in of_start])
    start += End(element=-_filling(sorted(of_start)))
    end += pinned_at_zero([*(unknown.name for unknown in of_ends if unknown.name not in of_end), *idle])
    start_element, end_element = (indexed(each, node, shared_unknowns) for each in (start, end))
    pinned = [{index for index, _ in each.pins} for each in (start_element, end_element)]
    first = len(before) - len(at_inner_times.unknowns)
    guess = dict(model.guess)
    of_controls = tuple(at_guess(model, guess.get(u, S.Zero)) for u in model.controls)
    control_times = schemes.find(motion.scheme, motion.method).point_times if sites.stage_controls else (S.Half,)
    quadratures = (Equation(value, f"Gd_{i}") for i, value in enumerate(discrete.integrals, start=1))
    program = ControlProgram(
        model=model,
        method=motion.method,
        scheme=motion.scheme,
        controlled=sites.controlled,
        node=node,
        interval=(*stages, *path.multipliers),
        controls=() if sites.nodal else controls,
        interval_symbols=(*motion.interval_symbols, *symbols([y.name for y in path.multipliers], "_k")),
        control_symbols=() if sites.nodal else sites.of_interval,
        element=element,
        cost=discrete.cost,
        equations=(*motion.equations, *path.equations, *nodal.equations, *quadratures),
        only_at_ends=tuple(range(len(before), len(before) + len(of_ends))),
        start=start_element,
        end=end_element,
        boundary_values=boundary_values,
        guess=InitialGuess(
            motion.node_guess,
            motion.stage_guess,
            of_controls * max(1, len(sites.stage_controls)),
            motion.stage_times,
            tuple(c for c in control_times for _ in model.controls),
            tuple(replace(h, unknowns=tuple(len(motion.node) + i for i in h.unknowns)) for h in nodal.holding),
        ),
        slacks=path.slacks,
        slack_multipliers=path.slack_multipliers,
        path_multipliers=len(path.multipliers),
        linking=LinkingVariables(
            unknowns=shared_unknowns,
            symbols=tuple(own.symbol for own in linking),
            guess=tuple(at_guess(model, own.guess) for own in linking),
            own=len(linking) - len(shared.common),
            couplings=shared.couplings,
            redundant=shared.redundant,
            coupling_symbols=shared.coupling_symbols,
        ),
        integrals=integrals,
        inner=replace(
            times,
            unknowns=tuple(first + i for i in times.unknowns),
            multipliers=tuple((name, time, first + i) for name, time, i in times.multipliers),
            guess=tuple((i, values, i in pinned[0], i in pinned[1]) for i, values in inner_guess(model)),
            clock=len(motion.node) - 2 if clock else None,
            lacking=(len(motion.interval) - 1,) if clock else (),
        ),
        sample=sample_element(model, discrete.observed, names),
    )
    for what, share in (
        ("dynamics, cost or path", program.element),
        ("conditions at the start", program.start.element),
        ("conditions at the end or the terminal cost", program.end.element),
    ):
        if model.body is not None and share.has(model.body):
            raise ExpressionError(
                f"{what} depend on the body's number", "use it in boundary values, bounds and guesses only"
            )
    return with_determined_values(program, path.inequalities)


def _filling(names: Iterable[str]) -> Expr:
    """Return the sum of x^2/2 over the named unknowns x of the left node, which makes them vanish."""
    return sum((x**2 / 2 for x in symbols(names, "_k")), S.Zero)


def _controls(model: Model, stages: int) -> tuple[Unknown, ...]:
    """Return the controls of an interval or a node, or of each stage of an interval, with their bounds."""
    once = with_bounds([Unknown(u.name, Meaning(Kind.CONTROL, u.name)) for u in model.controls], model)
    return (
        tuple(
            replace(u, name=f"{u.name}_stage{i}", meaning=Meaning(Kind.STAGE_CONTROL, u.meaning.of, i))
            for i in range(1, stages + 1)
            for u in once
        )
        or once
    )


def in_scaled_time(program: ControlProgram) -> ControlProgram:
    """Return a program in which t and h are fractions of a free duration D: D h replaces h, and D t replaces t.

    Where nodes have unknown times, these times determine t and h of an interval.
    """
    model, clock = program.model, dict(program.inner.scales)
    if not clock and not model.duration.free_symbols & {parameter.symbol for parameter in model.free_parameters}:
        return program
    scales = _scales(model)
    on_interval = clock or scales

    def end(element: EndElement) -> EndElement:
        return replace(
            element,
            element=element.element.xreplace(scales),
            cost=element.cost.xreplace(scales),
            conditions=in_scales(element.conditions, scales),
        )

    return replace(
        program,
        element=program.element.xreplace(on_interval),
        cost=program.cost.xreplace(on_interval),
        equations=in_scales(program.equations, on_interval),
        start=end(program.start),
        end=end(program.end),
        scaled_time=True,
    )


def scaled_in_time(model: Model, expression: Expr) -> Expr:
    """Return an expression with t and h as fractions of the duration."""
    return expression.xreplace(_scales(model))


def _scales(model: Model) -> dict[Symbol, Expr]:
    return {STEP: model.duration * STEP, model.time: model.duration * model.time}
