"""The classes and functions for authors of problems, and the reading of problem files.

This file has the base class of problems, and the remedy for misspelt arguments. It imports no sympy.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from codegen.deferred import Deferred

_LATEX = Deferred("show.notebook", "displayed")

SYNONYMS = {
    "cost": ("minimize", "minimise", "objective", "running_cost", "lagrange"),
    "terminal_cost": ("final_cost", "end_cost", "mayer"),
    "maximise": ("maximize",),
    "terminal_maximise": ("terminal_maximize", "final_maximise"),
    "start": ("initial", "initial_state", "x0"),
    "end": ("final", "final_state", "terminal", "goal"),
    "duration": ("T", "tf", "final_time", "time", "horizon"),
    "steps": ("N", "nodes", "intervals"),
    "path": ("constraints", "inequalities"),
}
"""Names that other programs have for arguments of problems."""


class AuthorObject:
    """A Control, Simulate, Phases or Connect."""

    def _repr_latex_(self) -> str:
        return str(_LATEX(self))


def perhaps(name: str, known: Iterable[str]) -> str:
    """Return a sentence with the arguments that a name may stand for; empty if no argument is similar."""
    arguments = list(known)
    meant = [argument for argument, others in SYNONYMS.items() if argument in arguments and name in others]
    similar = meant or difflib.get_close_matches(name, arguments)
    return f"perhaps it is {' or '.join(similar)}" if similar else ""
