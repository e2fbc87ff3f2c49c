"""The site's problem in several tools, whose programs find the same; skipped where a tool is not installed."""

from __future__ import annotations

import runpy

import pytest
from conftest import PROBLEMS
from interpreted import Interpreted

EXAMPLES = PROBLEMS.parent / "docs" / "_examples"
STATED = 6.65692363
"""As docs/coming_from.md says."""


@pytest.mark.parametrize(
    ("tool", "cost", "error"),
    [
        ("casadi", STATED, 1e-8),  # the same discrete problem
        ("opty", 6.65701, 1e-5),  # controls at nodes
    ],
)
def test_the_program_for_another_tool(tool, cost, error, tmp_path, monkeypatch):
    pytest.importorskip(tool)
    monkeypatch.chdir(tmp_path)
    assert runpy.run_path(str(EXAMPLES / f"swing_up_{tool}.py"))["cost"] == pytest.approx(cost, abs=error)


def test_the_program_for_this_tool(interpreted: Interpreted):
    solution = interpreted("swing_up", (EXAMPLES / "swing_up.py").read_text()).solve()
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(STATED, abs=1e-8)


def test_the_first_example_is_solved(interpreted: Interpreted):
    """With gravity carried by a constant part of the force: (m g)^2 + 12 (m H)^2 N^2/(N^2 - 1)."""
    solution = interpreted("lift", (EXAMPLES / "lift.py").read_text()).solve()
    m, g, H, N = 2, 9.81, 1, 50
    assert solution.cost == pytest.approx((m * g) ** 2 + 12 * (m * H) ** 2 * N**2 / (N**2 - 1), rel=1e-10)
