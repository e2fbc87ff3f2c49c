"""Equations of motion and everything beside them -> ControlProgram."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from sympy import Expr, S, Symbol

from codegen.discretise import STEP, PathValue, Sites
from codegen.errors import ExpressionError
from codegen.model import Model
from codegen.transcribe.ends import End, Ends
from codegen.transcribe.guesses import at_guess, control_guess
from codegen.transcribe.names import Names, symbols
from codegen.transcribe.path_conditions import NodalTerms, interval_terms
from codegen.transcribe.program import BoundaryValue, ControlProgram, EndElement, Unknown
from codegen.transcribe.shared import Shared


@dataclass(frozen=True)
class Motion:
    """The discrete equations of motion: unknowns of nodes and intervals, their share of l, the discrete cost.

    The symbols of a node's unknowns in `element` are their names with suffix `_k` and `_k1`.
    """

    method: str
    scheme: str
    node: tuple[Unknown, ...]
    interval: tuple[Unknown, ...]
    interval_symbols: tuple[Symbol, ...]
    controls: Sites
    element: Expr
    cost: Expr
    path: tuple[PathValue, ...]
    equations: tuple[tuple[str, Expr], ...]
    node_guess: tuple[Expr, ...]
    stage_guess: tuple[Expr, ...] = ()


def assemble(
    model: Model,
    motion: Motion,
    boundary_values: tuple[BoundaryValue, ...],
    nodal: Sequence[NodalTerms],
    start: End,
    end: End,
    shared: Shared,
    names: Names,
) -> ControlProgram:
    """Lay out all unknowns, and add up the shares of the interval and of both ends."""
    on_nodes = motion.controls.nodal
    ends = Ends(
        start + End(pins=tuple((name, S.Zero) for terms in nodal for name in terms.start_pins)),
        end + End(pins=tuple((name, S.Zero) for terms in nodal for name in terms.end_pins)),
    )
    path = interval_terms(model, motion.path, len(motion.interval), names)
    before = (*motion.node, *(unknown for terms in nodal for unknown in terms.unknowns))
    controls = _bounded([Unknown(u.name, f"control {u.name}") for u in model.controls], model)
    node = (*_bounded(before, model), *ends.extra, *(controls if on_nodes else ()))
    interval = (*motion.interval, *path.multipliers)
    element = motion.element + path.element + sum((terms.element for terms in nodal), S.Zero) + ends.filling()
    # A one-sided scheme reads nodal controls at one end of an interval only.
    idle = [
        u.name
        for u, symbol in zip(controls, motion.controls.right_controls, strict=True)
        if on_nodes and symbol not in element.free_symbols
    ]
    program = ControlProgram(
        model=model,
        method=motion.method,
        scheme=motion.scheme,
        nodal_controls=on_nodes,
        node=node,
        interval=interval,
        controls=() if on_nodes else controls,
        left_symbols=symbols([unknown.name for unknown in node], "_k"),
        interval_symbols=(*motion.interval_symbols, *symbols([y.name for y in path.multipliers], "_k")),
        control_symbols=() if on_nodes else motion.controls.left_controls,
        right_symbols=symbols([unknown.name for unknown in node], "_k1"),
        element=element,
        cost=motion.cost,
        equations=(*motion.equations, *path.equations, *(pair for terms in nodal for pair in terms.equations)),
        boundary_values=boundary_values,
        node_guess=motion.node_guess,
        stage_guess=motion.stage_guess,
        control_guess=control_guess(model),
        only_at_ends=tuple(range(len(before), len(before) + len(ends.extra))),
        start=ends.start_element(node, [own.unknown for own in shared.all]),
        end=ends.end_element(node, [own.unknown for own in shared.all], idle),
        slacks=path.slacks,
        slack_symbols=symbols([slack.name for slack in path.slacks], "_k"),
        slack_multipliers=path.slack_multipliers,
        shared=tuple(own.unknown for own in shared.all),
        shared_symbols=tuple(own.symbol for own in shared.all),
        shared_guess=tuple(at_guess(model, own.guess) for own in shared.all),
        own=len(shared.own),
        bodies=model.bodies,
        body=model.body,
        couplings=shared.couplings,
        coupling_symbols=shared.coupling_symbols,
    )
    _require_identical_bodies(program)
    return in_scaled_time(program)


def in_scaled_time(program: ControlProgram) -> ControlProgram:
    """Measure t and h in fractions of a duration that is optimised along: h -> D h and t -> D t everywhere."""
    model = program.model
    duration = model.duration
    if not duration.free_symbols & {parameter.symbol for parameter in model.free_parameters}:
        return program
    scales = {STEP: duration * STEP, model.time: duration * model.time}

    def pairs(written: Sequence[tuple[str, Expr]]) -> tuple[tuple[str, Expr], ...]:
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
        element=program.element.xreplace(scales),
        cost=program.cost.xreplace(scales),
        equations=pairs(program.equations),
        start=end(program.start),
        end=end(program.end),
        scaled_time=True,
    )


def _bounded(unknowns: Sequence[Unknown], model: Model) -> tuple[Unknown, ...]:
    """Give unknowns the bounds of the quantity that they stand for."""
    bounds = {bound.symbol.name: bound for bound in model.bounds}
    return tuple(
        replace(unknown, lower=bounds[unknown.name].lower, upper=bounds[unknown.name].upper)
        if unknown.name in bounds
        else unknown
        for unknown in unknowns
    )


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
