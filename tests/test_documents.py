"""The Python code of the README, of the cheat sheet and of the guide runs as it is written."""

from __future__ import annotations

import re
from pathlib import Path

import matplotlib.image
import pytest

ROOT = Path(__file__).parents[1]


def blocks(page: str) -> list[str]:
    """Return the Python code of a page."""
    return re.findall(r"^```python\n(.*?)^```$", (ROOT / page).read_text(encoding="utf-8"), re.DOTALL | re.MULTILINE)


def test_the_readme_swings_a_pendulum_up(capsys):
    (code,) = blocks("README.md")
    exec(code, {})
    promised = re.search(r"# solved ([\d.]+)\.\.\.", code)[1]
    assert capsys.readouterr().out.startswith(f"solved {promised}")


def test_the_cheat_sheet_moves_a_cart(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    problem, use = blocks("docs/cheat_sheet.md")
    (tmp_path / "cart.py").write_text(problem, encoding="utf-8")
    names = {}
    exec(use, names)
    assert names["solution"].status == "solved"
    # x = 3 t^2 - 2 t^3 without friction: u = m (6 - 12 t), and the cost is 12 m^2; friction adds 1.2 c^2.
    assert names["solution"].cost == pytest.approx(4 * 12 + 0.1**2 * 1.2, rel=1e-3)
    assert (tmp_path / "cart.pdf").stat().st_size > 0
    assert set(names["data"].status.values.ravel()) == {"solved"}
    assert abs(names["inputs"]).max() <= 20


def test_the_example_of_an_object_runs_as_it_stands(capsys):
    (block,) = blocks("docs/guide/python.md")
    given = {}
    exec(block, given)
    assert capsys.readouterr().out.startswith("solved ")
    solution, solver, data = given["solution"], given["solver"], given["data"]
    assert solver.check().passed
    assert data["cost"].sel(m=1.0).item() == pytest.approx(solver.solve().cost, rel=1e-12)
    assert (data["status"] == "solved").all()
    assert matplotlib.image.imread("swing_up.png").ndim == 3
    assert solution.to_frame().loc[2.0, "theta"] == pytest.approx(3.141592653589793)
    assert {name: tuple(own.dims) for name, own in solution.to_dataset().items() if name in "qu"} == {
        "q": ("node", "coordinate"), "u": ("interval", "control"),
    }  # fmt: skip
    finer = solution.differences(solver.solve(steps=200))
    assert 0 < finer["theta"] < 0.01  # of second order: 2/3 of the error at 100 steps
    assert "swing_up" in str(solver.source.path)
