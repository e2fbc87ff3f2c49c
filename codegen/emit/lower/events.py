"""Lowering of the events and gaps of a simulation to kernels, and to fields of the StepProblem."""

from __future__ import annotations

from collections.abc import Mapping

from sympy import Expr, Symbol

from codegen.discretise.program import StepProgram
from codegen.emit.lower.kernels import KERNEL, Kernel, Output, kernel, needed
from codegen.emit.lower.printer import readable
from codegen.runtime.record import EventAction

_SHARED = "state", "t", "parameters"


EVENT_KERNELS = {
    "event_values": (
        "values",
        "Fill `values` (events + gaps, 3): value, rate along the motion, and sum of the moduli of the terms.",
    ),
    "event_jumps": ("jumps", "Fill `jumps` (changes, STATE): the state after each event that changes the state."),
    "gap_normals": (
        "normals",
        "Fill `normals` (gaps, 3 + 2 coordinates): acceleration, restitution, size of the rate, G, M^-1 G^T.",
    ),
}
"""The kernels of events and gaps: the array that they fill, and the first line of their docstring."""


def rows_of_events(program: StepProgram) -> dict[str, list[tuple[str, Expr]]]:
    """Return the entries, with their meanings, of the arrays that the kernels of events and gaps fill."""
    rows = dict(zip(EVENT_KERNELS, (event_rows(program), jump_rows(program), normal_rows(program)), strict=True))
    return {name: entries for name, entries in rows.items() if entries}


def event_kernels(program: StepProgram, codes: Mapping[Symbol, str]) -> list[Kernel]:
    """Return the kernels of events and gaps; none without events and gaps."""
    assignments, kernels = (*program.state_assignments, *program.event_assignments), list[Kernel]()
    for name, entries in rows_of_events(program).items():
        array, summary = EVENT_KERNELS[name]
        read = needed(assignments, [value for _, value in entries])
        # Assignments of a large mass matrix share all common subexpressions; those of constraint forces do not.
        is_shared = bool(program.state_assignments)
        kernels.append(
            kernel(
                name, summary, (*_SHARED, array), codes,
                [Output(f"{array}[{i}]", value, meaning) for i, (meaning, value) in enumerate(entries)],
                assignments=() if is_shared else read, decorators=KERNEL, straight_line=read if is_shared else (),
            )
        )  # fmt: skip
    return kernels


def event_rows(program: StepProgram) -> list[tuple[str, Expr]]:
    """Return the entries of the array `values` with their meanings."""
    meanings = "value", "rate", "scale"
    return [
        (f"{meaning} of {event.name}", value)
        for event in (*program.events, *program.gaps)
        for meaning, value in zip(meanings, event.row, strict=True)
    ]


def jump_rows(program: StepProgram) -> list[tuple[str, Expr]]:
    """Return the entries of the array `jumps` with their meanings."""
    return [
        (f"{unknown.name} after {event.name}", value)
        for event in program.events
        if event.after
        for unknown, value in zip(program.state, event.after, strict=True)
    ]


def normal_rows(program: StepProgram) -> list[tuple[str, Expr]]:
    """Return the entries of the array `normals` with their meanings."""
    rows = list[tuple[str, Expr]]()
    for gap in program.gaps:
        names = [q.name for q in program.model.coordinates]
        meanings = [
            "acceleration",
            "restitution",
            "size of the rate",
            *(f"slope by {q}" for q in names),
            *(f"response of {q}" for q in names),
        ]
        rows += [(f"{meaning}, {gap.name}", value) for meaning, value in zip(meanings, gap.contact, strict=True)]
    return rows


def event_fields(program: StepProgram) -> dict[str, str]:
    """Return the fields of the StepProblem with their code."""
    if not (program.events or program.gaps):
        return {}
    actions, rules, row = list(EventAction), list[str](), 0
    for event in (*program.events, *program.gaps):
        rules.append(f"({actions.index(event.action)}, {event.direction}, {row if event.after else -1})")
        row += bool(event.after)
    fields = {"events": "event_values", "rules": f"np.array([{', '.join(rules)}])"}
    fields |= {"jumps": "event_jumps"} if row else {}
    return fields | ({"normals": "gap_normals"} if program.gaps else {})


def event_lines(program: StepProgram) -> list[str]:
    """Return the lines about events and gaps in the docstring of a module."""
    lines = list[str]()
    if program.events:
        lines += ["", "Events, at zeros of:", ""]
        for event in program.model.events:
            changes = ", ".join(f"{symbol} = {readable(value)}" for symbol, value in event.changes)
            effect = f"then {changes}" if changes else {"stop": "end of the motion"}.get(event.action, event.action)
            lines.append(f"    {event.name}: {readable(event.expression)}, {effect}")
    if program.gaps:
        lines += ["", "Gaps, which do not become negative, with their coefficients of restitution:", ""]
        lines += [f"    {readable(gap.expression)}: {readable(gap.restitution)}" for gap in program.model.gaps]
    return lines
