"""The site's problem in several tools, whose programs find what its pages say; skipped where one is not installed."""

from __future__ import annotations

import re
import runpy

import pytest
from conftest import PROBLEMS
from interpreted import Interpreted

DOCS = PROBLEMS.parent / "docs"
EXAMPLES = DOCS / "_examples"
MIDPOINT, GAUSS, CONTINUOUS = 6.65692363, 6.65030208, 6.6473969
"""The least costs of three discrete problems."""
TOOLS = {
    "casadi": (MIDPOINT, 1e-8),
    "opty": (6.65701, 1e-5),
    "dymos": (CONTINUOUS, 2e-8),
    "bioptim": (GAUSS, 1e-8),
    "acados_template": (GAUSS, 1e-8),
}
"""What each tool finds, and how far it may be away: of its own discrete problem, or dymos of the continuous one."""
OWN = {
    "midpoint": ({}, None, MIDPOINT),
    "gauss-6": ({"scheme": "gauss-6"}, None, GAUSS),
    "gauss-6 with controls at stages": ({"scheme": "gauss-6", "controls": "stages"}, 50, CONTINUOUS),
}


@pytest.mark.parametrize("tool", TOOLS)
@pytest.mark.filterwarnings("default")
def test_the_program_for_a_tool(tool, tmp_path, monkeypatch):
    pytest.importorskip(tool)
    monkeypatch.chdir(tmp_path)
    found = runpy.run_path(str(EXAMPLES / f"swing_up_{tool.partition('_')[0]}.py"))
    value, allowed = TOOLS[tool]
    assert found["cost"] == pytest.approx(value, abs=allowed)


@pytest.mark.parametrize("case", OWN)
def test_the_program_for_this_tool(interpreted: Interpreted, case):
    choices, steps, cost = OWN[case]
    module = interpreted("swing_up", (EXAMPLES / "swing_up.py").read_text(), **choices)
    solution = module.solve() if steps is None else module.solve(steps=steps)
    assert solution.status == "solved"
    assert solution.cost == pytest.approx(cost, abs=1e-8)


def test_the_pages_state_these_values():
    table = (DOCS / "coming_from" / "index.md").read_text(encoding="utf-8")
    for tool, (value, allowed) in TOOLS.items():
        name = tool.partition("_")[0]
        (row,) = re.findall(rf"^\| \[.*\]\({name}\.md\) \|.*$", table, re.MULTILINE)
        stated = float(row.split("|")[3])
        assert stated == pytest.approx(value, abs=allowed)
        assert f"{stated}" in (DOCS / "coming_from" / f"{name}.md").read_text(encoding="utf-8")


def test_the_spline_of_bigwarp_folds_and_the_flow_does_not():
    found = runpy.run_path(str(EXAMPLES / "bigwarp_spline.py"))
    assert found["folded"] / 160**2 == pytest.approx(0.2, abs=0.02)  # "a fifth"
    assert abs(found["spline"](found["pairs"].fixed) - found["pairs"].moving).max() < 1e-9
    certificate = found["certificate"]
    assert certificate.folded == 0
    assert max(certificate.residual_max, certificate.round_trip) < 1e-9


def test_the_first_example_is_solved(interpreted: Interpreted):
    """With gravity carried by a constant part of the force: (m g)^2 + 12 (m H)^2 N^2/(N^2 - 1)."""
    solution = interpreted("lift", (EXAMPLES / "lift.py").read_text()).solve()
    m, g, H, N = 2, 9.81, 1, 50
    assert solution.cost == pytest.approx((m * g) ** 2 + 12 * (m * H) ** 2 * N**2 / (N**2 - 1), rel=1e-10)
