"""`codegen.solve_many` of simulations: motions of many cases, those of `codegen.solve` and of closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ellipj

import codegen
from codegen import Simulate, coordinate, parameters
from codegen.errors import ArgumentError, NumericsError

PROBLEMS = Path(__file__).parents[2] / "problems"
KINDS = {
    "pendulum": ({}, "start.p", [0.4, 1.0, 1.6]),
    "pendulum explicitly": ({"scheme": "stormer-verlet"}, "start.p", [0.4, 1.0, 1.6]),
    "heavy_top": ({}, "spin", [25.0, 30.0]),
    "rolling_disc": ({}, "duration", [1.0, 2.0]),
    "double_pendulum_cartesian": ({}, "duration", [0.2, 0.4]),
}
"""Options of the build, a parameter and its values: implicit and explicit steps, rotations, rolling, and joints."""


def oscillator() -> Simulate:
    q, v = coordinate("q")
    m, k = parameters(m=1, k=1)
    return Simulate(lagrangian=m * v**2 / 2 - k * q**2 / 2, duration=3, start={q: 1, v: 0}, steps=100)


@pytest.mark.parametrize("every", [1, 7])
@pytest.mark.parametrize("name", KINDS)
def test_every_case_has_the_motion_that_solve_finds(name, every):
    options, parameter, values = KINDS[name]
    solver = codegen.compile(PROBLEMS / f"{name.split()[0]}.py", **options)
    found = codegen.solve_many(solver, {parameter: values}, steps=40, every=every, threads=2)
    for i, value in enumerate(values):
        alone = solver.solve(parameters={parameter: value}, steps=40, every=every)
        assert (found.status[i], found.message[i].split(" with ")[0]) == ("solved", "all 40 steps were made")
        assert found.made[i] == 40
        for array in ("t", "q", "p", "energy"):
            np.testing.assert_array_equal(getattr(found, array)[i], getattr(alone, array))
        assert found.residual[i] == pytest.approx(alone.residual, rel=1e-6, abs=1e-13)


def test_midpoint_rule_of_oscillators_is_a_rotation_by_a_known_angle():
    """A step of length h turns the phase by 2 arctan(w h/2)."""
    rng = np.random.default_rng(1)
    masses, stiffnesses = rng.uniform(0.5, 2.0, (2, 500))
    found = codegen.solve_many(oscillator(), {"m": masses, "k": stiffnesses}, steps=60, threads=2)
    assert found.counts == {"solved": 500}
    frequency = np.sqrt(stiffnesses / masses)
    angle = 2.0 * np.arctan(0.5 * frequency * 3.0 / 60)[:, None] * np.arange(61)
    np.testing.assert_allclose(found.q[:, :, 0], np.cos(angle), atol=1e-13)
    momentum = -np.sqrt(stiffnesses * masses)[:, None] * np.sin(angle)
    np.testing.assert_allclose(found.p[:, :, 0], momentum, atol=1e-13)
    assert np.abs(found.energy - found.energy[:, :1]).max() < 1e-14


def test_pendulums_swing_as_elliptic_functions():
    """From q = 0 with the momentum 2 k: sin(q/2) = k sn(t, k^2)."""
    k = np.linspace(0.1, 0.9, 9)
    found = codegen.solve_many(
        PROBLEMS / "pendulum.py", {"start.q": 0.0, "start.p": 2.0 * k, "duration": 5.0}, steps=4000, every=400
    )
    expected = 2.0 * np.arcsin(k[:, None] * ellipj(found.t, k[:, None] ** 2)[0])
    np.testing.assert_allclose(found.q[:, :, 0], expected, atol=2e-6)


def test_results_do_not_depend_on_the_number_of_threads():
    solver, starts = codegen.compile(PROBLEMS / "pendulum.py"), {"start.p": np.linspace(0.1, 1.9, 97)}
    one, *others = (codegen.solve_many(solver, starts, steps=50, threads=threads) for threads in (1, 2, 5))
    for other in others:
        np.testing.assert_array_equal(one.path, other.path)


def test_failed_and_unusable_cases_raise_nothing():
    """The last pendulum has 12 steps of length 5, too long for Newton's method."""
    found = codegen.solve_many(
        PROBLEMS / "pendulum.py", {"duration": [1.0, -1.0, np.nan, 60.0], "start.p": [1.4, 1.4, 1.4, 0.5]}, steps=12
    )
    alone = codegen.solve(PROBLEMS / "pendulum.py", steps=12, parameters={"start.p": 0.5})
    assert found.status.tolist() == ["solved", "unusable", "unusable", alone.status]
    assert alone.status != "solved"
    assert found.message[3] == alone.message
    assert "duration" in found.message[1]
    assert np.isnan(found.q[1]).all()
    assert np.isnan(found.q[3, found.made[3] + 1 :]).all()
    np.testing.assert_array_equal(found.q[3, : found.made[3] + 1], alone.q)
    with pytest.raises(NumericsError, match="case 1 has unusable numbers"):
        found[1]
    with pytest.raises(IndexError):
        found[4]


def test_cases_may_all_be_unusable():
    found = codegen.solve_many(oscillator(), {"m": [np.inf, np.nan]})
    assert found.counts == {"unusable": 2}
    assert "parameters must be finite" in found.message[0]


def test_starts_that_violate_a_constraint_are_unusable():
    found = codegen.solve_many(
        PROBLEMS / "double_pendulum_cartesian.py", {"duration": [1.0, 1.0], "start.x1": [1.0, 1.2]}, steps=20
    )
    assert found.status.tolist() == ["solved", "unusable"]
    assert "violates the constraint" in found.message[1]


def test_data_set_has_the_motions():
    found = codegen.solve_many(oscillator(), {"m": [1.0, 2.0]}, steps=20, every=5)
    data = found.to_dataset()
    assert dict(data.sizes) == {"case": 2, "node": 5, "coordinate": 1, "momentum": 1}
    np.testing.assert_array_equal(data.q.values, found.q)
    assert data.coordinate.values.tolist() == ["q"]
    assert repr(found) == "Motions of 2 cases of problem (m): 2 solved"


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: codegen.solve_many(oscillator(), {"m": [1.0]}, guess=np.zeros(3)), ArgumentError, "a guess for"),
        (lambda: codegen.solve_many(oscillator(), {"m": [1.0]}, every=0), NumericsError, "every"),
        (lambda: codegen.solve_many(oscillator(), {"n": [1.0]}), ArgumentError, "no parameter n"),
        (lambda: codegen.solve_many(PROBLEMS / "resting_ball.py", {"g": [9.0]}), ArgumentError, "have events; use"),
        (lambda: codegen.solve_many(PROBLEMS / "lennard_jones.py", {"duration": [1.0]}), ArgumentError, "of particles"),
    ],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused(call, error, text):
    with pytest.raises(error, match=text):
        call()
