"""Accuracy on request against closed forms: the true error is below what is asked for and what is claimed."""

from __future__ import annotations

import json

import numpy as np
import pytest
from compiled_modules import compiled
from conftest import PROBLEMS

from codegen.errors import ArgumentError
from codegen.solving import api
from codegen.solving.accuracy import bisected, equal, refined
from codegen.solving.arcs import Gap
from codegen.solving.compiler import build
from codegen.solving.results import output


@pytest.fixture(scope="module")
def effort(cache_folder):
    return compiled(build(PROBLEMS / "double_integrator_effort.py").path)


@pytest.fixture(scope="module")
def fastest(interpreted):
    return interpreted("double_integrator")


@pytest.fixture(scope="module")
def layer(interpreted):
    return interpreted("hypersensitive", arguments={"duration": 1000})


@pytest.mark.parametrize("request_", [1e-3, 1e-5])
def test_states_and_cost_are_as_accurate_as_asked(effort, request_):
    # x = 3 t^2 - 2 t^3 from rest to rest; the integral of u^2 is 12.
    result = api.solve(effort, steps=10, accuracy=request_)
    assert result.status == "solved"
    found = result.accuracy
    assert found.estimate <= request_
    assert found.reason == ""
    errors = abs(result.cost - 12.0) / 12.0, np.abs(result.q[:, 0] - (3.0 * result.t**2 - 2.0 * result.t**3)).max()
    assert max(errors) <= request_
    assert max(errors) <= found.estimate


def test_layers_get_the_short_intervals(layer):
    # The closed form of the problem's file for long times.
    result = api.solve(layer, steps=50, accuracy=1e-4)
    exact = (np.sqrt(2.0) * (1.5**2 + 1.0) + 1.0 - 1.5**2) / 2.0
    assert result.status == "solved"
    assert abs(result.cost - exact) <= 1e-4 * exact
    lengths = np.diff(result.t)
    assert max(lengths[0], lengths[-1]) < 0.02 * lengths.max()
    # With equal intervals the error of the cost is h^2/2 times a number near one: h = 0.014 takes 70000 of them.
    assert result.t.size < 7000


def test_a_switch_is_closed_in_upon(fastest):
    # T = 2, and the control switches at half time, which no node of the first grid is.
    result = api.solve(fastest, steps=7, accuracy=1e-5)
    assert result.status == "solved"
    assert result.t[-1] == pytest.approx(2.0, rel=1e-5)
    inside = np.argmin(np.abs(0.5 * (result.t[1:] + result.t[:-1]) - 1.0))
    assert np.diff(result.t)[inside] < 1e-2


def test_what_cannot_be_reached_is_not_claimed(effort):
    result = api.solve(effort, steps=10, accuracy=1e-15, time_limit=5.0)
    assert result.status == "accuracy not reached"
    assert result.accuracy.estimate > 1e-15
    assert "not reached" in result.message
    assert result.accuracy.reason
    assert abs(result.cost - 12.0) / 12.0 < 1e-3


def test_the_history_is_in_the_record(effort):
    result = api.solve(effort, steps=10, accuracy=1e-3)
    record = json.loads(output.as_json(output.as_record(result, 0.0, 0.0)))["accuracy"]
    assert record["reached"] is True
    assert record["request"] == 1e-3
    assert [level["intervals"] for level in record["history"]] == [level.intervals for level in result.accuracy.levels]
    assert record["t"] == pytest.approx(result.t.tolist())


def test_accuracy_and_doublings_exclude_each_other(effort):
    with pytest.raises(ArgumentError, match="--accuracy beside --doublings"):
        api.solve(effort, accuracy=1e-3, doublings=1)
    with pytest.raises(ArgumentError, match="between 0 and 1"):
        api.solve(effort, accuracy=0.0)


def test_errors_of_equal_size_are_distributed():
    """For errors h^3 c with c = 1 and 64 on two halves lengths go like 1 : 1/4."""
    grid = equal(1, 40)
    errors = np.where(np.arange(40) < 20, 1.0, 64.0)[None] * grid**3
    found = refined(grid, errors, 2, 1.0, (10.0, 1e6), [])
    places = np.cumsum(found[0])
    first = found[0][places < 0.2].mean()
    last = found[0][places > 0.6].mean()
    assert first / last == pytest.approx(4.0, rel=0.05)


def test_gaps_are_cut_and_neighbours_are_graded():
    found = refined(equal(1, 20), np.full((1, 20), 1e-6), 2, 1.0, (10.0, 100.0), [Gap(0, 0.5, 0.52)])[0]
    middles = np.cumsum(found) - found / 2.0
    inside = found[(middles > 0.5) & (middles < 0.52)]
    assert inside.max() <= 0.02 / 6.0
    assert (np.abs(np.diff(found)) <= 0.7 * 0.5 * (found[1:] + found[:-1]) + 1e-12).mean() > 0.9


def test_bisected_grids_keep_their_nodes():
    grid = np.array([[0.1, 0.9], [0.5, 0.5]])
    np.testing.assert_allclose(np.cumsum(bisected(grid), axis=1)[:, 1::2], np.cumsum(grid, axis=1))
