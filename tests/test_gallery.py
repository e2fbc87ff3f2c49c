"""The gallery of control problems against optima by CasADi and IPOPT, published values and closed forms."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

import codegen
from codegen import drivers
from gallery_references import REFERENCES, Reference

PROBLEMS = Path(__file__).parents[1] / "problems"


def _name(reference: Reference) -> str:
    return "-".join([reference.problem, *(f"{k}={v}" for k, v in reference.arguments.items())])


@cache
def _module(reference: Reference):
    built = codegen.build(PROBLEMS / f"{reference.problem}.py", dict(reference.arguments), scheme=reference.scheme)
    return codegen.load(built.path)


@pytest.mark.parametrize("reference", REFERENCES, ids=_name)
def test_optimum(reference):
    for steps, optimum in reference.optima.items():
        result = drivers.solve(_module(reference), driver="newton", steps=steps)
        assert result.status == "solved", result.message
        assert result.cost == pytest.approx(optimum, rel=2e-8, abs=1e-9)
    assert result.cost == pytest.approx(reference.value, abs=reference.error)
