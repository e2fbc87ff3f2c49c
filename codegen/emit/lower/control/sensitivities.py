"""Sensitivities in a control module: kernels of mixed derivatives, constants, and directional derivatives.

Data are parameters, boundary values, conditions at inner times, and the time and length of an interval. Quantities are
the data that a user may vary. Kernels compute derivatives, with respect to data, of shares: the contributions of
intervals, samples and ends to the Lagrangian. Prescribed values, bounds and durations are formulas outside the shares.
They have directional derivatives along rates, which are derivatives of all parameters with respect to a quantity.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import sympy
from sympy import Expr, Symbol

from codegen.discretise.program import ControlProgram
from codegen.emit.differentiation import ControlSensitivities, DataDerivatives, data_of
from codegen.emit.lower.control.kernels import coupling_terms, named_elements, sample_codes, symbol_codes, term_codes
from codegen.emit.lower.control.layout import (
    Bound,
    bound_values,
    bound_views,
    common_code,
    duration_inputs,
    inputs,
    integers,
    parameters,
    phase_steps,
    slack_bounds,
    solution,
)
from codegen.emit.lower.kernels import INNER, Kernel, Line, Output, kernel
from codegen.emit.lower.module import SensitivityText
from codegen.emit.lower.printer import array_code, scalar_code

_ARGUMENTS = ("slopes", "mixed")


def quantities(program: ControlProgram) -> tuple[str, ...]:
    """Return the names of quantities that a user may vary: parameters, boundary values, and a prescribed duration."""
    names = [*(p.name for p in program.model.parameters), *(f"{v.where}.{v.quantity}" for v in program.boundary_values)]
    return (*names, *(("duration",) if _varies_duration(program) else ()))


def constants(program: ControlProgram, derivatives: ControlSensitivities) -> tuple[Line, ...]:
    """Return constants of the module: the quantities, counts of data, and patterns of mixed derivatives."""
    data, prescribed = data_of(program), _data(program)
    count = len(prescribed)
    shares = [*derivatives.elements, *(share for share in (derivatives.sample,) if share is not None)]
    acting = sorted({i for share in shares for i, _ in share.slopes if i < count})
    lines = [
        Line("QUANTITIES", repr(quantities(program)), "quantities of the derivatives of solutions"),
        Line("DATA", str(len(data)), f"data of the derivatives of the Lagrangian: {', '.join(map(str, data))}"),
        Line("PARAMETRIC", str(count), "data among the parameters"),
        Line("ACTING", integers(acting), "data that act on intervals"),
        Line("OWN_QUANTITIES", str(count - len(program.inner.parameters)), "data that are quantities"),
    ]
    if _bound_rates(program):
        values = [bound.value for bound in bound_values(program)]
        moving = [i for i, datum in enumerate(prescribed) if any(value.has(datum) for value in values)]
        lines.append(Line("BOUNDING", integers(moving), "of these move bounds"))
    for prefix, share in (("", derivatives.elements[0]), ("START_", derivatives.start), ("END_", derivatives.end)):
        lines.append(Line(f"{prefix}MIXED_ROWS", integers([row for row, _, _ in share.mixed]), "unknowns"))
        lines.append(Line(f"{prefix}MIXED_COLUMNS", integers([column for _, column, _ in share.mixed]), "data"))
    if program.inner.clock is not None:
        lines.append(Line("CLOCK", str(program.inner.clock), "the time of a node among its unknowns"))
    return tuple(lines)


def kernels(program: ControlProgram, derivatives: ControlSensitivities) -> tuple[Kernel, ...]:
    """Return kernels of derivatives with respect to data for intervals, samples, ends and conditions between bodies."""
    arguments, every, data = ("unknowns", "t", "h", "parameters"), program.element_symbols, data_of(program)
    codes = symbol_codes(program, every)
    written = [
        _mixed_kernel(f"{stem}_mixed", f"an interval's share l{where}", arguments, codes, share, (every, data))
        for (stem, where), share in zip(named_elements(program), derivatives.elements, strict=True)
    ]
    if program.sample is not None and derivatives.sample is not None:
        index = {(row, column): j for j, (row, column, _) in enumerate(derivatives.elements[0].mixed)}
        written.append(
            _mixed_kernel(
                "sample_mixed", "the losses l of a sample", (*arguments, "sample"), sample_codes(program),
                derivatives.sample, (every, data), index,
            )
        )  # fmt: skip
    for name, share, node in (
        ("start", derivatives.start, program.left_symbols),
        ("end", derivatives.end, program.right_symbols),
    ):
        unknowns = (*node, *program.linking.symbols)
        written.append(
            _mixed_kernel(
                f"{name}_mixed", f"the {name}'s own share l", ("unknowns", "t", "parameters"),
                symbol_codes(program, unknowns), share, (unknowns, (*data, *node)),
            )
        )  # fmt: skip
    for number, kind in enumerate(coupling_terms(program)[0]):
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
        written.append(
            kernel(
                f"coupling_{number}_mixed", summary, ("values", "parameters", *_ARGUMENTS), term_codes(program, kind),
                outputs, decorators=INNER,
            )
        )  # fmt: skip
    return tuple(written)


def _mixed_kernel(
    name: str,
    what: str,
    arguments: Sequence[str],
    codes: Mapping[Symbol, str],
    share: DataDerivatives,
    symbols: tuple[Sequence[Symbol], Sequence[Symbol]],
    index: Mapping[tuple[int, int], int] | None = None,
) -> Kernel:
    """Return the kernel that fills, for one contribution to the Lagrangian, derivatives by data and mixed derivatives.

    `symbols` are (unknowns, data). With `index`, (unknown, datum) -> entry of an interval, it adds to that interval.
    """
    unknowns, data = symbols
    operator = "=" if index is None else "+="
    outputs = [Output(f"slopes[{i}]", value, f"dl/d{data[i]}", operator) for i, value in share.slopes]
    for j, (row, column, value) in enumerate(share.mixed):
        entry, meaning = j if index is None else index[row, column], f"d2l/d{unknowns[row]} d{data[column]}"
        outputs.append(Output(f"mixed[{entry}]", value, meaning, operator))
    summary = f"{'Derivatives' if index is None else 'Add derivatives'} of {what}: `slopes` (DATA,) by data, "
    summary += "`mixed` by unknowns and data."
    return kernel(
        name, summary, (*arguments, *_ARGUMENTS), codes, outputs, decorators=INNER, straight_line=share.assignments
    )


def text_of(program: ControlProgram) -> SensitivityText:
    """Return the code of the derivatives of parameters, prescribed values, bounds and durations along rates."""
    data, bound_lines = _data(program), _bound_rates(program)
    pins, pin_rates = [], list[Expr]()
    for node, end in (("{}", program.start), ("{} - NODE", program.end)):
        tied = ((index, offset) for index, _, offset in end.shared)
        for index, value in sorted([*end.pins, *tied], key=lambda pair: pair[0]):
            rate = _rate(value, data)
            if rate != 0:
                pins.append(Line(f"chains[:, :, {node.format(index)}]", array_code(rate), program.node[index].name))
                pin_rates.append(rate)
    pin_inputs = (
        Line("chain", "grid.steps * STRIDE + NODE"),
        Line("chains", "moves[:, : BODIES * chain].reshape(len(rates), BODIES, chain)"),
        *inputs(program, pin_rates, column=False),
        *_rate_inputs(program, pin_rates, "rates[:, :, {}]"),
    )
    durations, duration_lines = "duration[:, None]", tuple[Line, ...]()
    if program.scaled_time:
        symbols = (*program.model.parameters, *program.linking.common_symbols)
        parts = [phase.duration for phase in program.phases] or [program.model.duration]
        rates = [_rate(duration, symbols) for duration in parts]
        codes = ", ".join(f"np.broadcast_to({scalar_code(rate)}, len(vectors))" for rate in rates)
        durations = f"np.stack([{codes}], axis=1)"
        used = set[Symbol]().union(*(rate.free_symbols for rate in rates))
        first = len(program.linking.common) + len(program.linking.couplings)
        reads = {s: f"vectors[:, {j - first}]" for j, s in enumerate(program.linking.common_symbols)}
        reads |= {s: f"rates[:, 0, {i}]" for i, s in enumerate(program.model.parameters)}
        named = [(_rate_symbol(symbol, symbols), code) for symbol, code in reads.items()]
        lines = [Line(symbol.name, code) for symbol, code in named if symbol in used]
        duration_lines = (*duration_inputs(program, rates), *lines)
    bound_inputs = tuple[Line, ...]()
    if bound_lines:
        rates = [_rate(bound.value, data) for bound in bound_values(program)]
        bound_inputs = (
            *phase_steps(program),
            *inputs(program, rates),
            *_rate_inputs(program, rates, "rates[:, {}, None]"),
            *bound_views(program),
        )
    kinds = coupling_terms(program)[0]
    is_variational = program.method == "variational"
    rate_inputs, own_rates, following = _quantity_rates(program)
    return SensitivityText(
        rate_inputs=rate_inputs,
        rates=own_rates,
        following=following,
        pin_inputs=pin_inputs if pins else (),
        pins=tuple(pins),
        duration_inputs=duration_lines,
        durations=durations,
        momenta="momentum_rates(grid, unknowns, found, i)" if is_variational else solution(program).momenta,
        bound_inputs=bound_inputs,
        bounds=(bound_lines,) if bound_lines else (),
        coupling_kinds=(tuple(f"coupling_{i}_mixed" for i, _ in enumerate(kinds)),) if kinds else (),
        fields=tuple(
            {
                "quantities": "QUANTITIES", "count": "DATA", "parametric": "PARAMETRIC", "acting": "ACTING",
                "rows": "MIXED_ROWS", "columns": "MIXED_COLUMNS",
                "start_rows": "START_MIXED_ROWS", "start_columns": "START_MIXED_COLUMNS",
                "end_rows": "END_MIXED_ROWS", "end_columns": "END_MIXED_COLUMNS",
                "loop": "data_loop", "rates": "data_rates", "pins": "pinned_rates", "durations": "duration_rates",
                **({"bounds": "bound_rates", "bounding": "BOUNDING"} if bound_lines else {}),
                **({"clock": "CLOCK"} if program.inner.clock is not None else {}),
            }.items()
        ),
    )  # fmt: skip


def _quantity_rates(
    program: ControlProgram,
) -> tuple[tuple[Line, ...], tuple[Line, ...], tuple[tuple[str, tuple[Line, ...]], ...]]:
    """Return code of boundary values', inner conditions' and the duration's derivatives with respect to parameters.

    The first lines read symbols. The second lines always hold. The third are pairs of a quantity and lines that hold
    unless the caller replaces its value. The code is scalar if no value depends on the body.
    """
    model, read = program.model, list[Expr]()
    values = (*(v.value for v in program.boundary_values), *program.inner.values)
    is_same = program.model.body is None or not any(value.has(program.model.body) for value in values)
    numbers = scalar_code if is_same else array_code
    count = len(model.parameters) + len(program.boundary_values)

    def lines(target: str, value: Expr, code: Callable[[Expr], str]) -> tuple[Line, ...]:
        slopes = [(j, parameter, sympy.diff(value, parameter)) for j, parameter in enumerate(model.parameters)]
        slopes = [slope for slope in slopes if slope[2] != 0]
        read.extend(slope for _, _, slope in slopes)
        return tuple(Line(target.format(j), code(slope), f"by {parameter}") for j, parameter, slope in slopes)

    rates = [Line("duration[-1]", "1.0", "by itself")] if _varies_duration(program) else []
    for i, value in enumerate(program.inner.values):
        rates += lines(f"rates[{{}}, :, {count + i}]", value, numbers)
    following = [
        (f"{v.where}.{v.quantity}", lines(f"rates[{{}}, :, {i}]", v.value, numbers))
        for i, v in enumerate(program.boundary_values, start=len(model.parameters))
    ]
    if _varies_duration(program):
        code = scalar_code if is_same else common_code
        following.append(("duration", lines("duration[{}]", model.duration, code)))
    rate_inputs = inputs(program, read, column=False)
    if is_same:
        used = set[Symbol]().union(*(value.free_symbols for value in read))
        symbols = enumerate(model.parameters)
        rate_inputs = tuple(Line(s.name, f"float(grid.parameters[0, {i}])") for i, s in symbols if s in used)
    return rate_inputs, tuple(rates), tuple((name, written) for name, written in following if written)


def _varies_duration(program: ControlProgram) -> bool:
    """Return True if a user may vary a prescribed duration; samples forbid this, since they lie at fixed times."""
    return not program.scaled_time and program.sample is None


def _data(program: ControlProgram) -> tuple[Symbol, ...]:
    """Return the symbols in the vector of parameters, without linking variables."""
    every = parameters(program)
    return every[: len(every) - len(program.linking.symbols)]


def _rate_symbol(symbol: Symbol, taken: Sequence[Symbol]) -> Symbol:
    """Return the symbol for the rate of a symbol, with a name that no symbol in `taken` has."""
    name = f"{symbol.name}_rate"
    while any(name == other.name for other in taken):
        name += "_"
    return Symbol(name, real=True)


def _rate(value: Expr, symbols: Sequence[Symbol]) -> Expr:
    """Return the directional derivative of a value along the rates of `symbols`."""
    return sympy.Add(*(sympy.diff(value, s) * _rate_symbol(s, symbols) for s in symbols if value.has(s)))


def _rate_inputs(program: ControlProgram, values: Sequence[Expr], code: str) -> tuple[Line, ...]:
    """Return lines that read the rates in some expressions; `code` has {} for the index of the datum."""
    used, data = set[Symbol]().union(*(value.free_symbols for value in values)), _data(program)
    rates = [_rate_symbol(symbol, data) for symbol in data]
    return tuple(Line(rate.name, code.format(i)) for i, rate in enumerate(rates) if rate in used)


def _bound_rates(program: ControlProgram) -> tuple[Line, ...]:
    """Return code of the derivatives of all bounds along rates; empty if no bound depends on parameters."""
    if not program.has_inequalities:
        return ()
    data = _data(program)
    rates = [Bound(b.target, _rate(b.value, data), b.name, b.is_common) for b in bound_values(program)]
    if all(bound.value == 0 for bound in rates):
        return ()
    still = [Line(line.target, "0.0", line.comment) for line in slack_bounds(program)]
    return (*(bound.line for bound in rates), *still)
