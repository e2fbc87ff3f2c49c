"""Pictures: what is in them, for every kind of result."""

from __future__ import annotations

import numpy as np
import pytest

from codegen import drivers, plots


@pytest.mark.parametrize(
    ("name", "label"),
    [
        ("r", "$r$"),
        ("phi", r"$\phi$"),
        ("p_phi", r"$p_{\phi}$"),
        ("theta2", r"$\theta_{2}$"),
        ("p_theta2", r"$p_{\theta,2}$"),
        ("force", r"$\mathrm{force}$"),
        ("x_left", r"$x_{\mathrm{left}}$"),
    ],
)
def test_labels(name, label):
    assert plots.label(name) == label


def texts(figure):
    return {axes.get_ylabel() for axes in figure.axes} | {figure.get_suptitle()}


def test_control(orbital_transfer):
    result = drivers.solve(orbital_transfer, steps=20)
    figure = plots.control_figure(result)
    assert {"$r$", r"$\phi$", "$p_{r}$", r"$p_{\phi}$", "$u$"} <= texts(figure)
    assert "20 steps" in figure.get_suptitle()
    assert "Transfer a satellite" in figure.get_suptitle()
    orbit = next(axes for axes in figure.axes if axes.name == "polar")
    radii = [line.get_ydata() for line in orbit.lines[:2]]
    np.testing.assert_allclose([radii[0].max(), radii[1].min()], [5.0, 6.0])


def test_failure_is_named(orbital_transfer):
    result = drivers.solve(orbital_transfer, steps=1)
    assert f"NOT SOLVED: {result.status}" in plots.control_figure(result).get_suptitle()


def test_simulation(pendulum):
    result = drivers.solve(pendulum, steps=200)
    figure = plots.simulation_figure(result)
    portrait, energy = figure.axes
    assert (portrait.get_xlabel(), portrait.get_ylabel()) == ("$q$", "$p$")
    np.testing.assert_array_equal(portrait.lines[0].get_xdata(), result.q[:, 0])
    np.testing.assert_allclose(np.abs(energy.lines[0].get_ydata()).max(), result.summary["energy_drift"])


def test_long_paths_are_thinned(explicit_pendulum):
    result = drivers.solve(explicit_pendulum, steps=100_000)
    assert plots.simulation_figure(result).axes[0].lines[0].get_xdata().size <= 20_001
