"""ControlProgram and its derivatives -> ControlModule: kernels, index arrays and boundary data as strings."""

from __future__ import annotations

from collections.abc import Sequence

import sympy
from sympy import Expr, Symbol

from codegen.derive import ControlDerivatives, ElementDerivatives
from codegen.discretise import STEP
from codegen.lower.kernels import INNER, PLAIN, Kernel, Line, Output, kernel
from codegen.lower.module import Argument, ControlModule
from codegen.lower.printer import array_code, scalar_code
from codegen.transcribe.program import ControlProgram, EndElement, Unknown


def lower_control(program: ControlProgram, derivatives: ControlDerivatives) -> ControlModule:
    """Write every kernel and table of a control problem as strings."""
    model = program.model
    kernels = (
        *_interval_kernels(program, derivatives.element),
        *_control_kernels(program, derivatives),
        *_end_kernels(program, derivatives.start, "start", _pins(program.start)),
        *_end_kernels(program, derivatives.end, "end", _pins(program.end)),
    )
    return ControlModule(
        template="control.py.j2",
        name=model.name,
        title=model.title,
        description=tuple(_description(program, kernels)),
        left_out=tuple(_left_out(program, derivatives)),
        metadata=tuple(_metadata(program, kernels)),
        constants=tuple(_constants(program, derivatives)),
        kernels=kernels,
        runtime=_runtime(program, derivatives),
        arguments=tuple(
            Argument(p.name, repr(value)) for p, value in zip(model.parameters, model.defaults, strict=True)
        ),
        steps=model.steps,
        duration=scalar_code(model.duration),
        boundary_values=tuple(
            Line(v.symbol.name, scalar_code(v.value), f"{v.where} {v.quantity}") for v in program.boundary_values
        ),
        guess_inputs=_parameter_inputs(program, _guesses(program)),
        pin_inputs=_parameter_inputs(program, [v for end in (program.start, program.end) for _, v in end.pins]),
        start_values=_pin_lines(program.start),
        end_values=_pin_lines(program.end),
        node_guess=_node_guess(program),
        interval_guess=_interval_guess(program),
        interval_times=("grid.h * (0.5 + np.arange(grid.steps))",) if _interval_guess(program) else (),
        **_views(program),
        boundary_example=_boundary_example(program),
    )


def _parameters(program: ControlProgram) -> tuple[Symbol, ...]:
    return (*program.model.parameters, *(value.symbol for value in program.boundary_values))


def _unknown_symbols(program: ControlProgram) -> tuple[Symbol, ...]:
    return (*program.left_symbols, *program.interval_symbols, *program.control_symbols, *program.right_symbols)


def _places(program: ControlProgram, unknowns: Sequence[Symbol]) -> dict[Symbol, str]:
    """The code that reads each symbol inside a kernel."""
    places = {symbol: f"unknowns[{i}]" for i, symbol in enumerate(unknowns)}
    places |= {symbol: f"parameters[{i}]" for i, symbol in enumerate(_parameters(program))}
    places[program.model.time] = program.model.time.name if program.model.time.name == "t" else "t"
    places[STEP] = "h"
    return places


def _interval_kernels(program: ControlProgram, element: ElementDerivatives) -> tuple[Kernel, Kernel]:
    places = _places(program, element.unknowns)
    arguments = ("unknowns", "t", "h", "parameters", "gradient")
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
            "interval_gradient",
            "Gradient of an interval's share l of the optimisation problem's Lagrangian; returns the discrete cost.",
            arguments, places, gradient, program.cost, decorators=INNER,
        ),
        kernel(
            "interval_hessian",
            "Gradient and Hessian (lower triangle, nonzeros) of an interval's share l; returns the discrete cost.",
            (*arguments, "hessian"), places, [*gradient, *hessian], program.cost, decorators=INNER,
        ),
    )  # fmt: skip


def _control_kernels(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[Kernel, ...]:
    """The controls' block of the Hessian, where it is the same on every interval."""
    if not derivatives.condensed:
        return ()
    controls = {program.control_symbols.index(s): s for s in program.control_symbols}
    first = len(program.left_symbols) + len(program.interval_symbols)
    block = [
        Output(
            f"block[{row - first}, {column - first}]",
            value,
            f"d2l/d{controls[row - first]} d{controls[column - first]}",
        )
        for row, column, value in derivatives.element.hessian
        if row - first in controls and column - first in controls
    ]
    places = _places(program, derivatives.element.unknowns)
    summary = "Controls' block of the Hessian (lower triangle), the same on every interval."
    return (kernel("control_hessian", summary, ("h", "parameters", "block"), places, block, decorators=PLAIN),)


def _end_kernels(
    program: ControlProgram, end: ElementDerivatives, name: str, pins: dict[int, Expr]
) -> tuple[Kernel, ...]:
    places = _places(program, end.unknowns)
    what = "Add the gradient of lambda_0 . p(0)" if name == "start" else "Add the gradient of -lambda_N . p(T)"
    if program.method == "hamiltonian":
        what = f"Add the gradient of the conditions at the {name}"
    gradient = [
        Output(f"gradient[{i}]", value, f"by {symbol}", "+=")
        for i, (symbol, value) in enumerate(zip(end.unknowns, end.gradient, strict=True))
        if value != 0 and i not in pins
    ]
    arguments = ("unknowns", "t", "parameters", "gradient")
    # Evaluated once in a solution's every point, so compiling them would cost more than it saves.
    kernels = [kernel(f"{name}_gradient", f"{what}.", arguments, places, gradient, decorators=PLAIN)]
    if end.hessian:
        entries = [
            Output(f"hessian[{j}]", value, f"{end.unknowns[row]}, {end.unknowns[column]}")
            for j, (row, column, value) in enumerate(end.hessian)
        ]
        summary = f"Hessian (lower triangle, structural nonzeros) of the {name}'s own share."
        arguments = ("unknowns", "t", "parameters", "hessian")
        kernels.append(kernel(f"{name}_hessian", summary, arguments, places, entries, decorators=INNER))
    return tuple(kernels)


def _constants(program: ControlProgram, derivatives: ControlDerivatives) -> list[Line]:
    node, kept, controls = len(program.node), len(program.interval), len(program.controls)
    condensed = controls if derivatives.condensed else 0
    pattern = (*program.node, *program.interval, *program.controls)
    stride = node + kept + controls
    lines = [
        Line("NODE", str(node), f"unknowns of a node: {_names(program.node)}"),
        Line("CONTROLS", str(condensed), f"eliminated inside their interval: {_names(program.controls[:condensed])}"),
        Line("STRIDE", str(stride), "unknowns of a node and the interval after it" + _list(program.interval)),
        Line("ELEMENT", str(stride + node), "unknowns of an interval with both its nodes"),
        Line("IS_MULTIPLIER", _booleans(pattern), "of node and interval"),
        Line("START_PINNED", repr(tuple(_pins(program.start))), "unknowns of the first node that are given"),
        Line("END_PINNED", repr(tuple(_pins(program.end))), "unknowns of the last node that are given"),
        Line("ONLY_AT_ENDS", repr(program.only_at_ends), "unknowns that inner nodes do not have; they are zero there"),
        Line("HESSIAN_ROWS", _integers([r for r, _, _ in derivatives.element.hessian])),
        Line("HESSIAN_COLUMNS", _integers([c for _, c, _ in derivatives.element.hessian])),
    ]  # fmt: skip
    if _curved(derivatives):
        for name, end in (("START", derivatives.start), ("END", derivatives.end)):
            lines.append(Line(f"{name}_HESSIAN_ROWS", _integers([r for r, _, _ in end.hessian])))
            lines.append(Line(f"{name}_HESSIAN_COLUMNS", _integers([c for _, c, _ in end.hessian])))
    return lines


def _runtime(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[str, ...]:
    curved = _curved(derivatives)
    return (
        "lagrangian", "norms", "point", "elements",
        "ends_curved" if curved else "ends_flat",
        "element_condensed" if derivatives.condensed else "element_kept",
        "frontal", "rounding", "probe",
        *(("newton_linear",) if derivatives.linear_quadratic else ("descent", "newton_filter")),
        *(("momenta",) if program.method == "variational" else ()),
        "frame",
        "callbacks",
    )  # fmt: skip


def _curved(derivatives: ControlDerivatives) -> bool:
    """Whether an end has entries of the KKT matrix of its own; unknowns of its own always have."""
    return bool(derivatives.start.hessian or derivatives.end.hessian)


def _left_out(program: ControlProgram, derivatives: ControlDerivatives) -> list[str]:
    model = program.model
    out = []
    if derivatives.linear_quadratic:
        out.append("globalisation and inertia correction: the problem is linear-quadratic, one Newton step solves it")
    if derivatives.condensed:
        out.append(
            "controls in the linear system: their Hessian block is constant, so each interval eliminates its own"
        )
    if not _curved(derivatives):
        out.append("curvature of the boundary conditions: positions that they depend on are given")
    out.append("interior point: there are no inequalities")
    cyclic = [str(q) for q in model.coordinates if not model.function.has(q) and not any(f.has(q) for f in model.force)]
    if cyclic:
        out.append(f"derivatives of the {model.form} by {', '.join(cyclic)}: cyclic")
    idle = [str(q) for q, f in zip(model.coordinates, model.force, strict=True) if f == 0]
    if idle:
        out.append(f"forces on {', '.join(idle)}: there are none")
    if not any(e.has(model.time) for e in (model.function, *model.force, model.cost or sympy.S.Zero)):
        out.append("time in the kernels: nothing depends on it explicitly")
    entries = (len(_unknown_symbols(program)) * (len(_unknown_symbols(program)) + 1)) // 2
    zeros = entries - len(derivatives.element.hessian)
    if zeros:
        out.append(f"{zeros} of {entries} entries of the interval's Hessian: identically zero")
    return out


def _description(program: ControlProgram, kernels: Sequence[Kernel]) -> list[str]:
    lines = ["Discrete equations on the interval from t_k to t_k1 = t_k + h (suffixes _k and _k1 mark its nodes)", ""]
    lines += [f"    {name} = {sympy.sstr(value)}" for name, value in program.equations]
    lines.append("")
    if program.method == "variational":
        lines += [
            "Minimise the sum of Cd over all intervals such that at every inner node the forced discrete",
            "Euler-Lagrange equations hold,",
            "",
            "    D2 Ld(q_{k-1}, q_k) + D1 Ld(q_k, q_{k+1}) + f+_{k-1} + f-_k = 0,",
            "",
            "and at the ends the discrete momenta match those of the prescribed velocities.",
        ]
    else:
        lines += ["Minimise the sum of Cd over all intervals such that every expression above named 0 vanishes on it."]
    for where, end in (("start", program.start), ("end", program.end)):
        if end.conditions:
            lines += ["", f"At the {where}:", ""]
            lines += [f"    {name} = {sympy.sstr(value)}" for name, value in end.conditions]
    lines += ["", "Operations per interval, before and after common subexpressions are shared:", ""]
    lines += [f"    {k.name}: {k.operations_before} -> {k.operations_after}" for k in kernels]
    return lines


def _metadata(program: ControlProgram, kernels: Sequence[Kernel]) -> list[tuple[str, str]]:
    model = program.model
    return [
        ("task", repr("control")),
        ("method", repr(program.method)),
        ("scheme", repr(program.scheme)),
        ("controls", repr("nodal" if program.nodal_controls else "interval")),
        ("coordinates", repr(tuple(s.name for s in model.coordinates))),
        ("rates", repr(tuple(s.name for s in model.rates))),
        ("control_names", repr(tuple(s.name for s in model.controls))),
        ("node", repr(tuple(u.name for u in program.node))),
        ("interval", repr(tuple(u.name for u in (*program.interval, *program.controls)))),
        ("boundary", repr(tuple(f"{v.where} {v.quantity}" for v in program.boundary_values))),
        ("operations", repr({k.name: (k.operations_before, k.operations_after) for k in kernels})),
    ]


def _pins(end: EndElement) -> dict[int, Expr]:
    """Local index and value of every unknown that is given at an end."""
    return dict(sorted(end.pins, key=lambda pin: pin[0]))


def _pin_lines(end: EndElement) -> tuple[Line, ...]:
    return tuple(Line(str(i), scalar_code(value)) for i, value in _pins(end).items())


def _guesses(program: ControlProgram) -> list[Expr]:
    return [*program.node_guess, *program.stage_guess, *program.control_guess]


def _parameter_inputs(program: ControlProgram, values: Sequence[Expr]) -> tuple[Line, ...]:
    """Lines that read the parameters which some expressions depend on."""
    used = set().union(*(value.free_symbols for value in values)) if values else set()
    parameters = enumerate(_parameters(program))
    return tuple(Line(s.name, f"grid.parameters[{i}]") for i, s in parameters if s in used)


def _node_guess(program: ControlProgram) -> tuple[Line, ...]:
    guesses = list(program.node_guess)
    lines = [Line(str(i), array_code(guess), program.node[i].name) for i, guess in enumerate(guesses)]
    if program.nodal_controls:
        first = len(program.node) - len(program.model.controls)
        controls = zip(program.model.controls, program.control_guess, strict=True)
        lines += [Line(str(first + i), array_code(guess), u.name) for i, (u, guess) in enumerate(controls)]
    return tuple(line for line in lines if line.code != "0")


def _interval_guess(program: ControlProgram) -> tuple[Line, ...]:
    """Guesses at the middle of every interval: of stages, and of controls that live there."""
    guesses = list(enumerate(zip(program.interval_symbols, program.stage_guess, strict=False)))
    if not program.nodal_controls:
        controls = zip(program.control_symbols, program.control_guess, strict=True)
        guesses += enumerate(controls, start=len(program.interval))
    lines = [Line(str(i), array_code(guess), symbol.name) for i, (symbol, guess) in guesses]
    return tuple(line for line in lines if line.code != "0")


def _views(program: ControlProgram) -> dict[str, str]:
    """Code that reads positions, momenta, controls and multipliers out of the views of nodes and intervals."""
    n, m, kept = len(program.model.coordinates), len(program.model.controls), len(program.interval)
    variational = program.method == "variational"
    nodal = program.nodal_controls
    return {
        "positions": f"nodes[:, :{n}]",
        "momenta": "discrete_momenta(grid, unknowns)" if variational else f"nodes[:, {n}:{2 * n}]",
        "controls": f"nodes[:, {2 * n}:]" if nodal else f"intervals[:, {kept}:]",
        "multipliers": f"nodes[:, {n}:{2 * n}]"
        if variational
        else f"intervals[:, {kept - _equations(program)}:{kept}]",
        "control_place": "at nodes" if nodal else "on intervals" if m else "none",
    }


def _equations(program: ControlProgram) -> int:
    return sum(unknown.multiplier for unknown in program.interval)


def _boundary_example(program: ControlProgram) -> str:
    if not program.boundary_values:
        return "of which there are none"
    value = program.boundary_values[0]
    return f'as in {value.where}={{"{value.quantity}": 0.5}}'


def _names(unknowns: Sequence[Unknown]) -> str:
    return ", ".join(u.name for u in unknowns) or "none"


def _list(unknowns: Sequence[Unknown]) -> str:
    return f": {_names(unknowns)}" if unknowns else ""


def _integers(values: Sequence[int]) -> str:
    return f"np.array({list(values)}, dtype=np.int64)" if values else "np.zeros(0, np.int64)"


def _booleans(unknowns: Sequence[Unknown]) -> str:
    return f"np.array({[u.multiplier for u in unknowns]})"
