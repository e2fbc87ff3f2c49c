"""The unknowns of a control problem as strings: sizes, index arrays, durations, initial guesses, and solutions.

Sizes decide which parts of the loops a module has. Guesses are assignments to array views of the unknowns of nodes and
intervals, and of the linking variables, which all intervals share.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import sympy
from sympy import Expr, Max, Min, S, Symbol, oo

from codegen.discretise.model.guesses import DURATION
from codegen.discretise.program import ControlProgram, EndElement, HoldingForces, Unknown
from codegen.emit.differentiation import ControlDerivatives
from codegen.emit.lower.kernels import Line
from codegen.emit.lower.module import BoundText, DurationText, GuessText, PinText, SolutionText
from codegen.emit.lower.printer import array_code, scalar_code
from codegen.runtime.record import Kind
from codegen.symbolic.functions import tables_of

FRACTION = Symbol("fraction", real=True)
"""The elapsed fraction of the duration; guesses that are straight lines between the ends depend on this symbol."""


def sizes(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[tuple[str, int], ...]:
    """Return names and values of the sizes that specialise loops: counts of unknowns and conditions, and flags."""
    own, shared, couplings = program.linking.own, len(program.linking.unknowns), len(program.linking.couplings)
    costs = [*(part.cost for part in program.interval_elements), program.start.cost, program.end.cost]
    # BORDERED: block 0 is eliminated after others, because its equations may determine unknowns of these blocks.
    return (
        ("BODIES", program.model.bodies),
        ("SEVERAL", int(program.model.bodies > 1)),
        ("OWN", own),
        ("SHARED", shared),
        ("COUPLINGS", couplings),
        ("ROOT", program.model.bodies * own + shared - own + couplings),
        ("TIED", len(program.start.shared) + len(program.end.shared)),
        ("SHARED_MULTIPLIERS", sum(u.multiplier for u in program.linking.unknowns)),
        ("PHASES", len(program.phases)),
        ("INNER_TIMES", len(program.inner.times)),
        ("FREE_TIMES", len(program.inner.lacking)),
        ("INEQUALITIES", int(program.has_inequalities)),
        ("UNBOUNDED", int(not program.has_inequalities)),
        ("SLACKED", len(program.slacks)),
        ("COSTLESS", int(not program.sample and not any(costs))),
        ("FORWARD", int(bool(_motion_indices(program)[0]))),
        ("SCALED", int(not derivatives.linear_quadratic)),
        ("BACKWARD", int(_sweeps_backward(program))),
        ("BORDERED", int(bool(not _sweeps_backward(program) or _pinned(program.end) or program.only_at_ends))),
        ("TABLED", sum(table.shape.count for table in tables_of(program.model))),
    )


def parameters(program: ControlProgram) -> tuple[Symbol, ...]:
    """Return the symbols of the vector of parameters: the author's, boundary values, inner times, linking variables."""
    prescribed = (*program.model.parameters, *(value.symbol for value in program.boundary_values))
    return (*prescribed, *program.inner.parameters, *program.linking.symbols)


def constants(program: ControlProgram, derivatives: ControlDerivatives) -> list[Line]:
    """Return lines that define the module's constants: sizes, index arrays, and Hessian patterns."""
    inside = (*program.interval, *program.controls, *program.slacks)
    stride, condensed, stages = len(program.node) + len(inside), derivatives.condensed, derivatives.stages
    eliminated, number = inside[len(inside) - condensed :], dict(sizes(program, derivatives))
    of_stages = Line(
        "STAGES",
        str(stages),
        f"unknowns of stages, eliminated first, as many as equations {_names(inside[stages : 2 * stages])}",
    )
    own = Line("OWN", str(number["OWN"]), f"linking variables of a body: {_names(program.linking.of_bodies)}")
    # Durations are linking variables with a lower bound of at least zero.
    lengths = {phase.duration for phase in program.phases or (program.model,)}
    free = program.model.free_parameters
    positive = {each.symbol for each in free if each.lower is not None and not each.lower.is_negative}
    shared = [unknown.multiplier for unknown in program.linking.unknowns]
    durations = [i for i, symbol in enumerate(program.linking.symbols) if symbol in lengths & positive]
    lines = [
        Line("NODE", str(len(program.node)), f"unknowns of a node: {_names(program.node)}"),
        Line("CONDENSED", str(condensed), f"eliminated inside their interval: {_names(eliminated)}"),
        *([of_stages] if stages else []),
        Line("STRIDE", str(stride), f"unknowns of a node and of the interval after it, which has {_names(inside)}"),
        Line("ELEMENT", str(stride + len(program.node)), "unknowns of an interval with both its nodes"),
        Line("BODIES", str(number["BODIES"]), "bodies, each with a chain of nodes and intervals"),
        *([own] if program.linking.unknowns else []),
        Line(
            "SHARED",
            str(number["SHARED"]),
            f"linking variables of a body and of the problem: {_names(program.linking.unknowns)}",
        ),
        Line("COUPLINGS", str(number["COUPLINGS"]), "conditions between linking variables"),
        Line(
            "ROOT", str(number["ROOT"]), "linking variables of all bodies, and multipliers of conditions between them"
        ),
        Line("BACKWARD", str(number["BACKWARD"]), "1 if elimination goes from the last interval to the first"),
        Line("BORDERED", str(number["BORDERED"]), "1 if the first block is eliminated after others"),
        Line(
            "IS_MULTIPLIER",
            f"np.array({[u.multiplier for u in (*program.node, *inside)]})",
            "for the unknowns of a node and an interval",
        ),
        *([Line("SHARED_IS_MULTIPLIER", f"np.array({shared})", "for the linking variables")] if any(shared) else []),
        *([Line("DURATIONS", integers(durations), "linking variables that are durations")] if durations else []),
        Line("START_PINNED", integers(_pinned(program.start)), "unknowns of the first node that are prescribed"),
        Line("END_PINNED", integers(_pinned(program.end)), "unknowns of the last node that are prescribed"),
        Line("ONLY_AT_ENDS", integers(program.only_at_ends), "unknowns that inner nodes do not have; zero there"),
        Line("HESSIAN_ROWS", integers([r for r, _, _ in derivatives.element.hessian])),
        Line("HESSIAN_COLUMNS", integers([c for _, c, _ in derivatives.element.hessian])),
    ]
    equations, determined = _motion_indices(program)
    if equations and not derivatives.linear_quadratic:
        lines.append(Line("MOTION_EQUATIONS", integers(equations), "multipliers of the equations of a step"))
        lines.append(
            Line("MOTION_UNKNOWNS", integers(determined), "unknowns that they determine: stages and the next state")
        )
    if program.method == "variational":
        n = len(program.model.coordinates)
        lines.append(Line("EQUATIONS", f"np.arange({n}, {2 * n})", "multipliers of the equations of motion in a node"))
    if program.start.shared or program.end.shared:
        for name, end in (("START", program.start), ("END", program.end)):
            tied, to = integers([i for i, _, _ in end.shared]), integers([j for _, j, _ in end.shared])
            up_to = " up to constants" if any(constant != 0 for _, _, constant in end.shared) else ""
            lines.append(Line(f"{name}_TIED", tied, f"unknowns of the node that equal linking variables{up_to}"))
            lines.append(Line(f"{name}_SHARED", to, "the linking variables"))
    curved = has_nonlinear_ends(derivatives)
    ends = (("START", derivatives.start.hessian), ("END", derivatives.end.hessian))
    for name, entries in ends if curved else ():
        lines.append(Line(f"{name}_HESSIAN_ROWS", integers([r for r, _, _ in entries])))
        lines.append(Line(f"{name}_HESSIAN_COLUMNS", integers([c for _, c, _ in entries])))
    for name, entries in ends:
        lines.append(Line(f"{name}_COUNT", str(len(entries) if curved else 0), "entries of its Hessian"))
    if program.linking.unknowns:
        first = len(parameters(program)) - len(program.linking.symbols)
        lines.append(Line("LINKING", str(first), "where linking variables stand behind the parameters"))
    if program.slack_multipliers:
        first = len(program.node) + len(program.interval) + len(program.controls)
        slacks = integers(range(first, first + len(program.slack_multipliers)))
        multipliers = integers([len(program.node) + index for index in program.slack_multipliers])
        lines.append(Line("SLACKS", slacks, "unknowns of an interval that take up an inequality's distance"))
        lines.append(Line("SLACK_MULTIPLIERS", multipliers, "of the equations that define them"))
    return lines


def structure(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[tuple[str, str], ...]:
    """Return the fields of the record `Structure` with their code: constants of the module, then flags that are set."""
    number = dict(sizes(program, derivatives))
    flags = {
        "backward": bool(number["BACKWARD"]),
        "bordered": bool(number["BORDERED"]),
        "constant": bool(derivatives.condensed) and not program.has_inequalities and not program.phases,
        "inequalities": program.has_inequalities,
        "linear_quadratic": derivatives.linear_quadratic,
        "costless": bool(number["COSTLESS"]),
        "forward": bool(number["FORWARD"]) and not derivatives.linear_quadratic,
    }
    others = {
        "PHASES": bool(program.phases), "PHASE_LACKS": bool(program.phases), "SWITCH_LACKS": bool(program.phases),
        **dict.fromkeys(("INNER_TIMES", "INNER_FIRST", "INNER_UNKNOWNS", "INNER_PRESENT"), bool(program.inner.times)),
        "INNER_LACKS": bool(program.inner.lacking),
        **dict.fromkeys(("SAMPLE", "FIRST_SAMPLE"), bool(program.sample)),
    }  # fmt: skip
    named = [line.target for line in constants(program, derivatives) if line.target not in _NO_FIELDS]
    named += [name for name, is_present in others.items() if is_present]
    fields = [(_FIELDS.get(name, name.lower()), name) for name in named]
    return (*fields, *((name, "True") for name, flag in flags.items() if flag))


_NO_FIELDS = ("ELEMENT", "ROOT", "BACKWARD", "BORDERED", "START_COUNT", "END_COUNT", "LINKING")
_FIELDS = {"HESSIAN_ROWS": "rows", "HESSIAN_COLUMNS": "columns"} | {
    f"{end}_HESSIAN_{side}": f"{end}_{side}".lower() for end in ("START", "END") for side in ("ROWS", "COLUMNS")
}
"""Fields of the record whose names are not the names of the module's constants in lower case."""


def inner_time_constants(program: ControlProgram) -> list[Line]:
    """Return constants: the number of inner times, and indices of the parameters and unknowns that belong to them."""
    inner, first = program.inner, len(program.model.parameters) + len(program.boundary_values)
    if not inner.times:
        return []
    lines = [
        Line("INNER_TIMES", str(len(inner.times)), "times between start and end at which conditions hold"),
        Line("INNER_FIRST", str(first), "where they stand among the parameters"),
        Line("INNER_UNKNOWNS", integers(inner.unknowns), "unknowns of nodes at such times; zero at others"),
        Line("INNER_PRESENT", f"np.array({[list(row) for row in inner.present]})", "which of them, time by time"),
    ]
    if inner.lacking:
        lacks = [len(program.node) + index for index in inner.lacking]
        lines.append(Line("INNER_LACKS", integers(lacks), "unknowns that intervals after them lack"))
    return lines


def phase_constants(program: ControlProgram) -> list[Line]:
    """Return constants: the number of phases, and masks of the interval unknowns that each phase lacks."""
    if not program.phases:
        return []
    inside = range(len(program.interval) + len(program.controls) + len(program.slacks))
    lacks = [
        f"np.array({[[i in element.lacking for i in inside] for element in elements]})"
        for elements in ([p.regular for p in program.phases], [p.elements[0] for p in program.phases[1:]])
    ]
    return [
        Line("PHASES", str(len(program.phases)), "phases, each of equally many intervals"),
        Line("PHASE_LACKS", lacks[0], "unknowns of an interval, by phase"),
        Line("SWITCH_LACKS", lacks[1], "the same of the first interval after each switch"),
    ]


def has_nonlinear_ends(derivatives: ControlDerivatives) -> bool:
    """Return True if the share of an end (its contribution to the Lagrangian) has entries in the KKT matrix."""
    return bool(derivatives.start.hessian or derivatives.end.hessian)


def _motion_indices(program: ControlProgram) -> tuple[list[int], list[int]]:
    """Return local indices of the multipliers of a step's equations, and of the unknowns that these determine.

    These unknowns are the stages and the state after the step. Both lists are empty if controls do not determine the
    motion, because the start leaves states free or the end prescribes values.
    """
    ends = program.start, program.end
    is_plain = (
        program.method != "variational" and program.model.bodies == 1 and not program.phases and not program.sample
    )
    if not is_plain or program.inner.times or any(end.shared for end in ends):
        return [], []
    node, inside = len(program.node), program.interval[: len(program.interval) - program.path_multipliers]
    others = {
        *program.only_at_ends,
        *(range(node - len(program.model.controls), node) if program.nodal_controls else ()),
    }
    states = [i for i in range(node) if i not in others]
    prescribed = {i for i, _ in program.start.pins}
    if any(program.node[i].multiplier or i not in prescribed for i in states):
        return [], []
    if program.end.pins or program.end.conditions or program.end.slacks or program.end.bounds:
        return [], []
    if program.path_multipliers > len(program.slack_multipliers):  # path equalities, which controls must satisfy
        return [], []
    equations = [node + i for i, unknown in enumerate(inside) if unknown.multiplier]
    stride = node + len(program.interval) + len(program.controls) + len(program.slacks)
    unknowns = [node + i for i, u in enumerate(inside) if not u.multiplier] + [stride + i for i in states]
    return (equations, unknowns) if len(equations) == len(unknowns) else ([], [])


def _sweeps_backward(program: ControlProgram) -> bool:
    """Return True if elimination goes from the last interval to the first.

    Each equation on an interval is eliminated with the state at the interval's end, which it determines. The other
    direction would integrate backward in time, where rounding errors of dissipative dynamics grow without bound.
    Equations at nodes, which controls before the last interval may decide, need the forward direction. Each of them is
    eliminated with the interval after its node, since the interval before the node may leave no choice.
    """
    inner = (u for i, u in enumerate(program.node) if i not in program.only_at_ends)
    return program.method != "variational" and not any(u.multiplier for u in inner)


def _pinned(end: EndElement) -> list[int]:
    """Return local indices of unknowns that are prescribed at an end, or that equal a linking variable."""
    return sorted([*(i for i, _ in end.pins), *(i for i, _, _ in end.shared)])


def _names(unknowns: Sequence[Unknown]) -> str:
    return ", ".join(u.name for u in unknowns) or "none"


def integers(values: Sequence[int]) -> str:
    """Return code of an index array."""
    return f"np.array({list(values)}, dtype=np.int64)" if values else "np.zeros(0, np.int64)"


def inputs(program: ControlProgram, values: Sequence[Expr], column: bool = True) -> tuple[Line, ...]:
    """Return lines that read the symbols of expressions, as arrays with an entry per body, by default column vectors.

    With a single body, the lines read numbers, which are several times faster than arrays of one number.
    """
    used = set[Symbol]().union(*(value.free_symbols for value in values))
    suffix = ", None" if column else ""
    count = len(parameters(program)) - len(program.linking.symbols)
    index = "[0, {}]" if program.model.bodies == 1 else f"[:, {{}}{suffix}]"
    symbols = enumerate(parameters(program)[:count])
    lines = [Line(s.name, f"grid.parameters{index.format(i)}") for i, s in symbols if s in used]
    if program.model.body in used:
        lines.append(Line(str(program.model.body), f"np.arange(BODIES)[:{suffix}]" if column else "np.arange(BODIES)"))
    return tuple(lines)


def shared_views(program: ControlProgram, target: str, vector: str) -> tuple[Line, ...]:
    """Return the line that assigns array views of the linking variables in `vector` to `target`, if there are any."""
    return (Line(target, f"shared_views(grid, {vector})"),) if program.linking.unknowns else ()


def phase_steps(program: ControlProgram) -> tuple[Line, ...]:
    """Return the line that assigns the number of steps of a phase; no line without phases."""
    return (Line("steps", "grid.steps // PHASES"),) if program.phases else ()


def phase_slice(program: ControlProgram, i: int, at_nodes: bool = False) -> str:
    """Return code of the slice of intervals, or nodes, of phase i; a switch's node belongs to the phase before."""
    offset = " + 1" if at_nodes else ""
    begin = f"{_steps(i)}{offset} " if i else ""
    return f"{begin}:" + (f" {_steps(i + 1)}{offset}" if i + 1 < len(program.phases) else "")


def phase_start(i: int) -> str:
    """Return code of a slice with the one node, or interval, at which phase i begins."""
    return f"{_steps(i)} : {_steps(i)} + 1"


def _steps(number: int) -> str:
    return "steps" if number == 1 else f"{number} * steps"


def duration(program: ControlProgram) -> DurationText:
    """Return code of the duration, or of the durations of several phases, and of the times at nodes."""
    if program.phases:
        durations = [phase.duration for phase in program.phases]
        return DurationText(
            arguments=(),
            defaults=(),
            grid="1.0",
            inputs=(),
            code="phase_durations(grid, unknowns).sum()",
            of_phases=((duration_inputs(program, durations), tuple(map(scalar_code, durations))),),
            node_times="node_times(grid, unknowns)",
            each_phase=" of each phase",
            fractions="fractions (N,) of every phase, or (PHASES, N) of each,",
        )
    is_free, code, clock = program.scaled_time, scalar_code(program.model.duration), program.inner.clock
    times = "duration_of(grid, unknowns) * grid.nodes / grid.steps" if is_free else "grid.h * grid.nodes"
    return DurationText(
        arguments=() if is_free else ("duration",),
        defaults=() if is_free else (code,),
        grid="1.0" if is_free else "duration",
        inputs=duration_inputs(program, [program.model.duration]) if is_free else (),
        code=code if is_free else "grid.steps * grid.h",
        of_phases=(),
        node_times=times if clock is None else f"nodes[0, :, {clock}].copy()",
        each_phase="",
        fractions="fractions (N,) of the duration",
    )


def duration_inputs(program: ControlProgram, durations: Sequence[Expr]) -> tuple[Line, ...]:
    """Return lines that read the symbols of durations from the parameters and the unknowns."""
    first = len(program.linking.common) + len(program.linking.couplings)
    codes = {s: f"unknowns[{j - first}]" for j, s in enumerate(program.linking.common_symbols)}
    codes |= {s: f"grid.parameters[0, {i}]" for i, s in enumerate(program.model.parameters)}
    used = set[Symbol]().union(*(duration.free_symbols for duration in durations))
    return tuple(Line(s.name, code) for s, code in codes.items() if s in used)


def solution(program: ControlProgram) -> SolutionText:
    """Return code that reads positions, momenta, controls and multipliers from array views of nodes and intervals."""
    n, inside, node = len(program.model.coordinates), len(program.interval), len(program.node)
    m, controls = len(program.model.controls), f"intervals[:, :, {inside}:{inside + len(program.controls)}]"
    if program.controlled == "stages":
        controls += f".reshape(BODIES, -1, {m})"
    elif program.nodal_controls:
        controls = f"nodes[:, :, {node - m}:]"
    if program.method == "variational":
        momenta, multipliers = "discrete_momenta(grid, unknowns)", f"nodes[:, :, {n}:{2 * n}]"
    else:
        momenta = f"nodes[:, :, {n}:{2 * n if program.model.rates else n}]"
        first = next((i for i, u in enumerate(program.interval) if u.multiplier), inside)
        equations = sum(u.kind is Kind.STEP for u in program.interval)
        multipliers = f"intervals[:, :, {first}:{first + equations}]"
    return SolutionText(f"nodes[:, :, :{n}]", momenta, controls, multipliers)


def guesses(program: ControlProgram) -> GuessText:
    """Return code of the initial guess, evaluated at arrays of times."""
    lines, read = _phase_guesses(program) if program.phases else _guesses(program)
    common = program.linking.guess[program.linking.own :]
    used = set[Symbol]().union(*(value.free_symbols for value in common))
    common_inputs = [
        Line(s.name, f"grid.parameters[0, {i}]") for i, s in enumerate(program.model.parameters) if s in used
    ]
    own: dict[int, Line] = {}  # guess of a body's linking variable, which equals an unknown of an end node
    for node, end in (("0", program.start), ("-1", program.end)):
        for index, j, _ in end.shared:
            if j < program.linking.own:
                own.setdefault(j, Line(f"own[:, {j}]", f"nodes[:, {node}, {index}]", program.linking.unknowns[j].name))
    return GuessText(
        inputs=inputs(program, read),
        lines=tuple(lines),
        shared_inputs=(*common_inputs, *shared_views(program, "own, common", "unknowns")),
        common=tuple(
            Line(f"common[{j}]", scalar_code(sympy.sympify(value)), unknown.name)
            for j, (unknown, value) in enumerate(zip(program.linking.common, common, strict=True))
        ),
        own=tuple(own.values()),
        result="with_slacks(grid, unknowns)" if program.slack_multipliers else "unknowns",
    )


def _phase_guesses(program: ControlProgram) -> tuple[list[Line], list[Expr]]:
    """Return lines that guess the unknowns of nodes and intervals of each phase, and the expressions in them."""
    lines, read, node_times = [*phase_steps(program)], list[Expr](), "node_times(grid, unknowns)"
    for i, phase in enumerate(program.phases):
        nodes, intervals = phase_slice(program, i, at_nodes=True), phase_slice(program, i)
        of_stages: dict[Expr, list[tuple[int, Expr]]] = {}
        for index, value, c in phase.inside_guess:
            of_stages.setdefault(c, []).append((index, value))
        of_intervals = []
        for c, group in of_stages.items():
            fraction = "" if c == S.Half else f", {float(c)!r}"
            of_intervals.append(
                ("intervals", f"interval_times(grid, unknowns{fraction})", intervals, phase.inside, tuple(group))
            )
        for view, times, part, unknowns, guess in (
            ("nodes", node_times, nodes, program.node, tuple(enumerate(phase.node_guess))),
            *of_intervals,
            ("intervals", node_times, phase_start(i), phase.inside, phase.switch_guess),
        ):
            nonzero = [(j, value) for j, value in guess if value != 0]
            if any(value.has(program.model.time) for _, value in nonzero):
                lines.append(Line("t", f"{times}[{part}]"))
            lines += [Line(f"{view}[:, {part}, {j}]", array_code(v), unknowns[j].name) for j, v in nonzero]
            read += [value for _, value in nonzero]
        for holding in phase.holding:
            if any(value.has(program.model.time) for value in holding.expressions):
                lines.append(Line("t", f"{node_times}[{nodes}]"))
            lines.append(_holding_line(f"nodes[:, {nodes}, {[*holding.unknowns]}]", holding, lambda value: value))
            read += holding.expressions
    return lines, read


def _holding_line(target: str, holding: HoldingForces, prepared: Callable[[Expr], Expr]) -> Line:
    """Return the line that guesses constraint forces; `prepared` changes expressions before they are printed."""
    forces = ", ".join(array_code(prepared(force)) for force in holding.forces)
    rows = ", ".join(f"[{', '.join(array_code(prepared(entry)) for entry in row)}]" for row in holding.gradients)
    return Line(target, f"holding_forces([{forces}], [{rows}])", "forces that hold the guess at rest")


def _guesses(program: ControlProgram) -> tuple[list[Line], list[Expr]]:
    """Return lines that guess the unknowns of nodes and intervals without phases, and the expressions in them."""
    guess = program.guess
    at_nodes = [(i, program.node[i].name, value) for i, value in enumerate(guess.node)]
    inside = dict[Expr, list[tuple[int, str, Expr]]]()  # guesses by the fraction of the interval
    for i, (symbol, value, c) in enumerate(
        zip(program.interval_symbols, guess.stages, guess.stage_times, strict=False)
    ):
        inside.setdefault(c, []).append((i, symbol.name, value))
    first = len(program.node) - len(program.model.controls) if program.nodal_controls else len(program.interval)
    symbols = program.model.controls if program.nodal_controls else program.control_symbols
    for i, (symbol, value, c) in enumerate(zip(symbols, guess.controls, guess.control_times, strict=True), start=first):
        of_place = at_nodes if program.nodal_controls else inside.setdefault(c, [])
        of_place.append((i, symbol.name, value))

    def relative(value: Expr) -> Expr:
        """Return a guess in the fraction of the duration, unless the duration occurs otherwise."""
        changed = value.xreplace({program.model.time: FRACTION * DURATION})
        return value if changed.has(DURATION) else changed

    def guessed(view: str, values: Sequence[tuple[int, str, Expr]]) -> list[Line]:
        lines = [Line(f"{view}[:, :, {i}]", array_code(relative(value)), name) for i, name, value in values]
        return [line for line in lines if line.code != "0"]

    node_lines = guessed("nodes", at_nodes)
    interval_lines = {c: guessed("intervals", values) for c, values in inside.items()}
    for holding in guess.holding:
        node_lines.append(_holding_line(f"nodes[:, :, {[*holding.unknowns]}]", holding, relative))
    # Guesses interpolate the samples at nodes, and both nodes at stages inside intervals.
    prescribed = [{index for index, *_ in (*end.pins, *end.shared)} for end in (program.start, program.end)]
    straight = []
    for sample in program.sample.guess if program.sample else ():
        index, name, target = sample.index, program.node[sample.index].name, f"nodes[:, :, {sample.index}]"
        arguments = [target, sample.column, index in prescribed[0], index in prescribed[1]]
        if (sample.offset, sample.slope) != (0, 1):
            arguments += map(array_code, (sample.offset, sample.slope))
        call = f"through_samples(grid, {', '.join(map(str, arguments))})"
        node_lines.append(Line(target, call, f"{name}, as measured"))
        left, right = f"nodes[:, :-1, {index}]", f"nodes[:, 1:, {index}]"
        for j, (stage, c) in enumerate(zip(program.interval, guess.stage_times, strict=False)):
            if stage.name.rpartition("_")[0] == name:
                straight.append(Line(f"intervals[:, :, {j}]", _between(left, right, c), stage.name))
    read = [*guess.node, *guess.stages, *guess.controls]
    read += [value for holding in guess.holding for value in holding.expressions]
    read += [
        value for sample in (program.sample.guess if program.sample else ()) for value in (sample.offset, sample.slope)
    ]
    for index, values, at_start, at_end in program.inner.guess:
        numbers, codes = [number for number, _ in values], ", ".join(array_code(value) for _, value in values)
        target = f"nodes[:, :, {index}]"
        call = f"through_inner_times(grid, {target}, {numbers}, [{codes}], {at_start}, {at_end})"
        node_lines.append(Line(target, call))
        read += [value for _, value in values]
    targets = {line.target for line in straight}
    lines = []
    places = {c: f"({_between('grid.nodes[:-1]', 'grid.nodes[1:]', c)})" for c in interval_lines}
    for nodes, group in (
        ("grid.nodes", node_lines),
        *((places[c], [line for line in group if line.target not in targets]) for c, group in interval_lines.items()),
    ):
        if _is_read(FRACTION.name, group):
            lines.append(Line(FRACTION.name, f"{nodes} / grid.steps"))
        if _is_read("t", group):
            lines.append(Line("t", f"duration * {nodes} / grid.steps"))
        lines += group
    lines += straight
    if _is_read("duration", lines):
        lines.insert(0, Line("duration", "duration_of(grid, unknowns)"))
    return lines, read


def _between(left: str, right: str, c: Expr) -> str:
    """Return code for the value at the fraction c between `left` and `right`."""
    return f"0.5 * ({left} + {right})" if c == S.Half else f"{float(1 - c)!r} * {left} + {float(c)!r} * {right}"


def _is_read(name: str, lines: Sequence[Line]) -> bool:
    """Return True if one of the lines reads the value of a name."""
    return any(re.search(rf"\b{name}\b", line.code) for line in lines)


def pins(program: ControlProgram) -> PinText:
    """Return code that assigns the prescribed values at both ends to the unknowns."""
    ends = (("0", program.start), ("-1", program.end))
    values = [v for _, end in ends for _, v in end.pins] + [v for _, end in ends for _, _, v in end.shared]
    lines = []
    for node, end in ends:
        for index, value in sorted(end.pins, key=lambda pin: pin[0]):
            lines.append(Line(f"nodes[:, {node}, {index}]", array_code(value)))
        for index, j, offset in end.shared:
            shared = f"own[:, {j}]" if j < program.linking.own else f"common[{j - program.linking.own}]"
            code = shared if offset == 0 else f"{shared} + {array_code(offset)}"
            lines.append(Line(f"nodes[:, {node}, {index}]", code))
    for number, index in enumerate(program.inner.unknowns):
        lines.append(Line(f"nodes[:, without_inner_unknown(grid, {number}), {index}]", "0.0"))
    needs_shared = bool(program.start.shared or program.end.shared)
    views = shared_views(program, "own, common", "unknowns") if needs_shared else ()
    return PinText((*inputs(program, values, column=False), *views), tuple(lines))


@dataclass(frozen=True)
class Bound:
    """A bound of an unknown, assigned to `target`; `is_common` is True if all bodies have the same number."""

    target: str
    value: Expr
    name: str
    is_common: bool = False

    @property
    def line(self) -> Line:
        """The line that assigns the bound."""
        code = common_code(self.value) if self.is_common else array_code(self.value)
        return Line(self.target, {oo: "np.inf", -oo: "-np.inf"}.get(self.value) or code, self.name)


def common_code(value: Expr) -> str:
    """Return code of a value that is equal for all bodies, as one number: parameters have a row for each body."""
    return f"np.max({array_code(value)})" if value.free_symbols else array_code(value)


def bounds(program: ControlProgram) -> BoundText:
    """Return code that assigns all bounds; it is empty for a problem without inequalities."""
    if not program.has_inequalities:
        return BoundText()
    values = bound_values(program)
    return BoundText(
        inputs=inputs(program, [bound.value for bound in values]),
        views=(*phase_steps(program), *bound_views(program)),
        lines=((*(bound.line for bound in values), *slack_bounds(program)),),
    )


def bound_views(program: ControlProgram) -> tuple[Line, ...]:
    """Return lines that make array views of the bounds of linking variables."""
    return (
        *shared_views(program, "lower_own, lower_common", "lower"),
        *shared_views(program, "upper_own, upper_common", "upper"),
    )


def bound_values(program: ControlProgram) -> list[Bound]:
    """Return the bounds of all unknowns except slacks."""
    values = list[Bound]()

    def add(target: str, unknown: Unknown, is_common: bool = False) -> None:
        values.extend(Bound(f"{side}_{target}", v, unknown.name, is_common) for side, v in _limits(unknown))

    inside = len(program.interval) + len(program.controls)
    for i, phase in enumerate(program.phases):
        for j, unknown in enumerate(phase.node):
            add(f"nodes[:, {phase_slice(program, i, at_nodes=True)}, {j}]", unknown)
        for j, unknown in enumerate(phase.inside[:inside]):
            add(f"intervals[:, {phase_slice(program, i)}, {j}]", unknown)
        if i:
            # At a switch, continuous quantities obey the bounds of both phases; prescribed quantities have no bounds.
            before, after = program.phases[i - 1], program.phases[i]
            for j, (earlier, later) in enumerate(zip(before.node, after.node, strict=True)):
                limits_before, limits = dict(_limits(earlier)), dict(_limits(later)) if j not in after.jumping else {}
                if j in after.given:
                    limits = {side: -oo if side == "lower" else oo for side in limits_before}
                elif limits_before:
                    limits = {
                        side: (Max if side == "lower" else Min)(limits_before.get(side, value), value)
                        for side, value in limits.items()
                    }
                name = f"{later.name} at the switch"
                values += [Bound(f"{side}_nodes[:, {phase_start(i)}, {j}]", v, name) for side, v in limits.items()]
    if not program.phases:
        for group, unknowns in (
            ("nodes[:, :", program.node),
            ("intervals[:, :", (*program.interval, *program.controls)),
            ("own[:", program.linking.of_bodies),
        ):
            for j, unknown in enumerate(unknowns):
                add(f"{group}, {j}]", unknown)
    for j, unknown in enumerate(program.linking.common):
        add(f"common[{j}]", unknown, is_common=program.model.bodies > 1)
    for number, *window in () if program.phases else program.inner.windows:
        for side, value in zip(("lower", "upper"), window, strict=True):
            if value is not None:
                target = f"{side}_nodes[:, grid.inner[{number}], {program.inner.clock}]"
                values.append(Bound(target, value, f"the window of waypoint {number + 1}", True))
    for node, end in ((":1", program.start), ("-1:", program.end)):
        for j, bound in end.bounds:
            for side, value in (("lower", bound.lower), ("upper", bound.upper)):
                if value is not None:
                    values.append(Bound(f"{side}_nodes[:, {node}, {j}]", value, bound.condition))
    return values


def _limits(unknown: Unknown) -> Iterator[tuple[str, Expr]]:
    """Yield side ("lower" or "upper") and value of each bound of an unknown."""
    for side, value in (("lower", unknown.lower), ("upper", unknown.upper)):
        if value is not None:
            yield side, value


def slack_bounds(program: ControlProgram) -> list[Line]:
    """Return the bounds of slacks, then lines that remove bounds where other values determine an unknown.

    The bound of a determined slack becomes -1, so that the slack stays above it and its barrier term stays finite.
    """
    first = len(program.interval) + len(program.controls)
    lines = []
    for j, slack in enumerate(program.slacks):
        assert slack.lower is not None, "a slack has a least value"
        lines.append(Line(f"lower_intervals[:, :, {first + j}]", array_code(slack.lower), slack.name))
    slack_names, node_names = [slack.name for slack in program.slacks], [unknown.name for unknown in program.node]

    def remove_bounds(node_slacks: Sequence[tuple[int, int]], node: str, interval: str, name: str) -> None:
        comment = f"{name} is determined there"
        if name in slack_names:
            index = first + slack_names.index(name)
            lines.append(Line(f"lower_intervals[:, {interval}, {index}]", "-1.0", comment))
            return
        index = node_names.index(name)
        if index in [slack for slack, _ in node_slacks]:
            lines.append(Line(f"lower_nodes[:, {node}, {index}]", "-1.0", comment))
            return
        lines.append(Line(f"lower_nodes[:, {node}, {index}]", "-np.inf", comment))
        lines.append(Line(f"upper_nodes[:, {node}, {index}]", "np.inf", comment))

    for node, end in (("0", program.start), ("-1", program.end)):
        lines += [Line(f"lower_nodes[:, {node}, {i}]", "0.0", program.node[i].name) for i, _ in end.slacks]
        for name, _ in end.determined:
            remove_bounds(end.slacks, node, node, name)
    for number, name, before in program.inner.determined:
        node = f"grid.inner[{number}]"
        remove_bounds((), node, f"{node} - 1" if before else node, name)
    return lines
