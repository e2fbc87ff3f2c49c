"""The site's problem in several tools, whose programs find the same; skipped where a tool is not installed."""

from __future__ import annotations

import runpy

import pytest
from conftest import PROBLEMS
from interpreted import Interpreted

EXAMPLES = PROBLEMS.parent / "docs" / "_examples"
STATED = 6.65692363
"""As docs/coming_from.md says."""


def test_the_program_for_casadi(tmp_path, monkeypatch):
    """The same discrete problem; that for opty compiles for long, and is run by hand."""
    pytest.importorskip("casadi")
    monkeypatch.chdir(tmp_path)
    found = runpy.run_path(str(EXAMPLES / "swing_up_casadi.py"))
    assert found["cost"] == pytest.approx(STATED, abs=1e-8)


def test_the_program_for_this_tool(interpreted: Interpreted):
    solution = interpreted("swing_up", (EXAMPLES / "swing_up.py").read_text()).solve()
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(STATED, abs=1e-8)


def test_the_first_example_is_solved(interpreted: Interpreted):
    """With gravity carried by a constant part of the force: (m g)^2 + 12 (m H)^2 N^2/(N^2 - 1)."""
    solution = interpreted("lift", (EXAMPLES / "lift.py").read_text()).solve()
    m, g, H, N = 2, 9.81, 1, 50
    assert solution.cost == pytest.approx((m * g) ** 2 + 12 * (m * H) ** 2 * N**2 / (N**2 - 1), rel=1e-10)
