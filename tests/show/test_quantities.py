"""What figures show, as numbers: quantities with bounds, path inequalities, first guesses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from invented_results import BOUNDED, PAIR, column, unsolved

from codegen.show import figures
from codegen.show.figures.quantities import Quantity, by_expression, first_guess, inequalities, quantities


class TestQuantities:
    def test_bounds_and_names(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        found = quantities(module, unsolved(module))
        (x,), (p,), (f,), (multiplier,) = (found[kind] for kind in ("state", "momentum", "control", "multiplier"))
        assert [q.name for q in (x, p, f, multiplier)] == ["x", "p_x", "f", "lambda_x"]
        assert (x.lower.tolist(), x.upper.tolist()) == ([-np.inf], [1.5])
        assert (f.lower.tolist(), f.upper.tolist()) == ([-1.0], [2.0])
        assert not np.isfinite([*p.lower, *p.upper, *multiplier.lower, *multiplier.upper]).any()
        assert (x.on_intervals, f.on_intervals) == (False, True)
        np.testing.assert_allclose(x.guess[:, 0], np.linspace(0, 1, 5))
        assert p.guess is None

    def test_active(self):
        values = column(0.0, 1.9, 2.0 - 1e-7, 2.0, 1.0)
        free = np.array([-np.inf])
        quantity = Quantity("f", "control", np.arange(6.0), values, free, np.array([2.0]))
        assert quantity.active()[:, 0].tolist() == [False, False, True, True, False]
        assert not replace(quantity, upper=-free).active().any()

    def test_inequalities(self, interpreted):
        module = interpreted("bounded", BOUNDED)
        result = unsolved(module)
        (shown,) = inequalities(module, result)
        assert shown.name == "f + x <= 3"
        np.testing.assert_allclose(shown.t, [0.25, 0.75, 1.25, 1.75])
        # The distance at the middle of each interval, whatever the slack says.
        np.testing.assert_allclose(shown.distance[:, 0], 3.0 - np.array([0.125, 0.375, 0.625, 0.875]))
        violated = result.unknowns.copy()
        module.views(module.make_grid(), violated)[1][0, 1, module.metadata.interval.index("f")] = 4.0
        (shown,) = inequalities(module, replace(result, unknowns=violated))
        assert shown.distance[1, 0] == pytest.approx(3.0 - 4.375)
        assert shown.active()[:, 0].tolist() == [False, True, False, False]

    def test_values_and_bounds_of_constrained_expressions(self, interpreted):
        path = "[f + x <= k, f + x >= -k/2 + t, 2*x <= f + 9, sqrt(k) >= dx]"
        text = BOUNDED.replace("[f + x <= 3]", path).replace('"f")', '"f")\n    k, t = parameter("k", 3), time()')
        module = interpreted(
            "limits", text.replace("coordinate", "coordinate, parameter, time\nfrom sympy import sqrt", 1)
        )
        result = replace(unsolved(module), parameters={"k": 4.0})
        shown = inequalities(module, result)
        assert [[one.name for one in group] for group in by_expression(shown)] == [
            ["f + x <= k", "f + x >= -k/2 + t"], ["2*x <= f + 9"], ["sqrt(k) >= dx"],
        ]  # fmt: skip
        upper, lower, both, speed = shown
        assert [one.expression for one in shown] == ["f + x", "f + x", "", "dx"]
        assert [one.is_lower for one in shown] == [False, True, False, False]
        np.testing.assert_allclose(upper.bound, 4.0)
        np.testing.assert_allclose(lower.bound, lower.t - 2.0)
        np.testing.assert_allclose(speed.bound, 2.0)
        assert both.bound is None
        # The guess is the motion x = t/2 with f = 0; its distances belong to the default k = 3.
        upper, lower, _, speed = inequalities(module, unsolved(module))
        for one in (upper, lower):
            np.testing.assert_allclose(one.values[:, 0], [0.125, 0.375, 0.625, 0.875])
        np.testing.assert_allclose(speed.values[:, 0], 0.5)

    def test_bodies(self, interpreted):
        module = interpreted("pair", PAIR)
        found = quantities(module, unsolved(module))
        (x,), (f,) = found["state"], found["control"]
        np.testing.assert_array_equal(x.values[0], [0, 1])
        np.testing.assert_array_equal(f.lower, [-5, -6])
        assert f.values.shape == (3, 2)

    def test_both_multipliers_of_a_hamiltonian_system(self, interpreted):
        module = interpreted("bounded", BOUNDED, method="hamiltonian")
        found = quantities(module, unsolved(module))
        assert [m.name for m in found["multiplier"]] == ["mu_x", "mu_p_x"]
        assert all(m.on_intervals for m in found["multiplier"])
        figure = figures.control_figure(module, unsolved(module))
        assert r"$\mu_{x}$, $\mu_{p,x}$" in {axes.get_ylabel() for axes in figure.axes}


def test_first_guess(interpreted):
    module = interpreted("bounded", BOUNDED)
    result = replace(unsolved(module), q=np.full((5, 1), 7.0))
    guess = first_guess(module, result)
    np.testing.assert_allclose(guess.q[:, 0], np.linspace(0, 1, 5))
    assert guess.log is None
