"""The bars of a solution's sensitivities: changes by one percent, in order, and the panel in the figure."""

from __future__ import annotations

import numpy as np
import pytest

import codegen
from codegen.show import figures
from codegen.show.figures.control import MOST, changes, tornado
from codegen.solving.results.result import Sensitivities
from codegen.solving.results.sensitivities import quantity_values


@pytest.fixture
def effort(interpreted):
    """The least effort is in proportion to x^2/T^3."""
    module = interpreted("double_integrator_effort", sensitivities=True)
    with np.errstate(all="ignore"):  # as in compiled code
        return module, codegen.solve(module, steps=10, sensitivities=True)


def test_changes_in_closed_form(effort):
    module, result = effort
    values = quantity_values(module, result)
    shown = changes(result.sensitivities(), values)
    assert shown["end.x"] == pytest.approx(0.02 * result.cost, rel=1e-9)
    assert shown["duration"] == pytest.approx(-0.03 * result.cost, rel=1e-9)
    assert list(map(abs, shown.values())) == sorted(map(abs, shown.values()), reverse=True)
    assert "start.x" not in shown  # which is zero


def test_the_figure_has_a_panel_of_bars_to_both_sides(effort):
    module, result = effort
    figure = figures.control_figure(module, result)
    axes = next(axes for axes in figure.axes if axes.get_xlabel().startswith("change of the cost"))
    shown = changes(result.sensitivities(), quantity_values(module, result))
    widths = [bar.get_width() for bar in axes.patches]
    np.testing.assert_allclose(widths, [*shown.values(), *(-change for change in shown.values())])
    names = [text.get_text() for text in axes.get_yticklabels()]
    assert names == [figures.quantities.quantity(name) for name in shown]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]  # the first is on top


def test_without_sensitivities_there_is_none(effort):
    module, _ = effort
    with np.errstate(all="ignore"):
        figure = figures.control_figure(module, codegen.solve(module, steps=10))
    assert not [axes for axes in figure.axes if axes.get_xlabel().startswith("change of the cost")]


def test_what_differs_from_body_to_body_and_what_there_is_not_is_left_out():
    names = ("a", "b", "c", "d")
    found = Sensitivities(names, np.array([1.0, 2.0, 0.0, 4.0]), "", (), 0.0, {})
    values = {"a": np.array([3.0, 3.0]), "b": np.array([1.0, 2.0]), "c": np.ones(2), "d": np.zeros(2)}
    assert changes(found, values) == {"a": pytest.approx(0.03)}
    none = Sensitivities(names, np.full(4, np.nan), "no minimum", (), np.nan, {})
    assert changes(none, values) == {}


def test_the_largest_have_bars_and_the_others_are_counted():
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    tornado(axes, {f"a{i}": 20.0 - i for i in range(MOST + 3)})
    assert len(axes.patches) == 2 * MOST
    assert axes.get_xlabel() == "change of the cost; 3 smaller not shown"
