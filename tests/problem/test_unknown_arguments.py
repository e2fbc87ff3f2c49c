"""Arguments that a Simulate or a Control does not have: what is said of them."""

from __future__ import annotations

import copy
import inspect
import pickle
from dataclasses import replace

import pytest

import codegen
from codegen.errors import ProblemFileError

x, dx = codegen.coordinate("x")
FREE = {"lagrangian": dx**2 / 2, "duration": 1}


@pytest.mark.parametrize(
    ("kind", "unknown", "message"),
    [
        (
            codegen.Simulate,
            "cost",
            "Simulate(...) has no argument 'cost'; a simulation follows the motion from",
        ),
        (codegen.Simulate, "step", "Simulate(...) has no argument 'step'; perhaps it is steps"),
        (codegen.Control, "bound", "Control(...) has no argument 'bound'; perhaps it is bounds"),
        (codegen.Control, "zzz", "Control(...) has no argument 'zzz'; use one of lagrangian, hamiltonian, dynamics,"),
    ],
)
def test_an_unknown_argument_is_refused_with_a_remedy(kind, unknown, message):
    with pytest.raises(ProblemFileError) as refused:
        kind(**FREE, **{unknown: 1})
    assert message in str(refused.value)


def test_problems_are_made_copied_and_described_as_before():
    problem = codegen.Simulate(**FREE, start={x: 0, dx: 1})
    assert "duration" in inspect.signature(codegen.Simulate).parameters
    assert pickle.loads(pickle.dumps(problem)) == problem == copy.copy(problem)
    assert replace(problem, steps=7).steps == 7
    with pytest.raises(ProblemFileError, match="lacks 'duration'"):
        codegen.Control(lagrangian=dx**2)
