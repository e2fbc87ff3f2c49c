"""The gallery of control problems against optima by CasADi and IPOPT, published values and closed forms."""

from __future__ import annotations

from pathlib import Path

import pytest
from gallery_references import REFERENCES, Reference

from codegen import drivers
from codegen.compiler import build
from codegen.load import load

PROBLEMS = Path(__file__).parents[1] / "problems"


def _name(reference: Reference) -> str:
    return "-".join([reference.problem, *(f"{k}={v}" for k, v in reference.arguments.items())])


def _module(reference: Reference):
    built = build(PROBLEMS / f"{reference.problem}.py", dict(reference.arguments), scheme=reference.scheme)
    return load(built.path)


@pytest.mark.parametrize("reference", REFERENCES, ids=_name)
def test_optimum(reference):
    module = _module(reference)
    for steps, optimum in reference.optima.items():
        result = drivers.solve(module, driver="newton", steps=steps)
        assert result.status == "solved", result.message
        assert result.cost == pytest.approx(optimum, rel=2e-8, abs=1e-9)
    assert result.cost == pytest.approx(reference.value, abs=reference.error)
