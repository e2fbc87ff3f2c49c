"""What a module needs for sensitivities, as strings: kernels, constants, sizes and functions.

Data are parameters, boundary values, conditions at inner times, and where an interval is in time.

How pinned values, bounds and durations follow quantities, as code: formulas outside the shares of the Lagrangian.

Kernels of derivatives by data of shares of the Lagrangian: of intervals, samples, ends and coupled conditions.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Symbol

from codegen.discretise.program import ControlProgram
from codegen.emit.differentiation import ControlSensitivities, DataDerivatives, data_of
from codegen.emit.lower.control import phases
from codegen.emit.lower.control.kernels import term_kinds
from codegen.emit.lower.control.layout import (
    Bound,
    bound_values,
    bound_views,
    common_code,
    duration_inputs,
    inputs,
    integers,
    parameters,
    slack_bounds,
    views,
)
from codegen.emit.lower.kernels import INNER, Kernel, Line, Output, kernel
from codegen.emit.lower.module import Choice, SensitivityText
from codegen.emit.lower.printer import array_code, scalar_code


def text_of(program: ControlProgram) -> SensitivityText:
    """The functions that say how pinned values, bounds and durations follow quantities, and what follows from these."""
    rates, following, read = _rates(program)
    pins, pinned = _pins(program)
    lines = bound_lines(program)
    durations = [p.duration for p in program.phases] or [program.model.duration]
    own_momenta = "momentum_rates(grid, unknowns, found, i)"
    return SensitivityText(
        rate_inputs=_scalar_inputs(program, read) if _is_same(program) else inputs(program, read, column=False),
        rates=tuple(rates),
        following=tuple(following),
        pin_inputs=_pin_inputs(program, pinned),
        pins=tuple(pins),
        duration_inputs=_duration_inputs(program, durations) if program.scaled_time else (),
        durations=_durations_code(program, durations),
        momenta=own_momenta if program.method == "variational" else views(program)["momenta"],
        bound_inputs=_bound_inputs(program) if lines else (),
        bounds=(tuple(lines),) if lines else (),
        coupling_kinds=(tuple(f"coupling_{i}_mixed" for i, _ in enumerate(term_kinds(program))),)
        if program.couplings
        else (),
        fields=_fields(program),
    )


def _fields(program: ControlProgram) -> tuple[tuple[str, str], ...]:
    """Return fields of the record `DataDerivatives` with their code."""
    constants = {
        "quantities": "QUANTITIES", "count": "DATA", "parametric": "PARAMETRIC", "acting": "ACTING",
        "rows": "MIXED_ROWS", "columns": "MIXED_COLUMNS",
        **{f"{end}_{side}": f"{end}_mixed_{side}".upper() for end in ("start", "end") for side in ("rows", "columns")},
        "loop": "data_loop", "rates": "data_rates", "pins": "pinned_rates", "durations": "duration_rates",
    }  # fmt: skip
    if bound_lines(program):
        constants |= {"bounds": "bound_rates", "bounding": "BOUNDING"}
    if program.inner.clock is not None:
        constants["clock"] = "CLOCK"
    return tuple(constants.items())


def _rates(program: ControlProgram) -> tuple[list[Line], list[tuple[str, tuple[Line, ...]]], list[Expr]]:
    """How boundary values, conditions at inner times and the duration follow parameters, and what that reads."""
    model, read = program.model, list[Expr]()
    numbers = scalar_code if _is_same(program) else array_code
    count = len(model.parameters) + len(program.boundary_values)

    def lines(target: str, value: Expr, code: Callable[[Expr], str]) -> tuple[Line, ...]:
        slopes = [(j, parameter, sympy.diff(value, parameter)) for j, parameter in enumerate(model.parameters)]
        slopes = [slope for slope in slopes if slope[2] != 0]
        read.extend(slope for _, _, slope in slopes)
        return tuple(Line(target.format(j), code(slope), f"by {parameter}") for j, parameter, slope in slopes)

    own = [Line("duration[-1]", "1.0", "by itself")] if varies_duration(program) else []
    for i, value in enumerate(program.inner.values):
        own += lines(f"rates[{{}}, :, {count + i}]", value, numbers)
    following = [
        (f"{v.where}.{v.quantity}", lines(f"rates[{{}}, :, {i}]", v.value, numbers))
        for i, v in enumerate(program.boundary_values, start=len(model.parameters))
    ]
    if varies_duration(program):
        code = scalar_code if _is_same(program) else common_code
        following.append(("duration", lines("duration[{}]", model.duration, code)))
    return own, [(name, found) for name, found in following if found], read


def _is_same(program: ControlProgram) -> bool:
    """Whether what follows parameters does so in the same way for all bodies: then numbers do instead of arrays."""
    values = (*(v.value for v in program.boundary_values), *program.inner.values)
    return program.body is None or not any(value.has(program.body) for value in values)


def _scalar_inputs(program: ControlProgram, values: Sequence[Expr]) -> tuple[Line, ...]:
    used = set[Symbol]().union(*(value.free_symbols for value in values))
    known = enumerate(program.model.parameters)
    return tuple(Line(s.name, f"float(grid.parameters[0, {i}])") for i, s in known if s in used)


def varies_duration(program: ControlProgram) -> bool:
    """Whether a duration is given that may be another: not where samples, which lie at times, would move in it."""
    return not program.scaled_time and program.sample is None


def _data(program: ControlProgram) -> tuple[Symbol, ...]:
    """What stands among the parameters and is no unknown."""
    every = parameters(program)
    return every[: len(every) - len(program.shared_symbols)]


def _rate_of(symbol: Symbol, taken: Collection[Symbol]) -> Symbol:
    """The symbol of a rate, with a name that no symbol of those `taken` has."""
    name = f"{symbol.name}_rate"
    while any(name == other.name for other in taken):
        name += "_"
    return Symbol(name, real=True)


def _along(value: Expr, symbols: Sequence[Symbol]) -> Expr:
    """The derivative of a value along rates of symbols."""
    return sympy.Add(*(sympy.diff(value, s) * _rate_of(s, symbols) for s in symbols if value.has(s)))


def _rate_inputs(program: ControlProgram, values: Sequence[Expr], code: str) -> tuple[Line, ...]:
    used = set[Symbol]().union(*(value.free_symbols for value in values))
    rates = [_rate_of(s, _data(program)) for s in _data(program)]
    return tuple(Line(rate.name, code.format(i)) for i, rate in enumerate(rates) if rate in used)


def _pins(program: ControlProgram) -> tuple[list[Line], list[Expr]]:
    """Derivatives of pinned values, and of what end nodes are away from shared unknowns that they equal."""
    lines, values = [], []
    for place, end in (("{}", program.start), ("{} - NODE", program.end)):
        given = sorted([*end.pins, *((index, offset) for index, _, offset in end.shared)], key=lambda pair: pair[0])
        for index, value in given:
            along = _along(value, _data(program))
            if along != 0:
                lines.append(Line(f"chains[:, :, {place.format(index)}]", array_code(along), program.node[index].name))
                values.append(along)
    return lines, values


def _pin_inputs(program: ControlProgram, pinned: Sequence[Expr]) -> tuple[Line, ...]:
    """The unknowns of each body as a view, and what derivatives of pinned values read."""
    if not pinned:
        return ()
    return (
        Line("chain", "grid.steps * STRIDE + NODE"),
        Line("chains", "moves[:, : BODIES * chain].reshape(len(rates), BODIES, chain)"),
        *inputs(program, pinned, column=False),
        *_rate_inputs(program, pinned, "rates[:, :, {}]"),
    )


def _durations(durations: Sequence[Expr], symbols: Sequence[Symbol]) -> list[Expr]:
    return [_along(duration, symbols) for duration in durations]


def _duration_symbols(program: ControlProgram) -> tuple[Symbol, ...]:
    return (*program.model.parameters, *program.shared_symbols[program.own :])


def _durations_code(program: ControlProgram, durations: Sequence[Expr]) -> str:
    """Code of derivatives (m, D) of the durations of D phases, or of all."""
    if not program.scaled_time:
        return "duration[:, None]"
    codes = [scalar_code(along) for along in _durations(durations, _duration_symbols(program))]
    return f"np.stack([{', '.join(f'np.broadcast_to({code}, len(vectors))' for code in codes)}], axis=1)"


def _duration_inputs(program: ControlProgram, durations: Sequence[Expr]) -> tuple[Line, ...]:
    along = _durations(durations, _duration_symbols(program))
    used = set[Symbol]().union(*(value.free_symbols for value in along))
    first = len(program.shared) - program.own + len(program.couplings)
    codes = {s: f"vectors[:, {j - first}]" for j, s in enumerate(program.shared_symbols[program.own :])}
    codes |= {s: f"rates[:, 0, {i}]" for i, s in enumerate(program.model.parameters)}
    rates = {_rate_of(s, _duration_symbols(program)): code for s, code in codes.items()}
    lines = [Line(rate.name, code) for rate, code in rates.items() if rate in used]
    return (*duration_inputs(program, along), *lines)


def _found_bounds(program: ControlProgram) -> list[Bound]:
    return phases.bound_values(program) if program.phases else bound_values(program)


def bound_lines(program: ControlProgram) -> list[Line]:
    """Derivatives of bounds along rates, in the order in which bounds are given, if any depends on parameters."""
    if not program.has_inequalities:
        return []
    data = _data(program)
    found = [Bound(b.target, _along(b.value, data), b.name, b.is_common) for b in _found_bounds(program)]
    if all(bound.value == 0 for bound in found):
        return []
    still = [Line(line.target, "0.0", line.comment) for line in slack_bounds(program)]
    return [*(Bound(b.target, b.value, b.name, b.is_common).line for b in found), *still]


def bounding(program: ControlProgram) -> list[int]:
    """Those of the data that move bounds."""
    return [i for i, datum in enumerate(_data(program)) if any(b.value.has(datum) for b in _found_bounds(program))]


def _bound_inputs(program: ControlProgram) -> tuple[Line, ...]:
    along = [_along(bound.value, _data(program)) for bound in _found_bounds(program)]
    steps = (Line("steps", "grid.steps // PHASES"),) if program.phases else ()
    read = (*inputs(program, along), *_rate_inputs(program, along, "rates[:, {}, None]"))
    return (*steps, *read, *bound_views(program))


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
