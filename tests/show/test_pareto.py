"""Pareto fronts: which cases belong to one, what may be an objective, and what the figure shows."""

from __future__ import annotations

import numpy as np
import pytest
import xarray

from codegen.errors import ArgumentError
from codegen.show.figures import save_sweep
from codegen.show.figures.pareto import (
    Objective,
    is_dominated,
    objectives_of,
    pareto_figure,
    require_objectives,
    values_of,
)
from codegen.show.figures.picture import CRIMSON

ATTRIBUTES = {"title": "A test.", "formulation": "variational", "scheme": "midpoint", "steps": 4}
WEIGHTS = np.linspace(0.0, 1.0, 11)


def weighted(failed=()):
    """A sweep over a weight and an offset: cost and duration lie on a quarter of a circle, the offset adds to both."""
    weight, offset = np.meshgrid(WEIGHTS, [0.0, 0.5], indexing="ij")
    cost, duration = (2.0 - f(np.pi / 2 * weight) + offset for f in (np.cos, np.sin))
    status = np.full(cost.shape, "solved", object)
    for place in failed:
        status[place], cost[place], duration[place] = "infeasible", np.nan, np.nan
    dims = ("w", "k")
    t = duration[..., None] * np.linspace(0.0, 1.0, 5)
    return xarray.Dataset(
        {
            "status": (dims, status.astype(str)), "cost": (dims, cost), "seconds": (dims, cost),
            "mass": (dims, 3.0 - cost),
            "t": ((*dims, "node"), t), "q": ((*dims, "node", "coordinate"), np.stack([t, -t], axis=-1)),
            "d_cost": ((*dims, "by"), np.stack([cost, 2.0 * cost], axis=-1)),
        },
        {"w": WEIGHTS, "k": [0.0, 0.5], "coordinate": ["x", "y"], "by": ["m", "end.x"]}, ATTRIBUTES,
    )  # fmt: skip


def by_pairs(x, y):
    """The definition, pair by pair."""
    worse = (x[None] <= x[:, None]) & (y[None] <= y[:, None]) & ((x[None] < x[:, None]) | (y[None] < y[:, None]))
    return worse.any(axis=1)


@pytest.mark.parametrize("seed", range(5))
def test_what_is_dominated_is_so_by_some_case(seed):
    x, y = np.random.default_rng(seed).integers(0, 12, (2, 60)).astype(float)  # many are equal
    np.testing.assert_array_equal(is_dominated(x, y), by_pairs(x, y))


def test_nothing_dominates_what_is_nowhere():
    x, y = np.array([1.0, 2.0, np.nan, 0.0]), np.array([1.0, 2.0, 0.0, np.nan])
    np.testing.assert_array_equal(is_dominated(x, y), [False, True, False, False])
    assert not is_dominated(np.full(3, np.nan), np.zeros(3)).any()


def test_rounding_makes_no_front():
    """Values at a bound differ in last bits, which are no gain."""
    x, y = np.arange(5.0), 20.0 - 1e-9 * np.arange(5.0)
    y[4] = 3.0
    np.testing.assert_array_equal(is_dominated(x, y), [False, True, True, True, False])


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cost", lambda data: data.cost),
        ("mass", lambda data: 3.0 - data.cost),
        ("duration", lambda data: data.t[..., -1]),
        ("end.y", lambda data: -data.t[..., -1]),
        ("max.x", lambda data: data.t[..., -1]),
        ("min.x", lambda data: 0.0 * data.cost),
        ("w", lambda data: data.w.broadcast_like(data.cost)),
        ("d_cost.end.x", lambda data: 2.0 * data.cost),
    ],
)
def test_objectives(name, expected):
    data = weighted()
    require_objectives((Objective(name, is_large=False),), data)
    np.testing.assert_allclose(values_of(Objective(name, is_large=False), data), expected(data))


@pytest.mark.parametrize("text", ["cost", "cost,", "cost,duration,mass", "cost,cost", "-,cost", ""])
def test_a_front_has_two_objectives(text):
    with pytest.raises(ArgumentError, match="two objectives"):
        objectives_of(text)


@pytest.mark.parametrize("name", ["costs", "seconds", "end.z", "d_cost.GM"])
def test_unknown_objectives_are_named_beside_those_that_are_there(name):
    with pytest.raises(ArgumentError, match=f"--pareto {name}: .*it has cost, mass"):
        require_objectives((Objective(name, is_large=False),), weighted())


def lines(figure):
    return {line.get_label(): line.get_xydata() for line in figure.axes[0].lines}


def test_the_front_is_the_quarter_of_a_circle_and_the_rest_is_lighter():
    data = weighted(failed=[(5, 0)])
    figure = pareto_figure(data, objectives_of("cost,duration"))
    shown = lines(figure)
    expected = np.c_[2.0 - np.cos(np.pi / 2 * WEIGHTS), 2.0 - np.sin(np.pi / 2 * WEIGHTS)]
    front = next(line.get_xydata() for line in figure.axes[0].lines if len(line.get_xydata()) == 10)
    np.testing.assert_allclose(front, np.delete(expected, 5, axis=0))
    assert len(shown["dominated"]) == 11
    assert figure.axes[0].lines[0].get_alpha() < 0.5
    # The failed case has neither objective, and is told and not drawn.
    assert len(shown["1 failed: no objectives"]) == 0
    assert sum(line.get_color() == CRIMSON and len(line.get_xdata()) > 0 for line in figure.axes[0].lines) == 0
    assert "1 FAILED" in figure.get_suptitle()


@pytest.mark.parametrize(
    ("text", "expected"), [("w,cost", [[0.5, 0.02]]), ("cost,w", [[0.02, 0.5]]), ("w,k", [[0.5, 0.0]])]
)
def test_failed_cases_stand_at_the_edge_by_what_varies(text, expected):
    axes = pareto_figure(weighted(failed=[(5, 0)]), objectives_of(text)).axes[0]
    (failed,) = (line for line in axes.lines if line.get_color() == CRIMSON and len(line.get_xdata()))
    np.testing.assert_allclose(failed.get_xydata(), expected)
    x, y = failed.get_transform().transform(failed.get_xydata())[0]
    inside = axes.transData.transform((0.5, 0.5)) if text != "w,k" else (x, y)
    assert (x == pytest.approx(inside[0])) or (y == pytest.approx(inside[1]))


def test_what_is_to_be_large():
    data = weighted()
    figure = pareto_figure(data, objectives_of("duration,-mass"))
    front = next(line.get_xydata() for line in figure.axes[0].lines if line.get_linestyle() == "-")
    np.testing.assert_allclose(front[:, 1], 3.0 - data.cost.values[::-1, 0])
    assert figure.axes[0].get_ylabel().endswith("(larger is better)")


@pytest.mark.parametrize("text", ["cost,duration", "w,cost", "w,k"])
def test_pictures(tmp_path, text):
    for failed in ([], [(2, 1), (3, 0)], list(np.ndindex(11, 2))):
        save_sweep(weighted(failed), tmp_path / "front.png", text)
        assert (tmp_path / "front.png").stat().st_size > 1000
