"""How pinned values, bounds and durations follow quantities, as code: formulas outside the shares of the Lagrangian."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import sympy
from sympy import Expr, Symbol

from codegen.lower.control import phases
from codegen.lower.control.coupling import term_kinds
from codegen.lower.control.layout import (
    Bound,
    bound_values,
    bound_views,
    common_code,
    duration_inputs,
    inputs,
    parameters,
    slack_bounds,
    views,
)
from codegen.lower.kernels import Line
from codegen.lower.module import SensitivityText
from codegen.lower.printer import array_code, scalar_code
from codegen.transcribe.program import ControlProgram


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
