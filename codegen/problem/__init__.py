"""The classes and functions with which users write problems, and the reading of problem files.

This file has the base class of problems, and the remedy for misspelt arguments. It does not import sympy.
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
"""Names that other programs use for the arguments of problems, by the names in this package."""


class AuthorObject:
    """The base class of the problems that users write: Control, Simulate, Phases and Connect."""

    def _repr_latex_(self) -> str:
        return str(_LATEX(self))


def perhaps(name: str, known: Iterable[str]) -> str:
    """Return a remedy that lists the arguments in `known` that an unknown name may mean; empty if none is similar."""
    arguments = list(known)
    meant = [argument for argument, others in SYNONYMS.items() if argument in arguments and name in others]
    similar = meant or difflib.get_close_matches(name, arguments)
    return f"perhaps it is {' or '.join(similar)}" if similar else ""
