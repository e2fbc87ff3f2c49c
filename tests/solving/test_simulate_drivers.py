"""Drivers on simulations: the same trajectory from the generated solver and from MINPACK."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from codegen.errors import ArgumentError
from codegen.solving import api
from codegen.solving.drivers.newton import simulate as newton
from codegen.solving.results.motions import simulate_result
from codegen.solving.results.result import Run


@pytest.mark.parametrize("every", [1, 7])
def test_newton_and_fsolve_agree(pendulum, every):
    ours = api.solve(pendulum, "newton", steps=200, every=every)
    theirs = api.solve(pendulum, "fsolve", steps=200, every=every)
    assert ours.status == theirs.status == "solved"
    np.testing.assert_allclose(theirs.t, ours.t, rtol=1e-14)
    np.testing.assert_allclose(theirs.q, ours.q, atol=1e-9)
    np.testing.assert_allclose(theirs.p, ours.p, atol=1e-9)
    assert max(ours.residual, theirs.residual) < 1e-11


def test_midpoint_rule_holds(pendulum):
    """The scheme written out by hand, from which the residual must not differ."""
    result = api.solve(pendulum, steps=100)
    h = 60 / 100
    q, p = result.q[:, 0], result.p[:, 0]
    np.testing.assert_allclose(np.diff(q), h * (p[1:] + p[:-1]) / 2, atol=1e-13)
    np.testing.assert_allclose(np.diff(p), -h * np.sin((q[1:] + q[:-1]) / 2), atol=1e-13)
    assert result.summary["final_q"] == q[-1]
    energy = p**2 / 2 - np.cos(q)
    assert result.summary["energy_drift"] == pytest.approx(np.abs(energy - energy[0]).max())


def test_fsolve_has_nothing_to_do_for_an_explicit_scheme(explicit_pendulum):
    with pytest.raises(ArgumentError, match="explicit"):
        api.solve(explicit_pendulum, "fsolve")


@pytest.mark.parametrize("name", ["slsqp", "trust-constr"])
def test_optimisers_do_not_apply(pendulum, name):
    with pytest.raises(ArgumentError, match="use one of newton, fsolve"):
        api.solve(pendulum, name)


def test_false_claim_is_downgraded(pendulum):
    attempt = newton(pendulum, Run(50))
    assert simulate_result(pendulum, "newton", Run(50), attempt, 1.0).status == "solved"
    wrong = attempt.q.copy()
    wrong[20] += 1e-6
    result = simulate_result(pendulum, "newton", Run(50), replace(attempt, q=wrong), 1.0)
    assert result.status == "inaccurate"
    assert result.residual == pytest.approx(1e-6, rel=0.5)
