"""What slopes of one case predict of samples: exact where the cost is linear; and in the figure."""

from __future__ import annotations

import numpy as np
import pytest
import xarray

from codegen.show.figures.sweep import NORMAL_90, prediction, sweep_figure

NUMBER = 4000
SLOPES = {"m": 2.0, "k": -3.0}


def sampled(origin="4000 random samples, seed 0", mixed=0.0, bent=0.0):
    """Samples of a cost that is linear in m and k, but for a bend; k follows m by a part."""
    rng = np.random.default_rng(0)
    m = rng.normal(5.0, 0.1, NUMBER)
    k = 1.0 + rng.uniform(-0.2, 0.2, NUMBER) + mixed * (m - 5.0)
    cost = 7.0 + SLOPES["m"] * m + SLOPES["k"] * k + bent * (m - 5.0) ** 2
    t = np.broadcast_to(np.linspace(0.0, 1.0, 5), (NUMBER, 5))
    slopes = np.stack([np.zeros(NUMBER), SLOPES["m"] + 2.0 * bent * (m - 5.0), np.full(NUMBER, SLOPES["k"])], axis=-1)
    return xarray.Dataset(
        {
            "status": ("case", np.full(NUMBER, "solved")), "cost": ("case", cost), "d_cost": (("case", "by"), slopes),
            "t": (("case", "node"), t), "q": (("case", "node", "coordinate"), (cost[:, None] * t)[..., None]),
            "d_q": (("case", "by", "node", "coordinate"), (slopes[..., None] * t[:, None])[..., None]),
        },
        {"m": ("case", m), "k": ("case", k), "by": ["start.r", "m", "k"], "coordinate": ["r"]},
        {"title": "A test.", "formulation": "variational", "scheme": "midpoint", "cases": origin},
    )  # fmt: skip


def test_independent_deviations_add_up_by_squares():
    data = sampled()
    mean, deviation = prediction(data, ["m", "k"]).of(data, "cost")
    assert mean == pytest.approx(float(data.cost.mean()), rel=1e-12)
    parts = [SLOPES[name] * float(data[name].std()) for name in SLOPES]
    assert deviation == pytest.approx(np.hypot(*parts), rel=1e-12)
    assert deviation == pytest.approx(np.hypot(2.0 * 0.1, 3.0 * 0.2 / np.sqrt(3.0)), rel=0.03)
    assert deviation == pytest.approx(float(data.cost.std()), rel=0.03)


def test_columns_of_a_table_that_follow_each_other_count_with_their_covariance():
    """The cost is linear, so that the deviation of its samples is what has to come out."""
    data = sampled("table", mixed=0.9)
    _, deviation = prediction(data, ["m", "k"]).of(data, "cost")
    assert deviation == pytest.approx(float(data.cost.std()), rel=1e-12)


def test_the_case_is_the_nearest_to_the_mean_and_trajectories_follow():
    data = sampled(bent=40.0)
    found = prediction(data, ["m", "k"])
    assert abs(float(data.m[found.centre]) - 5.0) < 0.02
    mean, deviation = found.of(data, "q")
    assert mean.shape == deviation.shape == (5, 1)
    of_cost = prediction(data, ["m", "k"]).of(data, "cost")
    np.testing.assert_allclose(mean[-1], of_cost[0], rtol=1e-12)
    np.testing.assert_allclose(deviation[:, 0], of_cost[1] * np.linspace(0.0, 1.0, 5), rtol=1e-12)


def test_without_derivatives_by_all_that_varies_nothing_is_predicted():
    data = sampled()
    assert prediction(data.drop_vars(["d_cost", "d_q"]), ["m", "k"]) is None
    assert prediction(data.assign_coords(c=("case", np.arange(NUMBER, dtype=float))), ["m", "k", "c"]) is None
    assert prediction(data.assign(d_cost=np.nan * data.d_cost), ["m", "k"]) is None
    assert prediction(data, []) is None


def test_the_figure_has_the_prediction_beside_the_samples():
    data = sampled()
    figure = sweep_figure(data)
    mean, deviation = prediction(data, ["m", "k"]).of(data, "cost")
    labels = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert f"first order: {mean:.4g} ± {deviation:.2g}" in labels
    assert f"samples: {float(data.cost.mean()):.4g} ± {float(data.cost.std()):.2g}" in labels
    curve = next(line for line in figure.axes[0].lines if len(line.get_xdata()) == 200)
    x, density = curve.get_data()
    bars = figure.axes[0].patches
    area = sum(bar.get_height() for bar in bars) * bars[0].get_width()
    assert np.trapezoid(density, x) == pytest.approx(area, rel=0.02)
    fan = next(axes for axes in figure.axes if axes.get_ylabel() == "$r$")
    edges = [line.get_ydata()[-1] for line in fan.lines if line.get_linestyle() == "--"]
    np.testing.assert_allclose(edges, [mean - NORMAL_90 * deviation, mean + NORMAL_90 * deviation])
    assert not [
        line for line in sweep_figure(data.drop_vars(["d_cost", "d_q"])).axes[0].lines if len(line.get_xdata()) == 200
    ]
