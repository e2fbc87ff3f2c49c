"""Conditions on states that hold at nodes, and motions that make use of it between them."""

from pathlib import Path

import pytest

from codegen import checks

RESTING = '''"""Outside a circle, or on it, at least cost: to rest at (1, 0) is best, and costs 100."""

from sympy import Eq

from codegen import Control, controls, states


def problem() -> Control:
    x, y = states("x y")
    u, w = controls("u w")
    return Control(
        dynamics={x: u, y: w},
        cost=100 * (x**2 + y**2) + (u**2 + w**2) / 100,
        duration=1,
        start={x: 1, y: 0},
        end={x: 1, y: 0},
        CONDITION,
        steps=10,
    )
'''


def findings(prepared, folder: Path, condition: str, **choices: str):
    path = folder / "resting.py"
    path.write_text(RESTING.replace("CONDITION", condition), encoding="utf-8")
    return checks.apply("path between nodes", prepared(path, {}, **choices))


@pytest.mark.parametrize("scheme", ["midpoint", "trapezoidal", "gauss-4", "hermite-simpson"])
def test_inequalities_hold_where_the_scheme_evaluates(prepared, tmp_path, scheme):
    (finding,) = findings(prepared, tmp_path, "path=[x**2 + y**2 >= 1]", scheme=scheme)
    assert finding.passed
    assert finding.detail.startswith("it holds, or follows from both nodes")


def test_a_sawtooth_along_a_curve_is_found(prepared, tmp_path):
    """An equality holds at nodes only: between (1, 0) and (-1, 0) the middle is the centre, where nothing costs."""
    (finding,) = findings(prepared, tmp_path, "path=[Eq(x**2 + y**2, 1)]")
    assert not finding.passed
    assert "does not fall with the interval" in finding.detail
    assert "a false optimum" in finding.detail


def test_the_trapezoidal_rule_sees_nodes(prepared, tmp_path):
    (finding,) = findings(prepared, tmp_path, "path=[Eq(x**2 + y**2, 1)]", scheme="trapezoidal")
    assert finding.passed


@pytest.mark.parametrize(("scheme", "told"), [("midpoint", "follows from both"), ("gauss-4", "violated between them")])
def test_bounds(prepared, tmp_path, scheme, told):
    (finding,) = findings(prepared, tmp_path, "bounds={x: (0.5, None)}", scheme=scheme)
    assert finding.passed
    assert told in finding.detail
