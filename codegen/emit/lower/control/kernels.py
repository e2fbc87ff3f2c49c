"""The kernels of a control problem: intervals, both ends, samples, inputs of tables, and conditions between bodies.

The share of an interval, a sample or an end is its contribution to the Lagrangian. Conditions between bodies have one
kernel per kind of term and tables of terms: code does not grow with the number of bodies (`codegen.symbolic.terms`).
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence

import sympy
from sympy import Symbol, sstr

from codegen.discretise.interval import STEP
from codegen.discretise.program import ControlProgram
from codegen.emit.differentiation import ControlDerivatives, ElementDerivatives
from codegen.emit.lower.control.layout import integers, parameters
from codegen.emit.lower.kernels import INNER, Input, Kernel, Line, Output, inputs_kernel, kernel
from codegen.emit.lower.module import Choice
from codegen.runtime.record import ObservationRecord
from codegen.symbolic.functions import tables_of
from codegen.symbolic.tables import TableData
from codegen.symbolic.terms import Instance, Kind, sorted_terms


def named_elements(program: ControlProgram) -> list[tuple[str, str]]:
    """Return, for each kind of interval, the prefix of its kernels' names and words that describe such intervals."""
    if program.sample:
        return [("motion", ", without its samples")]
    if not program.phases:
        return [("interval", "")]
    named = []
    for number, phase in enumerate(program.phases, start=1):
        if phase.switch is not None:
            named.append((f"switch_{number - 1}", f", first in phase {number}"))
        named.append((f"phase_{number}", f", {'' if phase.switch is None else 'later '}in phase {number}"))
    return named


_SHOOTING = "Fill stages and their multipliers in `unknowns`, and the gradient by all others; return Cd."


def choices(program: ControlProgram, has_sensitivities: bool, is_shooting: bool) -> tuple[Choice, ...]:
    """Return the functions that choose the kernel of an interval by its time t; each phase has a length of 1 in t."""
    if not program.phases:
        return ()
    kinds = [
        ("gradient", "Gradient (ELEMENT + SHARED,) of an interval's share l of the Lagrangian; returns Cd."),
        ("hessian", "Hessian (HESSIAN_ROWS.size,), lower triangle, of an interval's share l of the Lagrangian."),
    ]
    shares = [part for share in program.interval_elements for part in (share.element, share.cost)]
    if any(table.shape.outside == "error" for table in tables_of(shares, program.start, program.end)):
        kinds.append(("inputs", "Least and greatest `inputs` (RANGED, 2) with which tables are read on an interval."))
    if is_shooting:
        kinds.append(("shooting", _SHOOTING))
    if has_sensitivities:
        kinds.append(
            ("mixed", "Derivatives of an interval's share l: `slopes` (DATA,) by data, `mixed` by unknowns and data.")
        )
    stems = [stem for stem, _ in named_elements(program)]
    conditions = []
    for stem in stems[:-1]:  # intervals before the end of this kind; 1e-12 allows for rounding
        kind, number = stem.split("_")
        conditions.append(f"t < {number} {'+' if kind == 'switch' else '-'} 1e-12")
    functions = []
    for kind, summary in kinds:
        names = [f"{stem}_{kind}" for stem in stems]
        filled = {"mixed": ("slopes", "mixed"), "shooting": ("gradient",)}.get(kind, (kind,))
        arguments = ("unknowns", "t", "h", "parameters", *filled)
        branches = tuple(zip(conditions, names, strict=False))
        functions.append(Choice(f"interval_{kind}", summary, arguments, branches, names[-1]))
    return tuple(functions)


def symbol_codes(program: ControlProgram, unknowns: Sequence[Symbol]) -> dict[Symbol, str]:
    """Return the code that reads each symbol inside a kernel; linking variables are stored behind the parameters."""
    codes = {symbol: f"unknowns[{i}]" for i, symbol in enumerate(unknowns)}
    codes |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(parameters(program))}
    codes[program.model.time] = "t"
    codes[STEP] = "h"
    first, count = len(program.model.parameters) + len(program.boundary_values), len(program.inner.times)
    inner = {s: f"inner_number(parameters, {first}, {count}, {i}, t, h)" for i, s in enumerate(program.inner.symbols)}
    return codes | inner


def sample_codes(program: ControlProgram) -> dict[Symbol, str]:
    """Return the code that reads each symbol inside a kernel of a sample of measurements."""
    assert program.sample is not None, "there are samples"
    numbers = {symbol: f"parameters[sample + {i}]" for i, symbol in enumerate(program.sample.symbols, start=1)}
    return {**symbol_codes(program, program.element_symbols), **numbers}


def share_kernels(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[Kernel, ...]:
    """Return kernels of gradient and Hessian for each contribution to the Lagrangian: intervals, samples and ends."""
    kernels, arguments, share = list[Kernel](), ("unknowns", "t", "h", "parameters"), "the interval's share l"
    for (stem, where), element in zip(named_elements(program), derivatives.elements, strict=True):
        codes, unknowns = symbol_codes(program, element.unknowns), element.unknowns
        gradient = [
            Output(f"gradient[{i}]", value, f"dl/d{symbol}")
            for i, (symbol, value) in enumerate(zip(unknowns, element.gradient, strict=True))
        ]
        hessian = [
            Output(f"hessian[{j}]", value, f"d2l/d{unknowns[row]} d{unknowns[column]}")
            for j, (row, column, value) in enumerate(element.hessian)
        ]
        kernels += [
            kernel(
                f"{stem}_gradient",
                f"Fill the gradient (ELEMENT + SHARED,) of {share} at `unknowns`{where}; return Cd.",
                (*arguments, "gradient"), codes, gradient, element.cost,
                decorators=INNER, straight_line=element.gradient_assignments,
            ),
            kernel(
                f"{stem}_hessian",
                f"Fill the Hessian (HESSIAN_ROWS.size,), lower triangle, of {share}{where}.",
                (*arguments, "hessian"), codes, hessian,
                decorators=INNER, straight_line=element.hessian_assignments,
            ),
        ]  # fmt: skip
    for (stem, _), explicit in zip(named_elements(program), derivatives.shooting, strict=False):
        every = program.element_symbols
        dependent = {every[i] for i in explicit.dependent}
        codes = {symbol: code for symbol, code in symbol_codes(program, every).items() if symbol not in dependent}
        outputs = [Output(f"unknowns[{i}]", every[i], "") for i in explicit.dependent]
        slopes = zip(every, explicit.gradient, strict=True)
        outputs += [
            Output(f"gradient[{i}]", value, f"dl/d{symbol}")
            for i, (symbol, value) in enumerate(slopes)
            if i not in explicit.dependent
        ]
        kernels.append(
            kernel(
                f"{stem}_shooting", _SHOOTING, (*arguments, "gradient"), codes, outputs, explicit.cost,
                decorators=INNER, straight_line=explicit.assignments,
            )
        )  # fmt: skip
    if program.sample is not None and derivatives.sample is not None:
        kernels += _sample_kernels(program, derivatives.sample, derivatives.element)
    is_curved = bool(derivatives.start.hessian or derivatives.end.hessian)
    for name, ended in (("start", derivatives.start), ("end", derivatives.end)):
        codes, unknowns = symbol_codes(program, ended.unknowns), ended.unknowns
        gradient = [
            Output(f"gradient[{i}]", value, f"by {symbol}", "+=")
            for i, (symbol, value) in enumerate(zip(unknowns, ended.gradient, strict=True))
            if value != 0
        ]
        kernels.append(
            kernel(
                f"{name}_gradient",
                f"Add the gradient (NODE + SHARED,) of the share of the {name} at `unknowns` (NODE,); "
                "return its cost.",
                ("unknowns", "t", "parameters", "gradient"), codes, gradient, ended.cost,
                decorators=INNER, straight_line=ended.gradient_assignments,
            )
        )  # fmt: skip
        if is_curved:
            hessian = [
                Output(f"hessian[{j}]", value, f"{unknowns[row]}, {unknowns[column]}")
                for j, (row, column, value) in enumerate(ended.hessian)
            ]
            summary = (
                f"Fill the Hessian ({name.upper()}_HESSIAN_ROWS.size,), lower triangle, of the share of the {name}."
            )
            kernels.append(
                kernel(
                    f"{name}_hessian", summary, ("unknowns", "t", "parameters", "hessian"), codes, hessian,
                    decorators=INNER, straight_line=ended.hessian_assignments,
                )
            )  # fmt: skip
    return tuple(kernels)


def _sample_kernels(program: ControlProgram, sample: ElementDerivatives, element: ElementDerivatives) -> list[Kernel]:
    """Return the kernels of the observed values at a sample and of its losses, with an interval's Hessian pattern."""
    assert program.sample is not None, "there are samples"
    codes, unknowns = sample_codes(program), sample.unknowns
    index = {(row, column): j for j, (row, column, _) in enumerate(element.hessian)}
    gradient = [
        Output(f"gradient[{i}]", value, f"by {symbol}", "+=")
        for i, (symbol, value) in enumerate(zip(unknowns, sample.gradient, strict=True))
        if value != 0
    ]
    observed = zip(program.sample.observed, program.model.observed, strict=True)
    values = [Output(f"values[{i}]", value, f"{o.name} measures it") for i, (value, o) in enumerate(observed)]
    hessian = [
        Output(f"hessian[{index[row, column]}]", value, f"by {unknowns[row]}, {unknowns[column]}", "+=")
        for row, column, value in sample.hessian
    ]
    arguments, at = ("unknowns", "t", "h", "parameters", "sample"), "at index `sample` of `parameters`"
    return [
        kernel(
            "sample_values", f"Fill `values` (m,) with the measured quantities of the motion at a sample {at}.",
            (*arguments, "values"), codes, values, decorators=INNER,
        ),
        kernel(
            "sample_gradient", f"Add the gradient of the losses of a sample {at}; return the losses.",
            (*arguments, "gradient"), codes, gradient, sample.cost,
            decorators=INNER, straight_line=sample.gradient_assignments,
        ),
        kernel(
            "sample_hessian", f"Add the Hessian, lower triangle, of the losses of a sample {at}.",
            (*arguments, "hessian"), codes, hessian,
            decorators=INNER, straight_line=sample.hessian_assignments,
        ),
    ]  # fmt: skip


def inputs_kernels(program: ControlProgram, ranged: Sequence[Input]) -> tuple[Kernel, ...]:
    """Return kernels of the least and greatest values of `ranged` table inputs, on all intervals and at both ends."""
    if not ranged:
        return ()
    codes = symbol_codes(program, program.element_symbols)
    stems = named_elements(program) if program.phases else [("interval", "")]
    kernels = [
        inputs_kernel(
            f"{stem}_inputs", f"on an interval{where}", ("unknowns", "t", "h", "parameters"), codes, ranged,
            (share.element, share.cost),
        )
        for (stem, where), share in zip(stems, program.interval_elements, strict=True)
    ]  # fmt: skip
    ends = (("start", program.start, program.left_symbols), ("end", program.end, program.right_symbols))
    for name, end, node in ends:
        codes = symbol_codes(program, (*node, *program.linking.symbols))
        arguments, expressions = ("unknowns", "t", "parameters"), (end.element, end.cost)
        kernels.append(inputs_kernel(f"{name}_inputs", f"at the {name}", arguments, codes, ranged, expressions))
    return tuple(kernels)


def coupling_terms(program: ControlProgram) -> tuple[tuple[Kind, ...], tuple[Instance, ...]]:
    """Return the kinds of terms in conditions between bodies, and all terms as indices of linking variables."""
    if not program.linking.couplings:
        return (), ()
    indices = {symbol: body * program.linking.own + j for symbol, body, j in program.linking.coupling_symbols}
    first = program.model.bodies * program.linking.own
    indices |= {symbol: first + j for j, symbol in enumerate(program.linking.common_symbols)}
    return sorted_terms([coupling.expression for coupling in program.linking.couplings], indices)


def coupling_kernels(program: ControlProgram, kinds: Sequence[Kind]) -> tuple[Kernel, ...]:
    """Return a kernel for each kind of term: its value, and first and second derivatives."""
    kernels = []
    for number, kind in enumerate(kinds):
        term, read = kind.expression, kind.arguments
        slopes = [Output(f"slopes[{i}]", sympy.diff(term, a), f"by {a}") for i, a in enumerate(read)]
        curvatures = [
            Output(f"curvatures[{i * len(read) + j}]", sympy.diff(term, a, b), f"by {a} and {b}")
            for i, a in enumerate(read)
            for j, b in enumerate(read)
        ]
        detail = "with its first and second derivatives" if read else "which depends on no unknown"
        arguments = ("values", "parameters", "slopes", "curvatures")
        kernels.append(
            kernel(
                f"coupling_{number}", f"{sstr(term)}, {detail}.", arguments, term_codes(program, kind),
                [*slopes, *curvatures], term, decorators=INNER,
            )
        )  # fmt: skip
    return tuple(kernels)


def term_codes(program: ControlProgram, kind: Kind) -> dict[Symbol, str]:
    """Return the code that reads each symbol inside the kernel of one kind of term."""
    codes = {symbol: f"values[{i}]" for i, symbol in enumerate(kind.arguments)}
    return codes | {symbol: f"parameters[{i}]" for i, symbol in enumerate(parameters(program))}


def coupling_constants(instances: Sequence[Instance]) -> tuple[Line, ...]:
    """Return index arrays of the terms in all conditions between bodies; `instances` are these terms."""
    if not instances:
        return ()
    width = max(1, *(len(instance.indices) for instance in instances))
    rows = [[*instance.indices, *[0] * (width - len(instance.indices))] for instance in instances]
    return (
        Line("COUPLING_KINDS", integers([i.kind for i in instances]), "kind of every term of the conditions"),
        Line("COUPLING_ROWS", integers([i.row for i in instances]), "condition to which it belongs"),
        Line(
            "COUPLING_COUNTS",
            integers([len(i.indices) for i in instances]),
            "number of linking variables of each condition",
        ),
        Line("COUPLING_INDICES", f"np.array({rows}, dtype=np.int64)", "and which"),
        Line("MOST_COUPLED", str(width), "largest of these numbers"),
    )


def sample_constants(program: ControlProgram, tables: Sequence[TableData]) -> tuple[Line, ...]:
    """Return constants: index of the first sample among the parameters, numbers per sample, and the measurements."""
    if program.sample is None:
        return ()
    first = len(parameters(program)) + sum(table.shape.count for table in tables)
    observations = ""
    for data in program.model.measurements:
        text = ", ".join(repr(number) for row in data.rows for number in row).replace("nan", "np.nan")
        lines = textwrap.wrap(text, 108, initial_indent=" " * 8, subsequent_indent=" " * 8, break_on_hyphens=False)
        observations += "    np.array([\n" + "\n".join(lines) + f"\n    ]).reshape(-1, {data.layout.width}),\n"
    return (
        Line("FIRST_SAMPLE", str(first), "parameters before those of samples"),
        Line("SAMPLE", str(1 + len(program.sample.symbols)), "numbers of a sample: when and where, values, weights"),
        Line("OBSERVATIONS", f"(\n{observations})", "of each body rows of time, values, standard deviations"),
    )


def sample_record(program: ControlProgram) -> ObservationRecord | None:
    """Return the layout of the measurements for the metadata record, or None if there are no measurements."""
    model = program.model
    if not model.measurements:
        return None
    layout, values = model.measurements[0].layout, tuple(sstr(o.expression) for o in model.observed)
    sources = tuple(data.source for data in model.measurements)
    return ObservationRecord(sources, layout.time, layout.columns, layout.sigmas, values, model.loss)
