"""The site's example of a problem in Python, as it stands there."""

import re

import matplotlib.image
import pytest
from conftest import PROBLEMS

PAGE = PROBLEMS.parent / "docs" / "guide" / "python.md"


def test_the_example_of_an_object_runs_as_it_stands(capsys):
    (block,) = re.findall(r"^```python\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    given: dict = {}
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
