"""Holonomic constraints c(q) = 0 along the computed motion: none may drift away from its surface."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import sympy

from codegen.checks.base import Context, Finding, not_measured
from codegen.checks.solution.solutions import free_values

_HELD = 1e-9


def check(context: Context) -> Iterator[Finding]:
    """Evaluate every constraint at all nodes of the solution, in units of its own terms."""
    model = context.model
    solution = context.solution
    if solution.status != "solved":
        yield not_measured("holonomic drift", "all constraints", solution.message)
        return
    numbers = [*model.defaults, *free_values(context.module, solution)]
    symbols = [*model.coordinates, model.time, *model.parameters, *(p.symbol for p in model.free_parameters)]
    width = len(model.coordinates)
    for constraint in model.holonomic:
        terms = sympy.Add.make_args(constraint)
        function = sympy.lambdify(symbols, [constraint, sum(map(sympy.Abs, terms), sympy.S.Zero)], cse=True)
        largest, size, node, body = 0.0, 1.0, 0, 0
        for b in range(model.bodies):
            q = solution.q[:, b * width : (b + 1) * width].T
            values, sizes = (np.broadcast_to(v, solution.t.shape) for v in function(*q, solution.t, *numbers))
            if np.abs(values).max() >= largest:
                node, body = int(np.argmax(np.abs(values))), b
                largest, size = float(np.abs(values[node])), max(1.0, float(np.abs(sizes).max()))
        passed = largest <= _HELD * size
        of_body = f" of body {body}" if model.bodies > 1 else ""
        detail = f"|c| <= {largest:.1g} at all {solution.t.size} nodes, greatest at node {node}{of_body}"
        if not passed:
            detail = f"the motion leaves the constraint: |c| = {largest:.2g} at node {node}{of_body}"
        yield Finding("holonomic drift", f"c = {sympy.sstr(constraint)}", passed, detail)
