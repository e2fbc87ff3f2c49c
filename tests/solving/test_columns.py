"""Columns of a result by name, its short text, and the names of parameter overrides."""

from __future__ import annotations

import copy
import pickle

import numpy as np
import pytest
from test_other_values import pushed

import codegen
from codegen.errors import ArgumentError

pytestmark = pytest.mark.usefixtures("uncompiled")


@pytest.fixture
def push(uncompiled):
    return codegen.compile(pushed(), name="push")


def test_columns_by_name(push):
    result = push.solve(steps=10)
    t = result.t
    # The optimum by the midpoint rule: forces on a line, positions on a discrete cubic with x(1/2) = 1/2.
    assert np.array_equal(result["x"], result.q[:, 0])
    assert np.interp(0.5, t, result["x"]) == pytest.approx(0.5)
    assert result["f"].shape == result.control_times.shape
    assert np.polyfit(result.control_times, result["f"], 1, full=True)[1] == pytest.approx(0.0, abs=1e-18)
    assert np.array_equal(result.p_x, result.p[:, 0])
    assert {"x", "p_x", "f", "cost", "solved"} <= set(dir(result))
    assert result._ipython_key_completions_() == ["x", "p_x", "f"]


def test_unknown_columns_are_refused(push):
    result = push.solve(steps=10)
    with pytest.raises(ArgumentError, match=r"the result of push has no column 'p_y'; did you mean p_x\?"):
        result["p_y"]
    with pytest.raises(ArgumentError, match=r'duration is one number, and no column; write summary\["duration"\]'):
        result["duration"]
    with pytest.raises(ArgumentError, match="no column 'theta'; use one of x, p_x, f"):
        result["theta"]
    with pytest.raises(ArgumentError, match="no column 'dx', because it has momenta in place of velocities; use p_x"):
        result["dx"]
    with pytest.raises(AttributeError, match="'Result' object has no attribute 'theta'"):
        result.theta  # noqa: B018
    assert not hasattr(result, "_repr_png_")


def test_fields_take_precedence_over_columns():
    t, dt = codegen.coordinate("cost")
    motion = codegen.solve(codegen.Simulate(lagrangian=dt**2 / 2 + t, start={t: 0, dt: 0}, duration=1, steps=10))
    assert motion.cost is None
    assert motion["cost"][-1] == pytest.approx(0.5)


def test_results_are_copied_and_pickled(push):
    result = push.solve(steps=10)
    assert copy.copy(result) == result == pickle.loads(pickle.dumps(result))


def test_a_result_has_a_short_text(push):
    result = push.solve(steps=10)
    assert repr(result) == f"Result('push', 'solved', cost={result.cost:.6g}, steps=10, iterations={result.iterations})"


def test_names_of_parameter_overrides(push):
    ends = dict.fromkeys(("duration", "start.x", "start.dx", "end.x", "end.dx"))
    assert push.parameters == {"m": 1.0, **ends}
    for name in push.parameters:
        assert push.solve(parameters={name: 1.0}).parameters == {name: 1.0}
