"""Conditions that tie bodies together -> a few kernels, one for each kind of term, and tables of their instances.

Code does not grow with the number of bodies (see `codegen.symbolic.terms`).

Measurements of a module as strings: the kernels of one sample, the numbers, and what is said of them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import sympy
from sympy import Symbol, sstr

from codegen.discretise.program import ControlProgram
from codegen.emit.differentiation import ControlDerivatives
from codegen.emit.lower.control.layout import integers, parameters
from codegen.emit.lower.kernels import INNER, Kernel, Line, Output, kernel
from codegen.runtime.record import ObservationRecord
from codegen.symbolic.tables import MeasurementData, TableData
from codegen.symbolic.terms import Instance, Kind, sorted_terms


@dataclass(frozen=True)
class Couplings:
    """Kernels (value, slopes, curvatures of a kind of term) and the tables that say where terms occur."""

    kernels: tuple[Kernel, ...]
    constants: tuple[Line, ...]


def lower_couplings(program: ControlProgram) -> Couplings:
    """Find the kinds of terms, and write them and the tables of their instances."""
    if not program.couplings:
        return Couplings((), ())
    kinds, instances = sorted_terms([c.expression for c in program.couplings], _indices(program))
    kernels = tuple(_kernel(program, i, kind) for i, kind in enumerate(kinds))
    return Couplings(kernels, tuple(_tables(instances)))


def term_kinds(program: ControlProgram) -> tuple[Kind, ...]:
    """The kinds of terms in the conditions."""
    return sorted_terms([c.expression for c in program.couplings], _indices(program))[0] if program.couplings else ()


def _indices(program: ControlProgram) -> dict[Symbol, int]:
    """Index of every shared unknown, of every body and of the whole problem, among those that no node owns."""
    indices = {symbol: body * program.own + j for symbol, body, j in program.coupling_symbols}
    first = program.bodies * program.own
    return indices | {symbol: first + j for j, symbol in enumerate(program.shared_symbols[program.own :])}


def _kernel(program: ControlProgram, number: int, kind: Kind) -> Kernel:
    term, read = kind.expression, kind.arguments
    codes = {symbol: f"values[{i}]" for i, symbol in enumerate(read)}
    codes |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(parameters(program))}
    slopes = [Output(f"slopes[{i}]", sympy.diff(term, a), f"by {a}") for i, a in enumerate(read)]
    curvatures = [
        Output(f"curvatures[{i * len(read) + j}]", sympy.diff(term, a, b), f"by {a} and {b}")
        for i, a in enumerate(read)
        for j, b in enumerate(read)
    ]
    detail = "with its first and second derivatives" if read else "which depends on no unknown"
    summary = f"{sympy.sstr(term)}, {detail}."
    arguments = ("values", "parameters", "slopes", "curvatures")
    return kernel(f"coupling_{number}", summary, arguments, codes, [*slopes, *curvatures], term, decorators=INNER)


def _tables(instances: Sequence[Instance]) -> list[Line]:
    width = max(1, *(len(instance.indices) for instance in instances))
    rows = [[*instance.indices, *[0] * (width - len(instance.indices))] for instance in instances]
    return [
        Line("COUPLING_KINDS", integers([i.kind for i in instances]), "kind of every term of the conditions"),
        Line("COUPLING_ROWS", integers([i.row for i in instances]), "condition to which it belongs"),
        Line("COUPLING_COUNTS", integers([len(i.indices) for i in instances]), "how many shared unknowns it reads"),
        Line("COUPLING_INDICES", f"np.array({rows}, dtype=np.int64)", "and which"),
    ]


def sample_kernels(
    program: ControlProgram, derivatives: ControlDerivatives, codes: Mapping[Symbol, str]
) -> tuple[Kernel, ...]:
    """What the motion has at a sample, gradient and Hessian of what that adds to its interval; none without samples."""
    found = derivatives.sample
    if program.sample is None or found is None:
        return ()
    places = (f"parameters[sample + {number}]" for number, _ in enumerate(program.sample.symbols, start=1))
    codes = {**codes, **dict(zip(program.sample.symbols, places, strict=True))}
    index = {(row, column): j for j, (row, column, _) in enumerate(derivatives.element.hessian)}
    gradient = [
        Output(f"gradient[{i}]", value, f"by {symbol}", "+=")
        for i, (symbol, value) in enumerate(zip(found.unknowns, found.gradient, strict=True))
        if value != 0
    ]
    observed = zip(program.sample.observed, program.model.observed, strict=True)
    values = [Output(f"values[{i}]", value, f"{o.name} measures it") for i, (value, o) in enumerate(observed)]
    hessian = [
        Output(f"hessian[{index[row, column]}]", value, f"by {found.unknowns[row]}, {found.unknowns[column]}", "+=")
        for row, column, value in found.hessian
    ]
    arguments, at = ("unknowns", "t", "h", "parameters", "sample"), "that stands at `sample` among the `parameters`"
    return (
        kernel(
            "sample_values", f"What the motion has, `values` (m,), at the time of a sample {at}.",
            (*arguments, "values"), codes, values, decorators=INNER,
        ),
        kernel(
            "sample_gradient", f"Add the gradient of the losses of a sample {at}; returns them.",
            (*arguments, "gradient"), codes, gradient, found.cost,
            decorators=INNER, straight_line=found.gradient_assignments,
        ),
        kernel(
            "sample_hessian", f"Add the Hessian, lower triangle, of the losses of a sample {at}.",
            (*arguments, "hessian"), codes, hessian,
            decorators=INNER, straight_line=found.hessian_assignments,
        ),
    )  # fmt: skip


def sample_constants(program: ControlProgram, tables: Sequence[TableData]) -> tuple[Line, ...]:
    """Where samples stand, how many numbers one has, and the measurements themselves."""
    if program.sample is None:
        return ()
    written = "".join(f"{_array(data)},\n" for data in program.model.measurements)
    return (
        Line("FIRST_SAMPLE", str(first_sample(program, tables)), "parameters before those of samples"),
        Line("SAMPLE", str(1 + len(program.sample.symbols)), "numbers of a sample: when and where, values, weights"),
        Line("OBSERVATIONS", f"(\n{written})", "of each body rows of time, values, standard deviations"),
    )


def first_sample(program: ControlProgram, tables: Sequence[TableData]) -> int:
    """How many numbers stand before samples."""
    return len(parameters(program)) + sum(table.shape.count for table in tables)


def _array(data: MeasurementData) -> str:
    text = ", ".join(repr(number) for row in data.rows for number in row).replace("nan", "np.nan")
    lines = textwrap.wrap(text, 108, initial_indent=" " * 8, subsequent_indent=" " * 8, break_on_hyphens=False)
    return "    np.array([\n" + "\n".join(lines) + f"\n    ]).reshape(-1, {data.layout.width})"


def data_arguments(program: ControlProgram, tables: Sequence[TableData], grid_code: str) -> dict[str, Any]:
    """The arguments that take other numbers for tables and measurements, and the code that makes a grid with them.

    `grid_code` makes a grid without them.
    """
    arguments, code = [], grid_code
    if tables:
        meaning = "`tables` maps names of tables to other numbers in the order of TABLES, on as many breakpoints."
        arguments.append(("tables", meaning))
        code = f"with_tables({code}, tables)"
    if program.sample:
        meaning = "`observations` are other measurements, any number of them, in the order of OBSERVATIONS."
        arguments.append(("observations", meaning))
        code = f"with_observations({code}, observations)"
    return {"data_arguments": tuple(arguments), "grid_code": code}


def sample_record(program: ControlProgram) -> ObservationRecord | None:
    """What a reader of other measurements, and of estimates, has to know."""
    model = program.model
    if not model.measurements:
        return None
    layout, values = model.measurements[0].layout, tuple(sstr(o.expression) for o in model.observed)
    sources = tuple(data.source for data in model.measurements)
    return ObservationRecord(sources, layout.time, layout.columns, layout.sigmas, values, model.loss)
