"""What a control module says about itself beside the problem that it solves: what was left out, its record."""

from __future__ import annotations

import math
from collections.abc import Sequence

import sympy
from sympy import cos, sin

from codegen import schemes
from codegen.derive import ControlDerivatives
from codegen.lower.control.layout import has_nonlinear_ends
from codegen.lower.control.notable import notable
from codegen.lower.control.samples import sample_record
from codegen.lower.control.sizes import carries_right_hand_side
from codegen.lower.kernels import Kernel
from codegen.lower.module import record_fields
from codegen.lower.tables import table_records
from codegen.model import Model
from codegen.runtime.record import ControlRecord, Form, Kind, Meaning, Method, Role, Sites
from codegen.tables.data import TableData
from codegen.transcribe.program import ControlProgram


def left_out(program: ControlProgram, derivatives: ControlDerivatives) -> list[str]:
    """What the module does not hold, and why."""
    model = program.model
    models = model.phases or (model,)
    out = []
    if derivatives.linear_quadratic:
        out.append("globalisation and inertia correction: the problem is linear-quadratic, one Newton step solves it")
    if derivatives.condensed:
        kind = "controls" if derivatives.condensed > len(program.slacks) else "slacks"
        why = "" if program.has_inequalities or program.phases else "their Hessian block is constant, so "
        out.append(f"{kind} in the linear system: {why}each interval eliminates its own")
    if not has_nonlinear_ends(derivatives):
        out.append("curvature of the boundary conditions: positions that they depend on are given")
    if not program.has_inequalities:
        out.append("interior point: there are no inequalities")
    if not program.shared:
        out.append("a border of the linear system: no unknown is shared by all intervals")
    if not carries_right_hand_side(program, derivatives):
        out.append("a right-hand side that takes part in the elimination: rows of element matrices have no room for it")
    functions = tuple(f for m in models for f in (m.function, *m.force, *m.dynamics))
    absent = ", ".join(str(q) for q in model.coordinates if not any(f.has(q) for f in functions))
    if absent and model.form == "first-order":
        out.append(f"derivatives of the dynamics by {absent}: no right-hand side depends on {absent}")
    elif absent:
        out.append(f"derivatives of the {model.form.capitalize()} by {absent}: cyclic")
    forces = zip(*(m.force for m in models), strict=True)
    idle = [str(q) for q, f in zip(model.coordinates, forces, strict=False) if not any(f)]
    if idle:
        out.append(f"forces on {', '.join(idle)}: there are none")
    others = [e for m in models for e in (m.cost or sympy.S.Zero, *(c.expression for c in m.path))]
    if not any(e.has(model.time) for e in (*functions, *others)):
        out.append("time in the kernels: nothing depends on it explicitly")
    size = len(program.element_symbols)
    zeros = size * (size + 1) // 2 - len(derivatives.element.hessian)
    if zeros:
        out.append(f"{zeros} of {size * (size + 1) // 2} entries of the interval's Hessian: identically zero")
    return out


def record(
    program: ControlProgram,
    derivatives: ControlDerivatives,
    kernels: Sequence[Kernel],
    tables: Sequence[TableData],
    sensitivities: tuple[str, ...] | None,
) -> ControlRecord:
    """The record of the module, with the quantities that derivatives of solutions are by, if any are."""
    model, given = program.model, program.boundary_values
    own, common = program.shared[: program.own], program.shared[program.own :]
    shared = [
        f"{u.name} of body {body}" if program.bodies > 1 else u.name for body in range(program.bodies) for u in own
    ]
    shared += [u.name for u in common] + [c.multiplier.name for c in program.couplings]
    return ControlRecord(
        **record_fields(model),
        method=Method(program.method),
        scheme=program.scheme,
        order=schemes.find(program.scheme, program.method).order,
        form=Form(model.form),
        coordinates=tuple(s.name for s in model.coordinates),
        rates=tuple(s.name for s in model.rates),
        start=tuple(v.quantity for v in given if v.where == "start"),
        end=tuple(v.quantity for v in given if v.where == "end"),
        units=dict(model.units),
        tables=table_records(tables),
        operations={k.name: (k.operations_before, k.operations_after) for k in kernels},
        left_out=tuple(left_out(program, derivatives)),
        controls=Sites(program.controlled),
        bodies=program.bodies,
        phases=len(program.phases) or 1,
        control_names=tuple(s.name for s in model.controls),
        free_parameters=tuple(p.symbol.name for p in model.free_parameters),
        node=tuple(u.name for u in program.node),
        interval=tuple(u.name for u in (*program.interval, *program.controls, *program.slacks)),
        shared=tuple(shared),
        inequalities=program.has_inequalities,
        meanings=_meanings(program),
        slacks=_slacks(program),
        jumps=tuple(phase.broken for phase in program.phases[1:]),
        stages=_stages(program),
        stage_abscissae=_stage_abscissae(program) if program.controlled == "stages" else (),
        scale={x.name: size for x, size in model.scales},
        angles=_angles(model),
        observations=sample_record(program),
        sensitivities=sensitivities,
        **notable(program),
    )


def _stages(program: ControlProgram) -> dict[str, str]:
    """Names at stages, of states, controls and multipliers, with the names of the same quantity at nodes."""
    model = program.model
    quantities = {s.name for s in (*model.coordinates, *model.rates, *model.controls)}
    quantities |= {f"{prefix}_{name}" for name in quantities for prefix in ("mu", "lambda")}
    names = [u.name for u in (*program.interval, *program.controls)]
    return {name: of for name in names if name not in quantities and (of := name.rpartition("_stage")[0]) in quantities}


def _angles(model: Model) -> dict[str, float]:
    """Name -> one radian in the unit of a coordinate or control that is an argument of sines and cosines."""
    found: dict[str, float] = {}
    for part in model.phases or (model,):
        written = (part.function, *part.dynamics, *part.force, *((part.cost,) if part.cost is not None else ()))
        for call in set().union(*(expression.atoms(sin, cos) for expression in written)):
            for symbol in call.args[0].free_symbols & {*part.coordinates, *part.controls}:
                slope = call.args[0].diff(symbol)
                if slope.is_number and slope != 0:
                    found[symbol.name] = min(found.get(symbol.name, math.inf), abs(1.0 / float(slope)))
    return dict(sorted(found.items()))


def _stage_abscissae(program: ControlProgram) -> tuple[float, ...]:
    """The fractions of an interval at which its controls are."""
    scheme = schemes.find(program.scheme, program.method)
    points = scheme.discrete_lagrangian().points if scheme.variational else scheme.step().points
    return tuple(float(point.abscissa) for point in points)


def _slacks(program: ControlProgram) -> tuple[dict[str, Meaning], ...]:
    """What slacks are in each of several phases."""
    first = len(program.interval) + len(program.controls)
    found = tuple(
        {p.inside[i].name: p.inside[i].meaning for i in range(first, len(p.inside)) if i not in p.regular.lacking}
        for p in program.phases
    )
    return found if any(found) else ()


def _meanings(program: ControlProgram) -> dict[str, Meaning]:
    """What multipliers, slacks and forces of constraints are; the names of other unknowns say it."""
    unknowns = (*program.node, *program.interval, *program.slacks, *program.shared)
    named = [*unknowns, *(coupling.multiplier for coupling in program.couplings)]
    return {u.name: u.meaning for u in named if u.kind.role is not Role.VALUE or u.kind is Kind.NORMAL_FORCE}
