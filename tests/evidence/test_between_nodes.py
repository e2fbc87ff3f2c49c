"""Conditions on states that hold at nodes, and motions that make use of it between them."""

from pathlib import Path

import pytest

from codegen.discretise import schemes
from codegen.evidence import checks

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


SHORT = [s for s in schemes.of_method(schemes.FIRST_ORDER) if len(s.parts) <= 6 and not s.adaptive]


@pytest.mark.parametrize("scheme", [s.name for s in SHORT if not s.step().is_explicit])
def test_bounds_hold_where_implicit_schemes_evaluate(prepared, tmp_path, scheme):
    (finding,) = findings(prepared, tmp_path, "bounds={x: (0.5, None)}", scheme=scheme)
    assert finding.passed
    assert finding.detail.startswith("it holds, or follows from both nodes")


def test_bounds_hold_at_nodes_of_explicit_schemes(prepared, tmp_path):
    (finding,) = findings(prepared, tmp_path, "bounds={x: (0.5, None)}", scheme="rk4")
    assert finding.passed
    assert "violated between them" in finding.detail


WALLED = '''"""From one side of a wall to the other at least effort, on a grid on which it lies between two nodes."""

from codegen import Control, controls, states


def problem(thickness: float = 0.02) -> Control:
    x, y = states("x y")
    u, w = controls("u w")
    return Control(
        dynamics={x: u, y: w},
        cost=u**2 + w**2,
        duration=1,
        start={x: -1, y: 0},
        end={x: 1, y: 0},
        path=[(2 * x / thickness) ** 2 + y**2 >= 1],
        steps=9,
    )
'''


@pytest.mark.parametrize(("thickness", "passes"), [("0.02", False), ("2", True)])
def test_motions_through_a_wall_fail(prepared, tmp_path, thickness, passes):
    path = tmp_path / "walled.py"
    path.write_text(WALLED, encoding="utf-8")
    context = prepared(path, {"thickness": thickness})
    assert context.solution.status == "solved"
    (finding,) = checks.apply("path between nodes", context)
    assert finding.passed == passes
    told = "the motion violates it by" if passes else "between nodes the motion violates"
    assert told in finding.detail
    assert " % of the size of its terms" in finding.detail


def test_a_holonomic_constraint_is_sampled(prepared):
    """Chords of a sphere: the problem's own grid shows next to nothing."""
    (finding,) = checks.apply("path between nodes", prepared("spherical_pendulum"))
    assert finding.passed
    assert finding.subject == "x**2 + y**2 + z**2 - 1"
    assert "it holds at nodes; sampled inside intervals, the motion violates it by" in finding.detail
