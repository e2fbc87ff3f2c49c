"""The figure of a fit: measurements as points, errors, and the band in which the motion is."""

from __future__ import annotations

import numpy as np
import pytest
from measured_decay import TIMES, VALUES, interpreted, write, write_decay

import codegen
from codegen.show import figures


def axes_of(figure, label):
    return next(axes for axes in figure.axes if axes.get_ylabel() == label)


def test_points_errors_and_band(folder):
    module = interpreted(write_decay(folder, t=TIMES, z=np.where(TIMES == 0.9, np.nan, VALUES)), scheme="gauss-4")
    result = codegen.solve(module)
    figure = figures.control_figure(module, result)
    state, errors = axes_of(figure, "$x$"), axes_of(figure, "z")
    points = next(
        line for line in state.lines if line.get_linestyle() == "None" and len(line.get_xdata()) == TIMES.size
    )
    assert points.get_xdata() == pytest.approx(TIMES)
    assert points.get_ydata() == pytest.approx(np.where(TIMES == 0.9, np.nan, VALUES), nan_ok=True)
    left = next(line for line in errors.lines if line.get_linestyle() == "None")
    exact = result.summary["x_0"] * np.exp(-result.summary["k"] * TIMES) - VALUES
    assert left.get_ydata() == pytest.approx(np.delete(exact, 5), abs=1e-5)
    (band,) = state.collections
    corners = band.get_paths()[0].vertices
    half = result.estimates.quantile * result.estimates.standard_errors[1]
    at_start = corners[np.abs(corners[:, 0]) < 1e-12, 1]
    assert np.ptp(at_start) == pytest.approx(2 * half, rel=1e-6)


_SQUARED = '''"""Two decays of which the square was measured."""

from codegen import Control, Measurements, each_body, free_parameter, states


def problem() -> Control:
    (x,) = states("x")
    k = free_parameter("k", 1)
    return Control(
        dynamics={x: -k * x},
        observations=[Measurements("m.csv", values={x**2: "z"}, sigma=0.1)] * 2,
        duration=3,
        start={x: each_body(1, 1.1)},
        bodies=2,
        steps=12,
    )
'''


def test_of_an_expression_and_several_bodies(folder):
    write(folder, "m.csv", t=TIMES, z=np.exp(-1.6 * TIMES))
    (folder / "squared.py").write_text(_SQUARED)
    module = interpreted(folder / "squared.py", scheme="gauss-4")
    figure = figures.control_figure(module, codegen.solve(module))
    labels = [axes.get_ylabel() for axes in figure.axes]
    assert "z" in " ".join(labels)
    assert "z, by $\\sigma$" in labels
    fitted = axes_of(figure, figures.label("z"))
    assert len([line for line in fitted.lines if line.get_linestyle() == "-"]) == 2
