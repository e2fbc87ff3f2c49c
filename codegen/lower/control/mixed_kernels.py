"""Kernels of derivatives by data of shares of the Lagrangian: of intervals, samples, ends and coupled conditions."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import sympy
from sympy import Symbol

from codegen.derive.mixed import ControlSensitivities, DataDerivatives, data_of
from codegen.lower.control import phases
from codegen.lower.control.coupling import term_kinds
from codegen.lower.control.layout import parameters
from codegen.lower.kernels import INNER, Kernel, Output, kernel
from codegen.lower.module import Choice
from codegen.transcribe.program import ControlProgram

_ARGUMENTS = ("slopes", "mixed")
Codes = Callable[[Sequence[Symbol]], Mapping[Symbol, str]]
"""What reads the symbols of a kernel, by the unknowns that it has."""


def kernels_of(program: ControlProgram, found: ControlSensitivities, codes: Codes) -> tuple[Kernel, ...]:
    """Derivatives by data of all shares; `codes` reads the symbols of a kernel with some unknowns."""
    at, every = ("unknowns", "t", "h", "parameters"), program.element_symbols
    inside, data = codes(every), data_of(program)
    named = zip(phases.named_elements(program), found.elements, strict=True)
    kernels = [
        _kernel(f"{stem}_mixed", f"an interval's share l{where}", at, inside, share, (every, data))
        for (stem, where), share in named
    ]
    if program.sample is not None and found.sample is not None:
        places = (f"parameters[sample + {number}]" for number, _ in enumerate(program.sample.symbols, start=1))
        own = {**inside, **dict(zip(program.sample.symbols, places, strict=True))}
        index = {(row, column): j for j, (row, column, _) in enumerate(found.elements[0].mixed)}
        kernels.append(
            _kernel(
                "sample_mixed", "the losses l of a sample", (*at, "sample"), own, found.sample, (every, data), index
            )
        )
    for name, share, node in (
        ("start", found.start, program.left_symbols),
        ("end", found.end, program.right_symbols),
    ):
        unknowns, read = (*node, *program.shared_symbols), ("unknowns", "t", "parameters")
        kernels.append(
            _kernel(
                f"{name}_mixed", f"the {name}'s own share l", read, codes(unknowns), share, (unknowns, (*data, *node))
            )
        )
    return (*kernels, *_coupling_kernels(program))


def _kernel(
    name: str,
    what: str,
    arguments: Sequence[str],
    codes: Mapping[Symbol, str],
    share: DataDerivatives,
    symbols: tuple[Sequence[Symbol], Sequence[Symbol]],
    index: Mapping[tuple[int, int], int] | None = None,
) -> Kernel:
    """The kernel of one share, by unknowns and data; with the `index` of a pattern it adds to what intervals have."""
    unknowns, data = symbols
    operator = "=" if index is None else "+="
    outputs = [Output(f"slopes[{i}]", value, f"dl/d{data[i]}", operator) for i, value in share.slopes]
    for j, (row, column, value) in enumerate(share.mixed):
        place, meaning = j if index is None else index[row, column], f"d2l/d{unknowns[row]} d{data[column]}"
        outputs.append(Output(f"mixed[{place}]", value, meaning, operator))
    summary = f"{'Derivatives' if index is None else 'Add derivatives'} of {what}: `slopes` (DATA,) by data, "
    summary += "`mixed` by unknowns and data."
    return kernel(
        name, summary, (*arguments, *_ARGUMENTS), codes, outputs, decorators=INNER, straight_line=share.assignments
    )


def _coupling_kernels(program: ControlProgram) -> list[Kernel]:
    """The same for every kind of term in the conditions between shared unknowns."""
    kernels, data = [], data_of(program)
    for number, kind in enumerate(term_kinds(program)):
        codes = {symbol: f"values[{i}]" for i, symbol in enumerate(kind.arguments)}
        codes |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(parameters(program))}
        outputs = []
        for j, datum in enumerate(data):
            slope = sympy.diff(kind.expression, datum)
            if slope == 0:
                continue
            outputs.append(Output(f"slopes[{j}]", slope, f"by {datum}"))
            for i, argument in enumerate(kind.arguments):
                if (second := sympy.diff(slope, argument)) != 0:
                    outputs.append(Output(f"mixed[{i}, {j}]", second, f"by {argument} and {datum}"))
        summary = f"Derivatives of {sympy.sstr(kind.expression)}: `slopes` (DATA,) by data, `mixed` by arguments, too."
        arguments = ("values", "parameters", *_ARGUMENTS)
        kernels.append(kernel(f"coupling_{number}_mixed", summary, arguments, codes, outputs, decorators=INNER))
    return kernels


def choices(program: ControlProgram) -> tuple[Choice, ...]:
    """The function that chooses the kernel of an interval where there are phases."""
    if not program.phases:
        return ()
    summary = "Derivatives of an interval's share l: `slopes` (DATA,) by data, `mixed` by unknowns and data."
    return (phases.choice(program, "mixed", summary, _ARGUMENTS),)
