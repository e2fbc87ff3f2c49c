"""What all that a problem file may return has in common, told without sympy, and how a notebook shows it."""

from __future__ import annotations

from codegen.tasks import Home

_LATEX = Home("notebooks.mathematics", "displayed")


class AuthorObject:
    """A Control, Simulate, Phases or Connect."""

    def _repr_latex_(self) -> str:
        return str(_LATEX(self))
