"""An oscillator with a drawing."""

from __future__ import annotations

from typing import Any

from codegen import Control, control, coordinate, parameter
from codegen.discretise.model.definitions import Model
from codegen.discretise.model.from_problem import normalise
from codegen.problem.symbols import recorded_declarations


def oscillator(drawing: Any, **changes: Any) -> Model:
    """A model of an oscillator; the drawing is a function of (q, dq, u, k), called while declarations are recorded."""
    with recorded_declarations() as declared:
        q, dq = coordinate("q")
        u, k = control("u"), parameter("k", 3)
        items = drawing(q, dq, u, k) if callable(drawing) else drawing
        arguments = {"duration": 2, "start": {q: 0, dq: 0}, "end": {q: 1, dq: 0}, "drawing": items, **changes}
        problem = Control(lagrangian=dq**2 / 2 - k * q**2 / 2, force={q: u}, cost=u**2, **arguments)
    return normalise(problem, declared)
