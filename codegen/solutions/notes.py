"""What a user should know of a module although it solves its problem: one line for each, from its metadata."""

from __future__ import annotations

import ast
from pathlib import Path
from typing import cast

from codegen.runtime import record
from codegen.runtime.record import ControlRecord, Record, Task

NAME = 40
"""Characters of a condition that people are shown; interior angles of a polygon fill six lines."""


def notes(of: Record) -> list[str]:
    """Unused symbols, what was left out of a control problem, controls that its cost does not see; none as a rule."""
    found = []
    if unused := of.unused:
        found.append(f"{', '.join(unused)} {'is' if len(unused) == 1 else 'are'} declared but never used")
    if of.task != Task.CONTROL:
        return found
    metadata = cast(ControlRecord, of)
    if redundant := metadata.redundant_conditions:
        named = ", ".join(f"number {number} ({shortened(name)})" for number, name in redundant)
        verb = "follows from the others and was" if len(redundant) == 1 else "follow from the others and were"
        count = f"{len(redundant)} of {metadata.coupling_conditions}"
        found.append(f"{count} conditions between bodies {verb} left out: {named}")
    for quantity, where in metadata.dependent_values:
        found.append(
            f"{shortened(quantity)} at the {where} follows from the path equalities with the other values at the ends, "
            "and was left out"
        )
    for condition, where in metadata.decided_conditions:
        found.append(
            f"{shortened(condition)} holds with equality at the {where}, by what is prescribed there, and was left out"
        )
    for name, value, last in metadata.history_jumps:
        found.append(f"{name} starts at {value}, where its history ends at {last}: its values of the past jump there")
    if kinks := metadata.kinks:
        named = ", ".join(map(shortened, kinks))
        found.append(
            f"the cost has a kink in {named}, at which Newton's method stalls: write a + b for Abs(u), with controls "
            "a, b >= 0 and a - b for u, or a control that is bounded by both sides of a Max"
        )
    if borders := metadata.discontinuities:
        named = ", ".join(map(shortened, borders))
        found.append(
            f"something jumps where {named} changes, which derivatives do not see: make it smooth, as by "
            "(1 + tanh(s/width))/2, or give each side a phase of its own"
        )
    for function, what, where in metadata.singular_at_guess:
        inside, instead = function.removeprefix("sqrt(")[:-1], ""
        if function.startswith("sqrt(") and " + " in inside:
            instead = f"; for a length in the cost, a control c >= 0 in its place with path {inside} <= c**2"
        found.append(
            f"{shortened(function)} has no finite {what} at the guess, {where}, where a search cannot begin: give "
            f"another guess, or bounds that keep away from there{instead}"
        )
    if unseen := metadata.unseen_controls:
        found.append(
            f"the scheme averages nodal controls, and their alternation costs nothing ({', '.join(unseen)}): what is "
            "found may be no optimum; codegen check explains, and --controls interval has no such mode"
        )
    return found


def notes_of_file(path: Path) -> list[str]:
    """The same of a generated module that need not be imported."""
    return notes(record_in(path.read_text(encoding="utf-8")))


def record_in(text: str) -> Record:
    """Return the record in the text of a generated module."""
    assigned = (node for node in ast.parse(text).body if isinstance(node, ast.Assign))
    made = next(node.value for node in assigned if getattr(node.targets[0], "id", "") == "metadata")
    return cast(Record, eval(compile(ast.Expression(made), "metadata", "eval"), dict(vars(record))))


def shortened(name: str, limit: int = NAME) -> str:
    """The beginning of a long name."""
    return name if len(name) <= limit else name[:limit].rstrip() + " ..."
