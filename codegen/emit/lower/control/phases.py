"""What several phases in one chain need as strings: choices of kernels, tables, durations, guesses, bounds."""

from __future__ import annotations

from typing import Any

from sympy import Expr, Max, Min, oo

from codegen.discretise.program import ControlProgram, IntervalElement, Phase, Unknown
from codegen.emit.lower.control.layout import (
    Bound,
    bound_views,
    duration_inputs,
    end_bounds,
    inputs,
    shared_guesses,
    slack_bounds,
)
from codegen.emit.lower.kernels import Line
from codegen.emit.lower.module import Choice
from codegen.emit.lower.printer import array_code, scalar_code
from codegen.symbolic.functions import tables_of


def named_elements(program: ControlProgram) -> list[tuple[str, str]]:
    """The stem of the kernels' names for every kind of interval, in their order, and where these intervals are."""
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


def choices(program: ControlProgram) -> tuple[Choice, ...]:
    """The functions that choose the kernel of an interval by its time, which is a whole number where a phase begins."""
    out = [
        choice(
            program, "gradient", "Gradient (ELEMENT + SHARED,) of an interval's share l of the Lagrangian; returns Cd."
        ),
        choice(
            program,
            "hessian",
            "Hessian (HESSIAN_ROWS.size,), lower triangle, of an interval's share l of the Lagrangian.",
        ),
    ]
    shares = [part for share in program.interval_elements for part in (share.element, share.cost)]
    if any(table.shape.outside == "error" for table in tables_of(shares, program.start, program.end)):
        summary = "Least and greatest `inputs` (RANGED, 2) with which tables are read on an interval."
        out.append(choice(program, "inputs", summary))
    return tuple(out)


def choice(program: ControlProgram, kind: str, summary: str, filled: tuple[str, ...] = ()) -> Choice:
    """The function that chooses a kind of kernel, which fills the array of that name, or those that are `filled`."""
    stems = [stem for stem, _ in named_elements(program)]
    names = [f"{stem}_{kind}" for stem in stems]
    branches = tuple(zip(map(_end, stems[:-1]), names, strict=False))
    arguments = ("unknowns", "t", "h", "parameters", *(filled or (kind,)))
    return Choice(f"interval_{kind}", summary, arguments, branches, names[-1])


def _end(stem: str) -> str:
    """The condition that an interval lies before the end of those with a kernel, with something for rounding."""
    kind, number = stem.split("_")
    return f"t < {number} + 1e-12" if kind == "switch" else f"t < {number} - 1e-12"


def constants(program: ControlProgram) -> list[Line]:
    """The number of phases, and which unknowns of intervals each lacks."""
    inside = range(len(program.interval) + len(program.controls) + len(program.slacks))

    def table(elements: list[IntervalElement]) -> str:
        return f"np.array({[[i in element.lacking for i in inside] for element in elements]})"

    first = [phase.elements[0] for phase in program.phases[1:]]
    return [
        Line("PHASES", str(len(program.phases)), "phases, each of equally many intervals"),
        Line("PHASE_LACKS", table([phase.regular for phase in program.phases]), "unknowns of an interval, by phase"),
        Line("SWITCH_LACKS", table(first), "the same of the first interval after each switch"),
    ]


def duration(program: ControlProgram) -> dict[str, Any]:
    """The durations as code of parameters and shared unknowns, and the times that follow from them."""
    durations = [phase.duration for phase in program.phases]
    return {
        "duration_arguments": (),
        "default_durations": (),
        "grid_duration": "1.0",
        "duration_inputs": (),
        "duration": "phase_durations(grid, unknowns).sum()",
        "phase_durations": ((duration_inputs(program, durations), tuple(map(scalar_code, durations))),),
        "node_times": "node_times(grid, unknowns)",
        "choices": choices(program),
        "of_each_phase": " of each phase",
        "fractions": "fractions (N,) of every phase, or (PHASES, N) of each,",
    }


def guesses(program: ControlProgram) -> dict[str, Any]:
    """Guesses as code over arrays of time, phase by phase, and what they read."""
    lines, values = [Line("steps", "grid.steps // PHASES")], list[Expr]()
    for i, phase in enumerate(program.phases):
        middles = "interval_times(grid, unknowns)"
        groups = (
            ("nodes", "node_times(grid, unknowns)", _nodes(program, i), program.node, enumerate(phase.node_guess)),
            ("intervals", middles, _intervals(program, i), phase.inside, phase.inside_guess),
            ("intervals", "node_times(grid, unknowns)", _switch(i), phase.inside, phase.switch_guess),
        )
        for view, times, where, unknowns, guess in groups:
            written = [(j, value, array_code(value)) for j, value in guess if value != 0]
            lines += [Line("t", f"{times}[{where}]")] if any(v.has(program.model.time) for _, v, _ in written) else []
            lines += [Line(f"{view}[:, {where}, {j}]", code, unknowns[j].name) for j, _, code in written]
            values += [value for _, value, _ in written]
    return {"guess_inputs": inputs(program, values), "guess_lines": tuple(lines), **shared_guesses(program)}


def bounds(program: ControlProgram) -> dict[str, Any]:
    """Bounds as code, phase by phase, where there are inequalities."""
    if not program.has_inequalities:
        return {"bound_inputs": (), "bound_views": (), "bound_lines": ()}
    found = bound_values(program)
    return {
        "bound_inputs": inputs(program, [bound.value for bound in found]),
        "bound_views": (Line("steps", "grid.steps // PHASES"), *bound_views(program)),
        "bound_lines": ((*(bound.line for bound in found), *slack_bounds(program)),),
    }


def bound_values(program: ControlProgram) -> list[Bound]:
    """The bounds of all unknowns but slacks, phase by phase."""
    found = list[Bound]()
    for i, phase in enumerate(program.phases):
        for j, unknown in enumerate(phase.node):
            target = f"nodes[:, {_nodes(program, i)}, {j}]"
            found += [Bound(f"{side}_{target}", v, unknown.name) for side, v in _sides(unknown)]
        for j, unknown in enumerate(phase.inside[: len(program.interval) + len(program.controls)]):
            target = f"intervals[:, {_intervals(program, i)}, {j}]"
            found += [Bound(f"{side}_{target}", v, unknown.name) for side, v in _sides(unknown)]
        if i:
            found += _at_switch(program.phases[i - 1], phase, _switch(i))
    for j, unknown in enumerate(program.shared):
        found += [Bound(f"{side}_common[{j}]", value, unknown.name, True) for side, value in _sides(unknown)]
    return [*found, *end_bounds(program)]


def _sides(unknown: Unknown) -> list[tuple[str, Expr]]:
    sides = (("lower", unknown.lower), ("upper", unknown.upper))
    return [(side, value) for side, value in sides if value is not None]


def _at_switch(before: Phase, after: Phase, where: str) -> list[Bound]:
    """At a switch the bounds of both phases hold for what does not jump there, and none for what is given."""
    found = []
    for j, (earlier, later) in enumerate(zip(before.node, after.node, strict=True)):
        known, new = dict(_sides(earlier)), dict(_sides(later)) if j not in after.jumping else {}
        if j in after.given:
            new = {side: -oo if side == "lower" else oo for side in known}
        elif known:
            new = {side: (Max if side == "lower" else Min)(known.get(side, v), v) for side, v in new.items()}
        name = f"{later.name} at the switch"
        found += [Bound(f"{side}_nodes[:, {where}, {j}]", v, name) for side, v in new.items()]
    return found


def _nodes(program: ControlProgram, i: int) -> str:
    """The nodes of a phase; that at a switch belongs to the phase before it."""
    first = "" if i == 0 else f"{_steps(i)} + 1 "
    return f"{first}: {_steps(i + 1)} + 1" if i + 1 < len(program.phases) else f"{first}:"


def _intervals(program: ControlProgram, i: int) -> str:
    first = "" if i == 0 else f"{_steps(i)} "
    return f"{first}: {_steps(i + 1)}" if i + 1 < len(program.phases) else f"{first}:"


def _switch(i: int) -> str:
    """The node, or the interval, at which phase i begins."""
    return f"{_steps(i)} : {_steps(i)} + 1"


def _steps(number: int) -> str:
    return "steps" if number == 1 else f"{number} * steps"
