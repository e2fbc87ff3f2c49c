"""Lowering of a control problem to a module: kernels, constants, initial guesses, bounds and solutions as code."""

from __future__ import annotations

from codegen.discretise.program import ControlProgram
from codegen.emit.differentiation import ControlDerivatives, ControlSensitivities
from codegen.emit.lower.control import kernels as control_kernels
from codegen.emit.lower.control import layout, sensitivities
from codegen.emit.lower.control.layout import bounds, pins
from codegen.emit.lower.control.text import description, record
from codegen.emit.lower.kernels import (
    Line,
    described_tables,
    guess_kernels,
    range_constants,
    ranged_inputs,
    table_constants,
    table_kernels,
)
from codegen.emit.lower.module import BoundaryText, ControlModule, arguments_of
from codegen.emit.lower.printer import array_code, scalar_code
from codegen.symbolic.functions import tables_of

_SHOOTING = "Shooting(REDUCTION, shooting_gradient_loop, shooting_hessian_loop, stage_loop)"
"""The record of the loops that `templates/loops.txt` defines for explicit schemes."""


def lower_control(
    program: ControlProgram, derivatives: ControlDerivatives, by_data: ControlSensitivities | None = None
) -> ControlModule:
    """Return the module of a control problem as strings; derivatives `by_data` add sensitivities to it."""
    model, inner, tables = program.model, program.inner, tables_of(program.model)
    first = len(layout.parameters(program))
    expressions = [e for share in program.interval_elements for e in (share.element, share.cost)]
    expressions += [e for end in (program.start, program.end) for e in (end.element, end.cost)]
    expressions += [coupling.expression for coupling in program.linking.couplings]
    ranged = ranged_inputs(tables, first, expressions)
    terms, instances = control_kernels.coupling_terms(program)
    couplings = control_kernels.coupling_kernels(program, terms)
    kernels = (
        *control_kernels.share_kernels(program, derivatives),
        *couplings,
        *control_kernels.inputs_kernels(program, ranged),
        *(sensitivities.kernels(program, by_data) if by_data else ()),
    )
    guessed = tables_of(
        program.guess.node, program.guess.stages, program.guess.controls,
        [(p.node_guess, [v for _, v, *_ in (*p.inside_guess, *p.switch_guess)]) for p in program.phases],
        [h.expressions for h in (*program.guess.holding, *(each for p in program.phases for each in p.holding))],
    )  # fmt: skip
    quantities = sensitivities.quantities(program) if by_data else None
    duration = layout.duration(program)
    grid_code = f"checked_grid(problem, steps, {duration.grid}, parameters, grid)"
    if inner.times:
        grid_code = f"with_inner_times({grid_code})"
    data_arguments = []
    if tables:
        meaning = "`tables` maps names of tables to other numbers in the order of TABLES, on as many breakpoints."
        data_arguments.append(("tables", meaning))
        grid_code = f"with_tables({grid_code}, tables)"
    if program.sample:
        meaning = "`observations` are other measurements, any number of them, in the order of OBSERVATIONS."
        data_arguments.append(("observations", meaning))
        grid_code = f"with_observations({grid_code}, observations)"
    # With several bodies, boundary values are arrays.
    values, boundary_code = program.boundary_values, array_code if program.model.bodies > 1 else scalar_code
    reads_body = program.model.body is not None and any(v.value.has(program.model.body) for v in values)
    example = f'as in {values[0].where}={{"{values[0].quantity}": 0.5}}' if values else "of which there are none"
    return ControlModule(
        template="control.py.j2",
        name=model.name,
        title=model.title,
        description=tuple(description(program, kernels, described_tables(tables))),
        metadata=record(program, derivatives, kernels, tables, quantities),
        constants=(
            *layout.constants(program, derivatives),
            *layout.inner_time_constants(program),
            *control_kernels.coupling_constants(instances),
            *layout.phase_constants(program),
            *table_constants(tables),
            *range_constants(ranged),
            *control_kernels.sample_constants(program, tables),
            *(sensitivities.constants(program, by_data) if by_data else ()),
        ),
        kernels=(*table_kernels(tables, first), *guess_kernels(guessed), *kernels),
        structure=layout.structure(program, derivatives),
        features=(
            *((("variable_bounds", "variable_bounds"),) if program.has_inequalities else ()),
            *((("phase_durations", "phase_durations"),) if program.phases else ()),
            *((("inputs", "input_loop"), ("ranges", "RANGES"), ("range_names", "RANGE_NAMES")) if ranged else ()),
            *((("shooting", _SHOOTING),) if derivatives.shooting else ()),
            *((("tables", "TABLES"),) if tables else ()),
            *((("observations", "OBSERVATIONS"),) if program.sample else ()),
        ),
        sizes=(
            *layout.sizes(program, derivatives),
            ("SENSITIVE", int(by_data is not None)),
            ("RANGED", len(ranged)),
            ("SAMPLED", len(model.measurements)),
            ("SHOOTING", int(bool(derivatives.shooting))),
            ("CURVED", int(layout.has_nonlinear_ends(derivatives))),
        ),
        arguments=arguments_of(model),
        steps=model.steps,
        boundary=BoundaryText(
            values=tuple(Line(v.symbol.name, boundary_code(v.value), f"{v.where} {v.quantity}") for v in values),
            inputs=(Line("body", "np.arange(BODIES)"),) if reads_body else (),
            example=example,
        ),
        inner_times=(tuple(map(scalar_code, inner.times)),) if inner.times else (),
        inner_values=tuple(
            Line("", boundary_code(value), symbol.name)
            for value, symbol in zip(inner.values, inner.parameters, strict=True)
        ),
        data_arguments=tuple(data_arguments),
        grid_code=grid_code,
        duration=duration,
        guess=layout.guesses(program),
        pins=pins(program),
        bounds=bounds(program),
        solution=layout.solution(program),
        coupling_kinds=(tuple(k.name for k in couplings),) if couplings else (),
        choices=control_kernels.choices(program, by_data is not None, bool(derivatives.shooting)),
        sensitivities=(sensitivities.text_of(program),) if by_data else (),
    )
