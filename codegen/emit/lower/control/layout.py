"""The layout of a control problem's unknowns as strings: sizes, tables, pinned values, bounds, views.

Sizes of a control problem, which decide what its module holds: numbers of unknowns, and which features it uses.

What conditions at inner times need as strings: code that reads a node's numbers, tables, and the grid.

Where the solver of a control problem starts, as strings: guesses of nodes, intervals and shared unknowns.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import sympy
from sympy import Expr, Symbol, oo

from codegen.discretise.guesses import DURATION
from codegen.discretise.program import ControlProgram, EndElement, Unknown
from codegen.emit.differentiation import ControlDerivatives
from codegen.emit.lower.kernels import Line
from codegen.emit.lower.printer import array_code, scalar_code
from codegen.runtime.record import Kind
from codegen.symbolic.functions import tables_of


def sizes(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[tuple[str, int], ...]:
    """The number of bodies, whether it is more than one, the shared unknowns of each and in all, and their conditions.

    Then whether there are phases, inequalities, slacks on intervals, no cost, a start from which a motion follows, and
    a right-hand side that takes part in the elimination, and how many numbers tables have.
    """
    own, shared, couplings = program.own, len(program.shared), len(program.couplings)
    return (
        ("BODIES", program.bodies),
        ("SEVERAL", int(program.bodies > 1)),
        ("OWN", own),
        ("SHARED", shared),
        ("COUPLINGS", couplings),
        ("ROOT", program.bodies * own + shared - own + couplings),
        ("TIED", len(program.start.shared) + len(program.end.shared)),
        ("SHARED_MULTIPLIERS", sum(u.multiplier for u in program.shared)),
        ("PHASES", len(program.phases)),
        ("INNER_TIMES", len(program.inner.times)),
        ("FREE_TIMES", len(program.inner.lacking)),
        ("INEQUALITIES", int(program.has_inequalities)),
        ("UNBOUNDED", int(not program.has_inequalities)),
        ("SLACKED", len(program.slacks)),
        ("COSTLESS", int(is_costless(program))),
        ("FORWARD", int(bool(motion_indices(program)[0]))),
        ("SCALED", int(not derivatives.linear_quadratic)),
        ("BACKWARD", int(sweeps_backward(program))),
        ("BORDERED", int(borders_front(program))),
        ("CARRIED", int(carries_right_hand_side(program, derivatives))),
        ("TABLED", sum(table.shape.count for table in tables_of(program.model))),
    )


def is_costless(program: ControlProgram) -> bool:
    """Whether any motion that obeys the conditions will do."""
    costs = [*(part.cost for part in program.interval_elements), program.start.cost, program.end.cost]
    return not program.sample and not any(costs)


def motion_indices(program: ControlProgram) -> tuple[list[int], list[int]]:
    """Local indices of the equations of a step, and of what they determine: stages, and the state after it.

    Both are empty where the start does not give all states, or the end anything, so that no motion follows from a guess
    of controls.
    """
    ends = program.start, program.end
    is_plain = program.method != "variational" and program.bodies == 1 and not program.phases and not program.sample
    if not is_plain or program.inner.times or any(end.shared for end in ends):
        return [], []
    node, inside = len(program.node), program.interval[: len(program.interval) - program.path_multipliers]
    others = {
        *program.only_at_ends,
        *(range(node - len(program.model.controls), node) if program.nodal_controls else ()),
    }
    states = [i for i in range(node) if i not in others]
    given = {i for i, _ in program.start.pins}
    if any(program.node[i].multiplier or i not in given for i in states):
        return [], []
    if program.end.pins or program.end.conditions or program.end.slacks or program.end.bounds:
        return [], []
    if program.path_multipliers > len(program.slack_multipliers):  # equalities, which controls have to obey
        return [], []
    equations = [node + i for i, unknown in enumerate(inside) if unknown.multiplier]
    stride = node + len(program.interval) + len(program.controls) + len(program.slacks)
    unknowns = [node + i for i, u in enumerate(inside) if not u.multiplier] + [stride + i for i in states]
    return (equations, unknowns) if len(equations) == len(unknowns) else ([], [])


def carries_right_hand_side(program: ControlProgram, derivatives: ControlDerivatives) -> bool:
    """Whether the rows of an element matrix, which are as long as a multiple of four, have room for one more column."""
    node, inside = len(program.node), len(program.interval) + len(program.controls) + len(program.slacks)
    block = node + inside - derivatives.condensed - 2 * derivatives.stages
    first = block - len(pinned(first_end(program))) if borders_front(program) else 0
    border = node + first + len(program.shared)  # the next node, block 0, shared unknowns
    return (block + border) % 4 > 0 and border % 4 > 0


def sweeps_backward(program: ControlProgram) -> bool:
    """Whether elimination goes from the last interval to the first.

    Where equations are those of intervals, each then goes with the state at its end, which it determines: the other
    way the elimination would integrate backward in time, and dissipative dynamics would make rounding grow without end.
    Equations of states at nodes, which controls before the last interval may decide, want the other way all the same:
    they are eliminated with the interval after their node, not with the one before it, which may leave them no choice.
    """
    own = (u for i, u in enumerate(program.node) if i not in program.only_at_ends)
    return program.method != "variational" and not any(u.multiplier for u in own)


def first_end(program: ControlProgram) -> EndElement:
    """The end where elimination begins."""
    return program.end if sweeps_backward(program) else program.start


def borders_front(program: ControlProgram) -> bool:
    """Whether block 0 stays to the end of the elimination, because its equations may determine other unknowns.

    Where nothing is given at the end where elimination begins, they determine its state, as in all other blocks.
    """
    return bool(not sweeps_backward(program) or pinned(first_end(program)) or program.only_at_ends)


def pinned(end: EndElement) -> list[int]:
    """Local index of every unknown that is given at an end, or equals a shared one."""
    return sorted([*(i for i, _ in end.pins), *(i for i, _, _ in end.shared)])


def parameters(program: ControlProgram) -> tuple[Symbol, ...]:
    """What stands in the vector of parameters: the author's, boundary values, inner times, shared unknowns."""
    given = (*program.model.parameters, *(value.symbol for value in program.boundary_values))
    return (*given, *program.inner.parameters, *program.shared_symbols)


def constants(program: ControlProgram, derivatives: ControlDerivatives) -> list[Line]:
    """Sizes, index arrays and patterns."""
    inside = (*program.interval, *program.controls, *program.slacks)
    stride, condensed = len(program.node) + len(inside), derivatives.condensed
    eliminated, stages = inside[len(inside) - condensed :], derivatives.stages
    of_stages = Line("STAGES", str(stages), f"eliminated first, with {_names(inside[stages : 2 * stages])}")
    shared = [unknown.multiplier for unknown in program.shared]
    lines = [
        Line("NODE", str(len(program.node)), f"unknowns of a node: {_names(program.node)}"),
        Line("CONDENSED", str(condensed), f"eliminated inside their interval: {_names(eliminated)}"),
        *([of_stages] if stages else []),
        Line("STRIDE", str(stride), f"unknowns of a node and of the interval after it, which has {_names(inside)}"),
        Line("ELEMENT", str(stride + len(program.node)), "unknowns of an interval with both its nodes"),
        *_size_lines(program, derivatives),
        Line("IS_MULTIPLIER", f"np.array({[u.multiplier for u in (*program.node, *inside)]})", "of node and interval"),
        *([Line("SHARED_IS_MULTIPLIER", f"np.array({shared})", "of shared unknowns")] if any(shared) else []),
        Line("START_PINNED", integers(pinned(program.start)), "unknowns of the first node that are given"),
        Line("END_PINNED", integers(pinned(program.end)), "unknowns of the last node that are given"),
        Line("ONLY_AT_ENDS", integers(program.only_at_ends), "unknowns that inner nodes do not have; zero there"),
        Line("HESSIAN_ROWS", integers([r for r, _, _ in derivatives.element.hessian])),
        Line("HESSIAN_COLUMNS", integers([c for _, c, _ in derivatives.element.hessian])),
    ]
    equations, determined = motion_indices(program)
    if equations and not derivatives.linear_quadratic:
        lines.append(Line("MOTION_EQUATIONS", integers(equations), "multipliers of the equations of a step"))
        lines.append(Line("MOTION_UNKNOWNS", integers(determined), "what these determine: stages, the state after it"))
    if program.method == "variational":
        n = len(program.model.coordinates)
        lines.append(Line("EQUATIONS", f"np.arange({n}, {2 * n})", "multipliers of the equations of motion in a node"))
    for name, end in (("START", program.start), ("END", program.end)):
        if program.start.shared or program.end.shared:
            lines.append(
                Line(f"{name}_TIED", integers([i for i, _, _ in end.shared]), "unknowns of the node that equal")
            )
            lines.append(Line(f"{name}_SHARED", integers([j for _, j, _ in end.shared]), "these shared unknowns"))
    if has_nonlinear_ends(derivatives):
        for name, entries in (("START", derivatives.start.hessian), ("END", derivatives.end.hessian)):
            lines.append(Line(f"{name}_HESSIAN_ROWS", integers([r for r, _, _ in entries])))
            lines.append(Line(f"{name}_HESSIAN_COLUMNS", integers([c for _, c, _ in entries])))
    curved = has_nonlinear_ends(derivatives)
    lines.append(Line("START_COUNT", str(len(derivatives.start.hessian) if curved else 0), "entries of its Hessian"))
    lines.append(Line("END_COUNT", str(len(derivatives.end.hessian) if curved else 0), "entries of its Hessian"))
    if program.shared:
        first = len(parameters(program)) - len(program.shared_symbols)
        lines.append(Line("LINKING", str(first), "where linking variables stand behind the parameters"))
    if slack_indices(program):
        slacks, multipliers = zip(*slack_indices(program), strict=True)
        lines.append(Line("SLACKS", integers(slacks), "unknowns of an interval that take up an inequality's distance"))
        lines.append(Line("SLACK_MULTIPLIERS", integers(multipliers), "of the equations that define them"))
    return lines


def structure(program: ControlProgram, derivatives: ControlDerivatives) -> tuple[tuple[str, str], ...]:
    """Fields of the record `Structure` with their code: constants of the module where there are any."""
    number = dict(sizes(program, derivatives))
    differ = program.has_inequalities or bool(program.phases)
    flags = {
        "backward": bool(number["BACKWARD"]),
        "bordered": bool(number["BORDERED"]),
        "carried": bool(number["CARRIED"]),
        "constant": bool(derivatives.condensed) and not differ,
        "inequalities": program.has_inequalities,
        "linear_quadratic": derivatives.linear_quadratic,
        "costless": bool(number["COSTLESS"]),
        "forward": bool(number["FORWARD"]) and not derivatives.linear_quadratic,
    }
    named = [line.target for line in constants(program, derivatives) if line.target not in ("ELEMENT", "ROOT")]
    others = {
        "PHASES": bool(program.phases), "PHASE_LACKS": bool(program.phases), "SWITCH_LACKS": bool(program.phases),
        **dict.fromkeys(("INNER_TIMES", "INNER_FIRST", "INNER_UNKNOWNS", "INNER_PRESENT"), bool(program.inner.times)),
        "INNER_LACKS": bool(program.inner.lacking),
        **dict.fromkeys(("SAMPLE", "FIRST_SAMPLE"), bool(program.sample)),
    }  # fmt: skip
    named = [name for name in named if name not in _FLAGS] + [name for name, there in others.items() if there]
    fields = [(_FIELDS.get(name, name.lower()), name) for name in named]
    return (*fields, *((name, "True") for name, flag in flags.items() if flag))


_FLAGS = ("BACKWARD", "BORDERED", "CARRIED", "CURVED", "START_COUNT", "END_COUNT", "LINKING")
_FIELDS = {"HESSIAN_ROWS": "rows", "HESSIAN_COLUMNS": "columns"} | {
    f"{end}_HESSIAN_{side}": f"{end}_{side}".lower() for end in ("START", "END") for side in ("ROWS", "COLUMNS")
}
"""Fields of the record whose names are not those of the module's constants in small letters."""


def has_nonlinear_ends(derivatives: ControlDerivatives) -> bool:
    """Whether an end has entries of the KKT matrix of its own; unknowns of its own always have."""
    return bool(derivatives.start.hessian or derivatives.end.hessian)


def slack_indices(program: ControlProgram) -> list[tuple[int, int]]:
    """Indices of slacks in an interval's unknowns, with those of their multipliers."""
    node, first = len(program.node), len(program.node) + len(program.interval) + len(program.controls)
    return [(first + j, node + index) for j, index in enumerate(program.slack_multipliers)]


def pins(program: ControlProgram) -> dict[str, Any]:
    """Given values at both ends as code, and what they read."""
    values = [v for end in (program.start, program.end) for _, v in end.pins]
    values += [v for end in (program.start, program.end) for _, _, v in end.shared]
    lines = []
    for node, end in (("0", program.start), ("-1", program.end)):
        for index, value in sorted(end.pins, key=lambda pin: pin[0]):
            lines.append(Line(f"nodes[:, {node}, {index}]", array_code(value)))
        for index, j, offset in end.shared:
            shared = f"own[:, {j}]" if j < program.own else f"common[{j - program.own}]"
            lines.append(
                Line(f"nodes[:, {node}, {index}]", shared if offset == 0 else f"{shared} + {array_code(offset)}")
            )
    for number, index in enumerate(program.inner.unknowns):
        lines.append(Line(f"nodes[:, without_inner_unknown(grid, {number}), {index}]", "0.0"))
    needs_shared = bool(program.start.shared or program.end.shared)
    views = shared_views(program, "own, common", "unknowns") if needs_shared else ()
    return {"pin_inputs": (*inputs(program, values, column=False), *views), "pinned_values": tuple(lines)}


def duration(program: ControlProgram) -> dict[str, Any]:
    """The duration as code of the arguments, or of the unknowns when it is free, and the times that follow from it."""
    free, code = program.scaled_time, scalar_code(program.model.duration)
    times = "duration_of(grid, unknowns) * grid.nodes / grid.steps" if free else "grid.h * grid.nodes"
    return {
        "duration_arguments": () if free else ("duration",),
        "default_durations": () if free else (code,),
        "grid_duration": "1.0" if free else "duration",
        "duration_inputs": duration_inputs(program, [program.model.duration]) if free else (),
        "duration": code if free else "grid.steps * grid.h",
        "phase_durations": (),
        "node_times": times if program.inner.clock is None else f"nodes[0, :, {program.inner.clock}].copy()",
        "choices": (),
        "of_each_phase": "",
        "fractions": "fractions (N,) of the duration",
    }


def duration_inputs(program: ControlProgram, durations: Sequence[Expr]) -> tuple[Line, ...]:
    """Lines that read what durations depend on, out of the parameters and the unknowns."""
    first = len(program.shared) - program.own + len(program.couplings)
    codes = {s: f"unknowns[{j - first}]" for j, s in enumerate(program.shared_symbols[program.own :])}
    codes |= {s: f"grid.parameters[0, {i}]" for i, s in enumerate(program.model.parameters)}
    used = set[Symbol]().union(*(duration.free_symbols for duration in durations))
    return tuple(Line(s.name, code) for s, code in codes.items() if s in used)


@dataclass(frozen=True)
class Bound:
    """Where a bound stands, its value, what it bounds, and whether that is one number for all bodies."""

    target: str
    value: Expr
    name: str
    is_common: bool = False

    @property
    def line(self) -> Line:
        """The assignment of the bound."""
        code = common_code(self.value) if self.is_common else array_code(self.value)
        return Line(self.target, {oo: "np.inf", -oo: "-np.inf"}.get(self.value) or code, self.name)


def bounds(program: ControlProgram) -> dict[str, Any]:
    """Bounds as code, where there are inequalities; the lines assign to lower or upper bounds of views."""
    if not program.has_inequalities:
        return {"bound_inputs": (), "bound_views": (), "bound_lines": ()}
    found = bound_values(program)
    return {
        "bound_inputs": inputs(program, [bound.value for bound in found]),
        "bound_views": bound_views(program),
        "bound_lines": ((*(bound.line for bound in found), *slack_bounds(program)),),
    }


def bound_values(program: ControlProgram) -> list[Bound]:
    """The bounds of all unknowns but slacks."""
    groups: list[tuple[str, Sequence[Unknown]]] = [
        ("nodes", program.node),
        ("intervals", (*program.interval, *program.controls)),
        ("own", program.shared[: program.own]),
        ("common", program.shared[program.own :]),
    ]
    found = []
    for group, unknowns in groups:
        for i, unknown in enumerate(unknowns):
            for side, value in (("lower", unknown.lower), ("upper", unknown.upper)):
                if value is not None:
                    is_common = group == "common"
                    target = f"{side}_{group}[{i}]" if is_common else f"{side}_{group}[..., {i}]"
                    found.append(Bound(target, value, unknown.name, is_common))
    for number, *limits in program.inner.windows:
        for side, value in zip(("lower", "upper"), limits, strict=True):
            if value is not None:
                target = f"{side}_nodes[:, grid.inner[{number}], {program.inner.clock}]"
                found.append(Bound(target, value, f"the window of waypoint {number + 1}", True))
    return [*found, *end_bounds(program)]


def end_bounds(program: ControlProgram) -> list[Bound]:
    """The bounds that hold at one end alone."""
    found = []
    for node, end in ((":1", program.start), ("-1:", program.end)):
        for i, bound in end.bounds:
            for side, value in (("lower", bound.lower), ("upper", bound.upper)):
                if value is not None:
                    found.append(Bound(f"{side}_nodes[:, {node}, {i}]", value, bound.condition))
    return found


def common_code(value: Expr) -> str:
    """A bound of a number that all bodies share as code: parameters have a row for each body, all the same."""
    return f"np.max({array_code(value)})" if value.free_symbols else array_code(value)


def slack_bounds(program: ControlProgram) -> list[Line]:
    """The bounds of slacks as code, and then what has no bounds at an end because it is determined there.

    A slack with one possible value keeps away from a bound below it, where a logarithm has a least value.
    """
    lines = []
    first = len(program.interval) + len(program.controls)
    for j, slack in enumerate(program.slacks):
        assert slack.lower is not None, "a slack has a least value"
        lines.append(Line(f"lower_intervals[..., {first + j}]", array_code(slack.lower), slack.name))
    for node, end in (("0", program.start), ("-1", program.end)):
        lines += [Line(f"lower_nodes[:, {node}, {i}]", "0.0", program.node[i].name) for i, _ in end.slacks]
        lines += [line for name, _ in end.determined for line in _without_bounds(program, end.slacks, node, node, name)]
    for number, name, before in program.inner.determined:
        node = f"grid.inner[{number}]"
        lines += _without_bounds(program, (), node, f"{node} - 1" if before else node, name)
    return lines


def _without_bounds(
    program: ControlProgram, slacks: Sequence[tuple[int, int]], node: str, interval: str, name: str
) -> list[Line]:
    """Lines that take away the bounds of an unknown of a node with its own `slacks`, or of a slack beside it."""
    of_interval = [slack.name for slack in program.slacks]
    if name in of_interval:
        index = len(program.interval) + len(program.controls) + of_interval.index(name)
        return [Line(f"lower_intervals[:, {interval}, {index}]", "-1.0", f"{name} is determined there")]
    index = [unknown.name for unknown in program.node].index(name)
    if index in [slack for slack, _ in slacks]:
        return [Line(f"lower_nodes[:, {node}, {index}]", "-1.0", f"{name} is determined there")]
    ends = (("lower", "-np.inf"), ("upper", "np.inf"))
    return [Line(f"{side}_nodes[:, {node}, {index}]", code, f"{name} is determined there") for side, code in ends]


def bound_views(program: ControlProgram) -> tuple[Line, ...]:
    """Lines that make views of the bounds of shared unknowns."""
    return (
        *shared_views(program, "lower_own, lower_common", "lower"),
        *shared_views(program, "upper_own, upper_common", "upper"),
    )


def views(program: ControlProgram) -> dict[str, Any]:
    """Code that reads positions, momenta, controls and multipliers out of the views of nodes and intervals."""
    n, kept = len(program.model.coordinates), len(program.interval)
    m, of_interval = len(program.model.controls), f"intervals[:, :, {kept}:{kept + len(program.controls)}]"
    if program.controlled == "stages":
        of_interval += f".reshape(BODIES, -1, {m})"
    variational, nodal = program.method == "variational", program.nodal_controls
    rates = 2 * n if program.model.rates else n
    equations = sum(u.kind is Kind.STEP for u in program.interval)
    steps_first = next((i for i, u in enumerate(program.interval) if u.multiplier), kept)
    last_node = len(program.node)
    return {
        "positions": f"nodes[:, :, :{n}]",
        "momenta": "discrete_momenta(grid, unknowns)" if variational else f"nodes[:, :, {n}:{rates}]",
        "controls": f"nodes[:, :, {last_node - m}:]" if nodal else of_interval,
        "multipliers": f"nodes[:, :, {n}:{2 * n}]"
        if variational
        else f"intervals[:, :, {steps_first}:{steps_first + equations}]",
        "control_sites": _CONTROL_SITES[program.controlled] if m else "none",
    }


_CONTROL_SITES = {"interval": "on intervals", "nodal": "at nodes", "stages": "at the stages of all intervals"}


def integers(values: Sequence[int]) -> str:
    """Code of an index array."""
    return f"np.array({list(values)}, dtype=np.int64)" if values else "np.zeros(0, np.int64)"


def _size_lines(program: ControlProgram, derivatives: ControlDerivatives) -> list[Line]:
    number = dict(sizes(program, derivatives))
    own = Line("OWN", str(number["OWN"]), f"shared unknowns of a body: {_names(program.shared[: program.own])}")
    return [
        Line("BODIES", str(number["BODIES"]), "bodies, each with a chain of nodes and intervals"),
        *([own] if program.shared else []),
        Line("SHARED", str(number["SHARED"]), f"with those of the whole problem: {_names(program.shared)}"),
        Line("COUPLINGS", str(number["COUPLINGS"]), "conditions between shared unknowns"),
        Line("ROOT", str(number["ROOT"]), "unknowns that no node owns, with the conditions' multipliers"),
        Line("BACKWARD", str(number["BACKWARD"]), "whether elimination goes from the last interval to the first"),
        Line("BORDERED", str(number["BORDERED"]), "whether the first block stays to the end of the elimination"),
        Line("CARRIED", str(number["CARRIED"]), "columns of right-hand sides that take part in the elimination"),
    ]


def inputs(program: ControlProgram, values: Sequence[Expr], column: bool = True) -> tuple[Line, ...]:
    """Lines that read what expressions depend on, an entry for every body, as columns beside arrays of time.

    Of one body they are numbers: arrays of one number take several times as long.
    """
    used = set().union(*(value.free_symbols for value in values)) if values else set()
    suffix = ", None" if column else ""
    count = len(parameters(program)) - len(program.shared_symbols)
    known = enumerate(parameters(program)[:count])
    which = "[0, {}]" if program.bodies == 1 else f"[:, {{}}{suffix}]"
    lines = [Line(s.name, f"grid.parameters{which.format(i)}") for i, s in known if s in used]
    if program.body in used:
        lines.append(Line(str(program.body), f"np.arange(BODIES)[:{suffix}]" if column else "np.arange(BODIES)"))
    return tuple(lines)


def shared_views(program: ControlProgram, target: str, vector: str) -> tuple[Line, ...]:
    """The line that makes views of the shared unknowns, where there are any."""
    return (Line(target, f"shared_views(grid, {vector})"),) if program.shared else ()


def _names(unknowns: Sequence[Unknown]) -> str:
    return ", ".join(u.name for u in unknowns) or "none"


def codes(program: ControlProgram) -> dict[Symbol, str]:
    """The code that reads, inside a kernel of an interval, the numbers of its left node."""
    first, count = _first(program), len(program.inner.times)
    symbols = enumerate(program.inner.symbols)
    return {symbol: f"inner_number(parameters, {first}, {count}, {i}, t, h)" for i, symbol in symbols}


def _first(program: ControlProgram) -> int:
    """Where inner times stand in the vector of parameters."""
    return len(program.model.parameters) + len(program.boundary_values)


def inner_time_constants(program: ControlProgram) -> list[Line]:
    """How many times there are, and which unknowns belong to them."""
    inner = program.inner
    if not inner.times:
        return []
    lines = [
        Line("INNER_TIMES", str(len(inner.times)), "times between start and end at which conditions hold"),
        Line("INNER_FIRST", str(_first(program)), "where they stand among the parameters"),
        Line("INNER_UNKNOWNS", integers(inner.unknowns), "unknowns of nodes at such times; zero at others"),
        Line("INNER_PRESENT", f"np.array({[list(row) for row in inner.present]})", "which of them, time by time"),
    ]
    if inner.lacking:
        lacks = [len(program.node) + index for index in inner.lacking]
        lines.append(Line("INNER_LACKS", integers(lacks), "unknowns that intervals after them lack"))
    return lines


def times_and_values(program: ControlProgram, boundary_code: Callable[[Expr], str]) -> dict[str, Any]:
    """The inner times, and what stands among the parameters for them."""
    inner = program.inner
    values = zip(inner.values, inner.parameters, strict=True)
    return {
        "inner_times": (tuple(map(scalar_code, inner.times)),) if inner.times else (),
        "inner_values": tuple(Line("", boundary_code(value), symbol.name) for value, symbol in values),
    }


def grid_code(program: ControlProgram, duration: str) -> str:
    """Code that makes the grid of a duration, which has the inner times among its nodes."""
    made = f"checked_grid(problem, steps, {duration}, parameters, grid)"
    return f"with_inner_times({made})" if program.inner.times else made


FRACTION = Symbol("fraction", real=True)
"""The part of the duration that has passed, of which straight lines between the ends are functions."""


def guesses(program: ControlProgram) -> dict[str, Any]:
    """Guesses as code over arrays of time, and what they read."""
    at_nodes = [replace(line, target=f"nodes[:, :, {line.target}]") for line in _node_guess(program)]
    inside = [replace(line, target=f"intervals[:, :, {line.target}]") for line in _interval_guess(program)]
    measured, between = _through_samples(program)
    at_nodes += [*measured, *_through_inner_times(program)]
    inside = [line for line in inside if line.target not in {other.target for other in between}] + between
    lines = [*_times("grid.nodes", at_nodes), *at_nodes]
    lines += [*_times("(0.5 * (grid.nodes[:-1] + grid.nodes[1:]))", inside), *inside]
    at_inner_times = [value for _, values, _, _ in program.inner.guess for _, value in values]
    duration = (Line("duration", "duration_of(grid, unknowns)"),)
    return {
        "guess_inputs": inputs(
            program, [*program.node_guess, *program.stage_guess, *program.control_guess, *at_inner_times]
        ),
        "guess_lines": (*(duration if _read("duration", lines) else ()), *lines),
        **shared_guesses(program),
    }


def _times(nodes: str, guessed: Sequence[Line]) -> Iterator[Line]:
    """Lines that make the times of guesses, as fractions of the duration or as they are, where guesses read them."""
    if _read(FRACTION.name, guessed):
        yield Line(FRACTION.name, f"{nodes} / grid.steps")
    if _read("t", guessed):
        yield Line("t", f"duration * {nodes} / grid.steps")


def _guess_code(program: ControlProgram, guess: Expr) -> str:
    """Code of a guess over arrays of time, in fractions of the duration where that is all that it depends on."""
    relative = guess.xreplace({program.model.time: FRACTION * DURATION})
    return array_code(guess if relative.has(DURATION) else relative)


def _through_inner_times(program: ControlProgram) -> list[Line]:
    """Lines that lead guesses through values at inner times."""
    lines = []
    for index, values, at_start, at_end in program.inner.guess:
        numbers, codes = [number for number, _ in values], ", ".join(array_code(value) for _, value in values)
        target = f"nodes[:, :, {index}]"
        call = f"through_inner_times(grid, {target}, {numbers}, [{codes}], {at_start}, {at_end})"
        lines.append(Line(target, call))
    return lines


def _through_samples(program: ControlProgram) -> tuple[list[Line], list[Line]]:
    """Lines that lead guesses through what was measured, at nodes and, on straight lines, inside intervals."""
    at_nodes, inside = [], []
    given = [{index for index, *_ in (*end.pins, *end.shared)} for end in (program.start, program.end)]
    for index, column in program.sample.guess if program.sample else ():
        name, target = program.node[index].name, f"nodes[:, :, {index}]"
        call = f"through_samples(grid, {target}, {column}, {index in given[0]}, {index in given[1]})"
        at_nodes.append(Line(target, call, f"{name}, as measured"))
        inner = program.interval[: len(program.stage_guess)]
        stages = [j for j, stage in enumerate(inner) if stage.name.rpartition("_")[0] == name]
        mean = f"0.5 * (nodes[:, :-1, {index}] + nodes[:, 1:, {index}])"
        inside += [Line(f"intervals[:, :, {j}]", mean, program.interval[j].name) for j in stages]
    return at_nodes, inside


def _read(name: str, lines: Sequence[Line]) -> bool:
    """Whether lines read the value of a name."""
    return any(re.search(rf"\b{name}\b", line.code) for line in lines)


def shared_guesses(program: ControlProgram) -> dict[str, Any]:
    """Guesses of shared unknowns as code, and the result."""
    common = program.shared_guess[program.own :]
    return {
        "shared_guess_inputs": (*_scalar_inputs(program, common), *shared_views(program, "own, common", "unknowns")),
        "common_guess": tuple(
            Line(f"common[{j}]", scalar_code(sympy.sympify(value)), unknown.name)
            for j, (unknown, value) in enumerate(zip(program.shared[program.own :], common, strict=True))
        ),
        "own_guess": _own_guess(program),
        "guess_result": "with_slacks(grid, unknowns)" if slack_indices(program) else "unknowns",
    }


def _scalar_inputs(program: ControlProgram, values: Sequence[Expr]) -> tuple[Line, ...]:
    used = set().union(*(value.free_symbols for value in values)) if values else set()
    known = enumerate(program.model.parameters)
    return tuple(Line(s.name, f"grid.parameters[0, {i}]") for i, s in known if s in used)


def _node_guess(program: ControlProgram) -> tuple[Line, ...]:
    lines = [
        Line(str(i), _guess_code(program, guess), program.node[i].name) for i, guess in enumerate(program.node_guess)
    ]
    if program.nodal_controls:
        first = len(program.node) - len(program.model.controls)
        controls = zip(program.model.controls, program.control_guess, strict=True)
        lines += [Line(str(first + i), _guess_code(program, guess), u.name) for i, (u, guess) in enumerate(controls)]
    return tuple(line for line in lines if line.code != "0")


def _interval_guess(program: ControlProgram) -> tuple[Line, ...]:
    """Guesses at the middle of every interval: of stages, and of controls that live there."""
    guessed = list(enumerate(zip(program.interval_symbols, program.stage_guess, strict=False)))
    if not program.nodal_controls:
        controls = zip(program.control_symbols, program.control_guess, strict=True)
        guessed += enumerate(controls, start=len(program.interval))
    lines = [Line(str(i), _guess_code(program, guess), symbol.name) for i, (symbol, guess) in guessed]
    return tuple(line for line in lines if line.code != "0")


def _own_guess(program: ControlProgram) -> tuple[Line, ...]:
    """Guesses of a body's shared unknowns: what a node's unknown equals is read there."""
    lines: dict[int, Line] = {}
    for node, end in (("0", program.start), ("-1", program.end)):
        for index, j, _ in end.shared:
            if j < program.own:
                lines.setdefault(j, Line(f"own[:, {j}]", f"nodes[:, {node}, {index}]", program.shared[j].name))
    return tuple(lines.values())
