"""The published climb in least time: its tables are those of its model, its optimum that of another program."""

from __future__ import annotations

from pathlib import Path

import f4_model
import pytest
from interpreted import without_compilation

from codegen.solving.compiler import build

CLIMB = Path(__file__).parents[2] / "problems" / "published" / "time_to_climb.py"


@pytest.mark.parametrize("name", f4_model.tables())
def test_tables_of_the_climb_are_those_of_its_model(name):
    assert (f4_model.FOLDER / name).read_text() == f4_model.text_of(name)


def test_least_time_to_climb(tmp_path):
    """The optimum of the same program, with CasADi's B-splines, by IPOPT (tests/benchmarks/tables.py)."""
    solution = without_compilation(build(CLIMB, out=tmp_path).path.read_text()).solve(50)
    assert solution.status == "solved", solution.message
    assert solution.cost == pytest.approx(324.424392852084, rel=1e-8)
