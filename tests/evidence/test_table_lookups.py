"""Look-ups of tables that were damaged in an emitted text, or in a module, are found."""

from __future__ import annotations

import inspect
import re

import numpy as np
import pytest

from codegen.discretise import transcribe
from codegen.discretise.model.from_problem import load_problem
from codegen.emit.verify import verify
from codegen.errors import VerificationError
from codegen.evidence import checks
from codegen.runtime import tabulated
from codegen.solving.compiler import build

_PROBLEM = '''"""A mass on a spring from a table, and in a field from another one."""

from codegen import Control, Table, control, states


def problem() -> Control:
    x, v = states("x v")
    u = control("u")
    spring, field = Table("t.csv", "x", "f", name="spring"), Table("g.csv", ("x", "v"), "g", outside="clamp")
    return Control(
        dynamics={x: v, v: u - spring(x) + field(x, v)}, cost=u**2, duration=1, start={x: 1, v: 0}, end={x: 0}, steps=8
    )
'''
DAMAGES = {
    "first-number": (
        r"cubic_curve\(parameters, (\d+),",
        lambda found: found[0].replace(found[1], str(int(found[1]) + 1)),
    ),
    "sizes-exchanged": (r"(cubic_surface\(parameters, \d+), 5, 6,", r"\1, 6, 5,"),
    "range-of-other-input": (r"y, in_y = within\(parameters, \d+, 6, y\)", "y, in_y = within(parameters, 3, 5, y)"),
    "number": (r'"spring": np.array\(\[\n\s+-2.0, ', '"spring": np.array([-2.1, '),
}


@pytest.fixture
def problem(folder):
    x, v = np.linspace(-2, 2, 7), np.linspace(-3, 3, 6)
    np.savetxt(folder / "t.csv", np.stack([x, np.sinh(x)], 1), delimiter=",", header="x,f", comments="")
    rows = [(a, b, np.cos(a) * b**3 / 9 + a) for a in np.linspace(-2, 2, 5) for b in v]
    np.savetxt(folder / "g.csv", rows, delimiter=",", header="x,v,g", comments="")
    (folder / "tabled.py").write_text(_PROBLEM)
    return folder / "tabled.py"


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_look_up_is_not_written(problem, damage):
    program = transcribe.transcribe(load_problem(problem), None, None, "interval")
    text = build(problem).path.read_text()
    verify(program, text)
    pattern, replacement = DAMAGES[damage]
    damaged = re.sub(pattern, replacement, text, count=1)
    assert damaged != text
    with pytest.raises(VerificationError, match="of table"):
        verify(program, damaged)


def test_a_damaged_table_fails_its_check(prepared, damaged, problem):
    context = prepared(problem)
    assert all(finding.passed for finding in checks.apply("tables", context))
    failures = [
        finding
        for finding in checks.apply("tables", damaged(context, "-2.0, -1.33", "-2.0, -1.32"))
        if not finding.passed
    ]
    assert failures
    assert any(finding.subject.endswith(": numbers") for finding in failures)


def test_a_damaged_polynomial_fails_the_check_of_tables(prepared, problem, monkeypatch):
    """The polynomial of a cell is a function of the runtime."""
    context, text = prepared(problem), inspect.getsource(tabulated.cubic.py_func)
    damaged = text.replace("second + 3.0 * s * third", "second + 2.0 * s * third")
    assert damaged != text
    cells, curves = dict(vars(tabulated)), dict(vars(tabulated))
    exec(damaged, cells)
    curves["cubic"] = cells["cubic"]
    exec(inspect.getsource(tabulated.cubic_curve.py_func), curves)
    monkeypatch.setattr(context.module, "cubic_curve", curves["cubic_curve"])
    failures = [finding for finding in checks.apply("tables", context) if not finding.passed]
    assert any(finding.subject.endswith(": cubic") for finding in failures)
