"""Where equations depend on each other, multipliers without limit make any slope one of rounding: no optimum."""

from __future__ import annotations

import numpy as np
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
