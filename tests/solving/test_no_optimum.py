"""Where equations depend on each other: huge multipliers are no optimum, and conditions that agree no obstacle."""

from __future__ import annotations

import numpy as np
import pytest
from interpreted import of_problem
from sympy import cos, sin

from codegen import Control, control, coordinates
from codegen.runtime.search.solve import corrected_status


def spun_hoop() -> Control:
    """A bead at rest at the bottom of a hoop that is turned about the vertical: only coarse steps let it leave."""
    (alpha, phi), (dalpha, dphi) = coordinates("alpha phi")
    u = control("u")
    kinetic = 0.002 * (dalpha**2 + sin(alpha) ** 2 * dphi**2) + 0.005 * dphi**2
    ends = {"start": {alpha: 0, phi: 0, dalpha: 0, dphi: 0}, "end": {alpha: 1.0, dalpha: 0, dphi: 10}}
    return Control(lagrangian=kinetic + 0.2 * cos(alpha), force={phi: u}, cost=u**2, duration=3, steps=8, **ends)


def test_a_slope_that_only_huge_multipliers_forgive_is_no_optimum():
    module = of_problem(spun_hoop())
    grid = module.make_grid(8)
    guess = module.initial_guess(grid)
    point = module.evaluate(grid, guess)._replace(residual=0.0)
    steep = point._replace(stationarity=4e33, error=4e33)
    assert corrected_status(grid, guess, steep, "solved") != "solved"
    flat = point._replace(stationarity=1e-9, error=1e-9)
    assert corrected_status(grid, guess, flat, "solved") == "solved"
    assert np.isfinite(point.gradient).all()


def pushed_apart(end) -> Control:
    """Masses m and 2m that push each other from rest to rest by the force u."""
    (a, b), (da, db) = coordinates("a b")
    u = control("u")
    return Control(
        lagrangian=da**2 / 2 + db**2,
        force={a: -u, b: u},
        cost=u**2,
        duration=1,
        start={a: 0, b: 1, da: 0, db: 0},
        end={a: -2, b: end, da: 0, db: 0},
    )


@pytest.mark.parametrize("steps", [5, 20, 100])
def test_an_end_that_follows_from_the_conserved_momentum_is_no_obstacle(steps):
    """The heavy mass takes the effort 12 (2m)^2 d^2 / T^3 over the distance d in the time T.

    A piecewise constant force on N intervals takes 1 / (1 - 1/N^2) times this effort.
    """
    result = of_problem(pushed_apart(2)).solve(steps)
    assert result.status == "solved", result.message
    assert result.cost == pytest.approx(48 / (1 - 1 / steps**2), rel=1e-10)


def test_an_end_against_the_conserved_momentum_is_infeasible():
    assert of_problem(pushed_apart(2.1)).solve(20).status == "infeasible"
