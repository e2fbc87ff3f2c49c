"""Loops of others around sweeps: an array of cases in, an array of costs out, as the site shows."""

from __future__ import annotations

import numpy as np
from command_lines import ORBIT
from scipy.optimize import differential_evolution

import codegen


def test_scipy_finds_the_orbit_that_costs_nothing(orbital_transfer):
    """A satellite that stays where it is, r1 = r0 = 5, needs no thrust."""

    def costs(points):
        columns = dict(zip(("r1", "m"), points))
        data = codegen.sweep(ORBIT, cases=columns, steps=30, keep=(), workers=1)
        return np.where(data.status == "solved", data.cost, np.inf)

    found = differential_evolution(
        costs,
        [(4.5, 6.5), (90, 110)],
        vectorized=True,
        updating="deferred",
        maxiter=12,
        popsize=6,
        seed=1,
        polish=False,
    )
    assert abs(found.x[0] - 5.0) < 0.05
    assert found.fun < 1e-4


def test_costs_are_in_the_order_of_the_cases(orbital_transfer):
    r1 = np.array([6.0, 5.8, 6.2, 5.9])
    data = codegen.sweep(ORBIT, cases={"r1": r1}, steps=30, keep=(), workers=1)
    alone = [orbital_transfer.solve(30, r1=value).cost for value in r1]
    np.testing.assert_allclose(data.cost, alone, rtol=1e-12)
