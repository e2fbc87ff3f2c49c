"""The initial guess of stages belongs to their times: a motion along a straight line solves all equations at once."""

from __future__ import annotations

import pytest
from interpreted import without_compilation

from codegen.discretise import schemes
from codegen.emit.naming import Choices
from codegen.solving.compiler import generate

FREE = '''"""A free particle, and a quantity that grows at the rate of the control."""

from codegen import Control, Phases, control, coordinate, state, time


def problem() -> Control:
    u = control("u")
    {quantity}
    common = dict({law}, cost=(u - {force})**2)
    return {task}
'''
SINGLE = "Control(**common, duration=2, start={x: 1}, end={x: 3}, guess={guess}, steps=4)"
PHASES = """Phases(
        Control(**common, duration=1, start={x: 1}, guess={guess}, steps=4),
        Control(**common, duration=1, end={x: 3}, guess={guess}, steps=4),
    )"""
MECHANICAL = ('x, v = coordinate("x")', "lagrangian=v**2 / 2, force={x: u}", 0, "{x: 1 + time()}")
FIRST_ORDER = ('x = state("x")', "dynamics={x: u}", 1, "{x: 1 + time(), u: 1}")
CASES = [
    (problem, scheme)
    for problem, method in ((MECHANICAL, "variational"), (FIRST_ORDER, schemes.FIRST_ORDER))
    for scheme in schemes.of_method(method)
    if len(scheme.parts) <= 16  # a control problem takes no longer compositions
]


@pytest.mark.parametrize("task", [SINGLE, PHASES], ids=["motion", "phases"])
@pytest.mark.parametrize(("problem", "scheme"), CASES, ids=lambda case: getattr(case, "name", None))
def test_a_straight_line_solves_the_equations_of_every_scheme(tmp_path, problem, scheme, task):
    """The optimum x = 1 + t has the least cost, zero, so that the gradient vanishes with all equations."""
    quantity, law, force, guess = problem
    path = tmp_path / "free.py"
    path.write_text(FREE.format(quantity=quantity, law=law, force=force, task=task.replace("{guess}", guess)))
    method = "variational" if problem is MECHANICAL else schemes.FIRST_ORDER
    module = without_compilation(generate(path, {}, Choices(scheme.name, method, "interval")))
    result = module.solve(log=True)
    assert result.status == "solved"
    assert result.log[0, 1] < 1e-12
    assert result.iterations == 0
