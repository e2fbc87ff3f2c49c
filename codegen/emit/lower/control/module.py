"""ControlProgram and its derivatives -> ControlModule: the kernels, and what else a module consists of."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from sympy import Expr, Symbol

from codegen.discretise.interval import STEP
from codegen.discretise.program import ControlProgram, EndElement
from codegen.emit.differentiation import ControlDerivatives, ControlSensitivities, ElementDerivatives
from codegen.emit.lower.control import layout, phases, sensitivities
from codegen.emit.lower.control.kernels import (
    Couplings,
    data_arguments,
    lower_couplings,
    sample_constants,
    sample_kernels,
)
from codegen.emit.lower.control.layout import sizes
from codegen.emit.lower.control.sensitivities import choices
from codegen.emit.lower.control.text import description, record
from codegen.emit.lower.kernels import INNER, Kernel, Line, Output, kernel
from codegen.emit.lower.module import ControlModule, arguments_of
from codegen.emit.lower.printer import array_code, scalar_code
from codegen.emit.lower.tables import (
    Input,
    described_tables,
    guess_kernels,
    inputs_kernel,
    range_constants,
    ranged_inputs,
    table_constants,
    table_kernels,
)
from codegen.symbolic.functions import tables_of
from codegen.symbolic.tables import TableData


def lower_control(
    program: ControlProgram, derivatives: ControlDerivatives, by_data: ControlSensitivities | None = None
) -> ControlModule:
    """Write every kernel and table of a control problem as strings; with derivatives `by_data` it has sensitivities."""
    model, tables = program.model, tables_of(program.model)
    couplings, curved = lower_couplings(program), layout.has_nonlinear_ends(derivatives)
    first = len(layout.parameters(program))
    ranged, guessed = ranged_inputs(tables, first, _equations(program)), _guess_tables(program)
    added = sensitivities.added(program, by_data, lambda unknowns: _codes(program, unknowns))
    own = (*_own_kernels(program, derivatives, curved), *couplings.kernels, *_inputs_kernels(program, ranged))
    kernels = (*own, *added.kernels)
    of_phases = (phases.guesses, phases.duration, phases.bounds)
    parts = of_phases if program.phases else (layout.guesses, layout.duration, layout.bounds)
    code = {name: value for part in parts for name, value in part(program).items()}
    code["choices"] = (*code["choices"], *(choices(program) if by_data else ()))
    return ControlModule(
        template="control.py.j2",
        name=model.name,
        title=model.title,
        description=tuple(description(program, kernels, described_tables(tables))),
        metadata=record(program, derivatives, kernels, tables, added.quantities),
        constants=(*_own_constants(program, derivatives, couplings, ranged), *added.constants),
        kernels=(*table_kernels(tables, first), *guess_kernels(guessed), *kernels),
        structure=layout.structure(program, derivatives),
        features=_features(program, tables, ranged),
        sizes=(
            *sizes(program, derivatives),
            ("SENSITIVE", int(by_data is not None)),
            ("RANGED", len(ranged)),
            ("SAMPLED", len(model.measurements)),
            ("CURVED", int(curved)),
        ),
        arguments=arguments_of(model),
        **data_arguments(program, tables, layout.grid_code(program, code["grid_duration"])),
        steps=model.steps,
        coupling_kinds=(tuple(k.name for k in couplings.kernels),) if couplings.kernels else (),
        **_boundaries(program),
        **layout.times_and_values(program, _boundary_code(program)),
        **layout.pins(program),
        **layout.views(program),
        sensitivities=added.text,
        **code,
    )


def _own_kernels(program: ControlProgram, derivatives: ControlDerivatives, curved: bool) -> tuple[Kernel, ...]:
    """The kernels of intervals, samples, controls and both ends."""
    return (
        *_all_interval_kernels(program, derivatives),
        *sample_kernels(program, derivatives, _codes(program, program.element_symbols)),
        *_end_kernels(program, program.start, derivatives.start, "start", curved),
        *_end_kernels(program, program.end, derivatives.end, "end", curved),
    )


def _own_constants(
    program: ControlProgram, derivatives: ControlDerivatives, couplings: Couplings, ranged: Sequence[Input]
) -> tuple[Line, ...]:
    """The layout of the unknowns, and the numbers of what the problem has."""
    tables = tables_of(program.model)
    return (
        *layout.constants(program, derivatives),
        *layout.inner_time_constants(program),
        *couplings.constants,
        *(phases.constants(program) if program.phases else ()),
        *table_constants(tables),
        *range_constants(ranged),
        *sample_constants(program, tables),
    )


def _boundary_code(program: ControlProgram) -> Callable[[Expr], str]:
    """What writes values at the ends: of several bodies they are arrays."""
    return array_code if program.bodies > 1 else scalar_code


def _boundaries(program: ControlProgram) -> dict[str, Any]:
    """The values at the ends, what they read, and how one of them is given."""
    values, code = program.boundary_values, _boundary_code(program)
    numbers_bodies = program.body is not None and any(v.value.has(program.body) for v in values)
    example = "of which there are none"
    if values:
        example = f'as in {values[0].where}={{"{values[0].quantity}": 0.5}}'
    return {
        "boundary_values": tuple(Line(v.symbol.name, code(v.value), f"{v.where} {v.quantity}") for v in values),
        "boundary_inputs": (Line("body", "np.arange(BODIES)"),) if numbers_bodies else (),
        "boundary_example": example,
    }


def _codes(program: ControlProgram, unknowns: Sequence[Symbol]) -> dict[Symbol, str]:
    """The code that reads each symbol inside a kernel; shared unknowns stand behind the parameters."""
    codes = {symbol: f"unknowns[{i}]" for i, symbol in enumerate(unknowns)}
    codes |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(layout.parameters(program))}
    codes[program.model.time] = "t"
    codes[STEP] = "h"
    return codes | layout.codes(program)


def _all_interval_kernels(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[Kernel, ...]:
    """The gradient and the Hessian of every kind of interval."""
    named = zip(phases.named_elements(program), derivatives.elements, strict=True)
    pairs = [_interval_kernels(program, element, stem, where) for (stem, where), element in named]
    return tuple(kernel for pair in pairs for kernel in pair)


def _interval_kernels(
    program: ControlProgram, element: ElementDerivatives, stem: str, where: str
) -> tuple[Kernel, Kernel]:
    codes = _codes(program, element.unknowns)
    arguments, share = ("unknowns", "t", "h", "parameters", "gradient"), "an interval's share l"
    gradient = [
        Output(f"gradient[{i}]", value, f"dl/d{symbol}")
        for i, (symbol, value) in enumerate(zip(element.unknowns, element.gradient, strict=True))
    ]
    hessian = [
        Output(f"hessian[{j}]", value, f"d2l/d{element.unknowns[row]} d{element.unknowns[column]}")
        for j, (row, column, value) in enumerate(element.hessian)
    ]
    return (
        kernel(
            f"{stem}_gradient",
            f"Gradient (ELEMENT + SHARED,) of {share} at `unknowns` (ELEMENT,){where}; returns Cd.",
            arguments, codes, gradient, element.cost, decorators=INNER, straight_line=element.gradient_assignments,
        ),
        kernel(
            f"{stem}_hessian",
            f"Hessian (HESSIAN_ROWS.size,), lower triangle, of {share} of the Lagrangian{where}.",
            (*arguments[:-1], "hessian"), codes, hessian,
            decorators=INNER, straight_line=element.hessian_assignments,
        ),
    )  # fmt: skip


def _equations(program: ControlProgram) -> list[Expr]:
    """What kernels evaluate."""
    shares = [(share.element, share.cost) for share in program.interval_elements]
    shares += [(end.element, end.cost) for end in (program.start, program.end)]
    return [*(e for share in shares for e in share), *(coupling.expression for coupling in program.couplings)]


def _guess_tables(program: ControlProgram) -> tuple[TableData, ...]:
    """The tables that guesses read."""
    phases = [(p.node_guess, [v for _, v in (*p.inside_guess, *p.switch_guess)]) for p in program.phases]
    return tables_of(program.node_guess, program.stage_guess, program.control_guess, phases)


def _inputs_kernels(program: ControlProgram, ranged: Sequence[Input]) -> tuple[Kernel, ...]:
    """What tells with which inputs tables are read, on every kind of interval and at both ends, where that matters."""
    if not ranged:
        return ()
    codes = _codes(program, program.element_symbols)
    stems = phases.named_elements(program) if program.phases else [("interval", "")]
    kernels = [
        inputs_kernel(
            f"{stem}_inputs", f"on an interval{where}", ("unknowns", "t", "h", "parameters"), codes, ranged,
            (share.element, share.cost),
        )
        for (stem, where), share in zip(stems, program.interval_elements, strict=True)
    ]  # fmt: skip
    for name, end, node in (
        ("start", program.start, program.left_symbols),
        ("end", program.end, program.right_symbols),
    ):
        codes = _codes(program, (*node, *program.shared_symbols))
        read = (end.element, end.cost)
        arguments = ("unknowns", "t", "parameters")
        kernels.append(inputs_kernel(f"{name}_inputs", f"at the {name}", arguments, codes, ranged, read))
    return tuple(kernels)


def _end_kernels(
    program: ControlProgram, end: EndElement, derivatives: ElementDerivatives, name: str, curved: bool
) -> tuple[Kernel, ...]:
    codes = _codes(program, derivatives.unknowns)
    pinned = {i for i, _ in end.pins}
    gradient: list[Output] = [
        Output(f"gradient[{i}]", value, f"by {symbol}", "+=")
        for i, (symbol, value) in enumerate(zip(derivatives.unknowns, derivatives.gradient, strict=True))
        if value != 0 and i not in pinned
    ]
    arguments = ("unknowns", "t", "parameters", "gradient")
    summary = f"Add the gradient (NODE + SHARED,) of the {name}'s own share, at `unknowns` (NODE,); returns its cost."
    before = derivatives.gradient_assignments
    kernels = [
        kernel(
            f"{name}_gradient", summary, arguments, codes, gradient, derivatives.cost,
            decorators=INNER, straight_line=before,
        )
    ]  # fmt: skip
    if curved:
        entries = [
            Output(f"hessian[{j}]", value, f"{derivatives.unknowns[row]}, {derivatives.unknowns[column]}")
            for j, (row, column, value) in enumerate(derivatives.hessian)
        ]
        summary = f"Hessian ({name.upper()}_HESSIAN_ROWS.size,), lower triangle, of the {name}'s own share."
        arguments = ("unknowns", "t", "parameters", "hessian")
        before = derivatives.hessian_assignments
        kernels.append(
            kernel(f"{name}_hessian", summary, arguments, codes, entries, decorators=INNER, straight_line=before)
        )
    return tuple(kernels)


def _features(
    program: ControlProgram, tables: Sequence[TableData], ranged: Sequence[Input]
) -> tuple[tuple[str, str], ...]:
    """Return the optional fields of the record of the problem, with their code."""
    return (
        *((("variable_bounds", "variable_bounds"),) if program.has_inequalities else ()),
        *((("phase_durations", "phase_durations"),) if program.phases else ()),
        *((("inputs", "input_loop"), ("ranges", "RANGES"), ("range_names", "RANGE_NAMES")) if ranged else ()),
        *((("tables", "TABLES"),) if tables else ()),
        *((("observations", "OBSERVATIONS"),) if program.sample else ()),
    )
