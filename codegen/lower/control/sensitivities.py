"""What a module needs for sensitivities, as strings: kernels, constants, sizes and functions.

Data are parameters, boundary values, conditions at inner times, and where an interval is in time.
"""

from __future__ import annotations

from dataclasses import dataclass

from codegen.derive.mixed import ControlSensitivities, data_of
from codegen.lower.control.data_rates import bound_lines, bounding, text_of, varies_duration
from codegen.lower.control.layout import integers, parameters
from codegen.lower.control.mixed_kernels import Codes, kernels_of
from codegen.lower.kernels import Kernel, Line
from codegen.lower.module import SensitivityText
from codegen.transcribe.program import ControlProgram


@dataclass(frozen=True)
class Added:
    """What a module has more that makes sensitivities: nothing, unless they are asked for."""

    kernels: tuple[Kernel, ...] = ()
    constants: tuple[Line, ...] = ()
    quantities: tuple[str, ...] | None = None
    text: tuple[SensitivityText, ...] = ()


def added(program: ControlProgram, found: ControlSensitivities | None, codes: Codes) -> Added:
    """Return the parts of a module that belong to derivatives by data, if there are any."""
    if found is None:
        return Added()
    return Added(
        kernels=kernels_of(program, found, codes),
        constants=tuple(_constants(program, found)),
        quantities=quantities(program),
        text=(text_of(program),),
    )


def quantities(program: ControlProgram) -> tuple[str, ...]:
    """What derivatives are by, with the names that sweeps have: parameters, boundary values, a given duration."""
    names = [*(p.name for p in program.model.parameters), *(f"{v.where}.{v.quantity}" for v in program.boundary_values)]
    return (*names, *(("duration",) if varies_duration(program) else ()))


def _constants(program: ControlProgram, found: ControlSensitivities) -> list[Line]:
    """What derivatives are by, and patterns."""
    names, data = quantities(program), data_of(program)
    given = len(parameters(program)) - len(program.shared_symbols)
    shares = [*found.elements, *(share for share in (found.sample,) if share is not None)]
    acting = sorted({i for share in shares for i, _ in share.slopes if i < given})
    lines = [
        Line("QUANTITIES", repr(names), "what derivatives of solutions are by"),
        Line("DATA", str(len(data)), f"what shares are differentiated by: {', '.join(map(str, data))}"),
        Line("PARAMETRIC", str(given), "of these stand among the parameters"),
        Line("ACTING", integers(acting), "of these act on intervals"),
        Line("OWN_QUANTITIES", str(given - len(program.inner.parameters)), "of these are quantities"),
    ]
    if bound_lines(program):
        lines.append(Line("BOUNDING", integers(bounding(program)), "of these move bounds"))
    for prefix, share in (("", found.elements[0]), ("START_", found.start), ("END_", found.end)):
        lines.append(Line(f"{prefix}MIXED_ROWS", integers([row for row, _, _ in share.mixed]), "unknowns"))
        lines.append(Line(f"{prefix}MIXED_COLUMNS", integers([column for _, column, _ in share.mixed]), "data"))
    if program.inner.clock is not None:
        lines.append(Line("CLOCK", str(program.inner.clock), "the time of a node among its unknowns"))
    return lines
