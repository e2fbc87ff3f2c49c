"""What all that a problem file may return has in common, told without sympy, and how a notebook shows it.

What an argument of a problem that there is not may have been meant for.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from codegen.deferred import Deferred

_LATEX = Deferred("show.notebook", "displayed")


class AuthorObject:
    """A Control, Simulate, Phases or Connect."""

    def _repr_latex_(self) -> str:
        return str(_LATEX(self))


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
"""What other programs call arguments of problems."""


def perhaps(name: str, known: Iterable[str]) -> str:
    """The arguments that a name may have been meant for, in words, or nothing where none is like it."""
    own = list(known)
    meant = [argument for argument, others in SYNONYMS.items() if argument in own and name in others]
    similar = meant or difflib.get_close_matches(name, own)
    return f"perhaps it is {' or '.join(similar)}" if similar else ""
