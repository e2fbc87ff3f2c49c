"""Controls that cost nothing: a mode of the discrete controls that the discrete cost does not see.

With controls on nodes and averages in the cost, u_k = (-1)^k a leaves the average of every interval unchanged. The
continuous cost does penalise it, so the discrete optimum may be arbitrarily wrong. Where the mode acts on
the motion, the optimiser moves the system with it, for nothing: what it then finds is no optimum of the problem, which
the integral of the cost over the controls that it found reveals.
"""

from __future__ import annotations

from collections.abc import Iterator

import sympy
from sympy import Symbol

from codegen.checks.base import Context, Finding, does_not_apply
from codegen.checks.evaluation import vanishing
from codegen.checks.solution.solutions import integral_of_cost
from codegen.discretise import at_nodes
from codegen.transcribe.program import ControlProgram

_ALLOWED = 0.1
"""Relative difference between both costs that the order of the scheme may explain."""


def check(context: Context) -> Iterator[Finding]:
    """Look for the alternating mode of nodal controls, and for free modes of interval controls, control by control."""
    program = context.control
    if not program.model.controls:
        yield does_not_apply("null controls", "there are no controls")
        return
    if not program.nodal_controls:
        yield from (_interval(program, u) for u in program.model.controls)
        return
    acting = False
    for u in program.model.controls:
        finding, acts = _nodal(program, u)
        acting = acting or acts
        yield finding
    if acting:
        yield from _false_optimum(context)


def _false_optimum(context: Context) -> Iterator[Finding]:
    """The discrete cost of what the solver finds, against the integral of the cost over the controls found."""
    model, solution = context.model, context.solution
    if solution.status != "solved" or model.terminal_cost != 0:
        return
    claimed, true = float(solution.cost), integral_of_cost(model, context.module, solution)
    numbers = f"discrete cost {claimed:.6g}, integral of the cost over the same controls {true:.6g}"
    passed = abs(true - claimed) <= _ALLOWED * max(abs(true), abs(claimed))
    detail = f"{numbers} (N = {solution.t.size - 1})"
    if not passed:
        detail = f"a false optimum, which the alternating controls pay for: {detail}"
    yield Finding("null controls", "optimum with nodal controls", passed, detail)


def _nodal(program: ControlProgram, u: Symbol) -> tuple[Finding, bool]:
    """Whether the mode costs nothing, and whether it then acts.

    It is the cost of an interval under u_k + a, u_k1 - a; both signs of a occur in turn.
    """
    (left,), (right,) = at_nodes([u], "_k"), at_nodes([u], "_k1")
    amplitude = sympy.Dummy("a", real=True)
    mode = {left: left + amplitude, right: right - amplitude}
    change = program.cost.subs(mode, simultaneous=True).diff(amplitude)
    if not vanishing(change) or not _is_penalised(program, u):
        return Finding(
            "null controls", f"nodal control {u}", True, "the alternating control is seen by the cost"
        ), False
    # What the mode adds to the equations of motion; it vanishes where forces are averaged and do not depend on place.
    force = (program.element - program.cost).subs(mode, simultaneous=True).diff(amplitude)
    acts = not vanishing(force)
    effect = "yet acts on the motion" if acts else "and does nothing either, so that it is undetermined"
    detail = f"alternating nodal control {u}: {u}_k = (-1)^k a costs nothing, {effect}; use controls on intervals"
    return Finding("null controls", f"nodal control {u}", False, detail), acts


def _interval(program: ControlProgram, u: Symbol) -> Finding:
    """With controls of its own for each interval, or stage, a free mode would have to be free within one."""
    unseen = [site for site in program.controls_of(u) if vanishing(program.cost.diff(site))]
    passed = not (unseen and _is_penalised(program, u))
    where = "stage" if program.controlled == "stages" else "interval"
    detail = f"none: the discrete cost sees the control of every {where}" if passed else f"{unseen[0]} costs nothing"
    if passed and not _is_penalised(program, u):
        detail = "none of the discretisation: the problem's own cost does not hold it"
    return Finding("null controls", f"{where} control {u}", passed, detail)


def _is_penalised(program: ControlProgram, u: Symbol) -> bool:
    """Whether the continuous cost depends on the control at all, beyond the way in which it is written."""
    return program.model.cost is not None and not vanishing(program.model.cost.diff(u))
