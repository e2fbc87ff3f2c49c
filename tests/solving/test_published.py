"""The published problems: each has a reference and loads, and those that are quickly solved meet what is published."""

from __future__ import annotations

import pytest
from conftest import PROBLEMS
from interpreted import Interpreted
from published_references import PUBLISHED, Published

from codegen.discretise.model.from_problem import load_problem

FOLDER = PROBLEMS / "published"
QUICK = ("hull", "time_in_dynamics", "interior_point")


def test_every_problem_has_a_reference():
    assert {reference.problem for reference in PUBLISHED} == {path.stem for path in FOLDER.glob("*.py")}


@pytest.mark.parametrize("reference", PUBLISHED, ids=lambda reference: reference.title)
def test_problem_loads(reference: Published):
    assert load_problem(FOLDER / f"{reference.problem}.py", dict(reference.arguments))


@pytest.mark.parametrize("name", QUICK)
def test_published_value(interpreted: Interpreted, name: str):
    (reference,) = (reference for reference in PUBLISHED if reference.problem == name)
    solution = interpreted(f"published/{name}").solve()
    assert solution.status == "solved", solution.message
    assert reference.error(solution.cost) <= reference.tolerance
