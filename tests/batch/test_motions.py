"""`codegen.solve_many` of simulations: motions of many cases, those of `codegen.solve` and of closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.special import ellipj
from sympy import Rational

import codegen
from codegen import Event, Simulate, coordinate, parameters
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
        assert (found.status[i], found.message[i]) == ("solved", alone.message)
        assert (found.made[i], found.residual[i]) == (40, alone.residual)
        for array in ("t", "q", "p", "energy"):
            np.testing.assert_array_equal(getattr(found, array)[i], getattr(alone, array))


def test_a_case_of_a_tumbling_body_has_its_angular_velocity_and_a_film(tmp_path):
    """The magnitude of the angular momentum J omega of a free body is constant."""
    found = codegen.solve_many(PROBLEMS / "dzhanibekov.py", {"duration": [1.0, 2.0]}, steps=20)
    case = found[1]
    assert case["omega"][0] == pytest.approx([1e-3, 2, 0], abs=1e-12)
    momentum = np.linalg.norm(case["omega"] * [3, 2, 1], axis=1)
    assert momentum == pytest.approx(np.full(21, np.hypot(3e-3, 4)), rel=1e-12)
    case.animate(tmp_path / "body.gif")
    assert (tmp_path / "body.gif").stat().st_size > 1000


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


def falling(**given) -> Simulate:
    """A ball that falls from the height 1."""
    y, v = coordinate("y")
    g, e = parameters(g=9.81, e=0.7)
    events = {"down": Event(y, **given.pop("effect")(e, v))} if "effect" in given else {}
    gaps = {} if events else {"unilateral": {"floor": y >= 0}, "restitution": e}
    motion = {"lagrangian": v**2 / 2 - g * y, "start": {y: 1, v: 0}, "duration": 1.5, "steps": 100}
    low = Event(y - Rational(3, 10), then="record", direction=-1)
    return Simulate(**motion | given, **gaps, events=events | {"low": low})


EFFECTS = {
    "impacts": {},
    "stop": {"effect": lambda e, v: {}},
    "change": {"effect": lambda e, v: {"then": {v: -e * v}}},
}


@pytest.mark.parametrize("every", [1, 7])
@pytest.mark.parametrize("name", EFFECTS)
def test_events_of_every_case_are_those_that_solve_finds(name, every):
    """Elastic and inelastic impacts, rest on the floor, motions that an event ends, and changes that accumulate."""
    solver, values = codegen.compile(falling(**EFFECTS[name])), {"g": [9.0, 9.81, 5.0], "duration": [6.0, 3.0, 1.5]}
    values |= {"e": [0.0, 0.5, 1.0]} if "e" in solver.parameters else {}
    found = codegen.solve_many(solver, values, every=every, threads=2)
    for i in range(3):
        alone = solver.solve(parameters={key: own[i] for key, own in values.items()}, every=every)
        assert (found.status[i], found.message[i]) == (alone.status, alone.message)
        np.testing.assert_array_equal(found.residual[i], alone.residual)
        for array in ("t", "q", "p", "energy"):
            rows = getattr(found, array)[i]
            np.testing.assert_array_equal(rows[: alone.t.size], getattr(alone, array))
            assert np.isnan(rows[alone.t.size :]).all()
        own = found.events.case == i
        for array in ("t", "before", "after"):
            np.testing.assert_array_equal(getattr(found.events, array)[own], getattr(alone.events, array))
        labels = [found.names["event_counts"][label] for label in found.events.label[own]]
        assert [label.split(" ")[0] for label in labels] == list(alone.events.names)
        np.testing.assert_array_equal(found.event_counts[i], [labels.count(n) for n in found.names["event_counts"]])
    assert {"impacts": "solved", "stop": "solved", "change": "events accumulate"}[name] in found.counts


def test_balls_bounce_at_the_times_of_the_closed_form():
    """Impact n is at t_0 (1 + 2 e (1 - e^n)/(1 - e)), with the velocity e^(n + 1) g t_0 after it."""
    e, fall = np.linspace(0.3, 0.8, 200), np.sqrt(2 / 9.81)
    found = codegen.solve_many(PROBLEMS / "resting_ball.py", {"e": e}, every=50, threads=2)
    assert found.counts == {"solved": 200}
    assert found.names["event_times"] == ("floor impact", "floor rest", "floor opening")
    n = np.arange(10)
    exact = fall * (1 + 2 * e[:, None] * (1 - e[:, None] ** n) / (1 - e[:, None]))
    np.testing.assert_allclose(found.event_times[:, :, 0], exact, atol=1e-12)
    np.testing.assert_allclose(found.event_times[:, 0, 1], fall * (1 + e) / (1 - e), atol=1e-12)
    is_impact = found.events.label == 0
    case, after = found.events.case[is_impact], found.events.after[is_impact]
    numbers = np.concatenate([np.arange(count) for count in np.bincount(case)])
    np.testing.assert_allclose(after[:, 3], e[case] ** (numbers + 1) * 9.81 * fall, atol=1e-12)


def test_events_of_many_cases_fill_more_than_the_first_log():
    """An elastic ball hits the floor every 2 t_0. A thread follows ten balls at a time, with some 11,000 events."""
    g = np.linspace(100.0, 400.0, 80)
    found = codegen.solve_many(falling(steps=2000), {"g": g, "e": 1.0, "duration": 100.0}, every=2000, threads=1)
    fall = np.sqrt(2.0 / g)
    np.testing.assert_array_equal(found.event_counts[:, 1], np.floor((100.0 / fall + 1.0) / 2.0))
    assert found.events.t.size == found.event_counts.sum() > 80_000
    np.testing.assert_array_equal(found[79].events.t, found.events.t[found.events.case == 79])


def test_starts_and_numbers_that_contact_does_not_take_are_unusable():
    found = codegen.solve_many(falling(), {"start.y": [1.0, -1.0, 1.0], "e": [0.0, 0.5, 1.5]})
    assert found.status.tolist() == ["solved", "unusable", "unusable"]
    assert "the gap is -1" in found.message[1]
    assert "restitution of floor is 1.5" in found.message[2]
    data = found.to_dataset()
    assert data.event_counts.sel(event="floor impact").values.tolist() == [1.0, 0.0, 0.0]
    assert data.event_times.dims == ("case", "occurrence", "event")


def test_a_limit_of_iterations_holds_for_every_case():
    found = codegen.solve_many(PROBLEMS / "pendulum.py", {"start.p": [1.0, 1.4]}, steps=20, max_iterations=2)
    alone = codegen.solve(PROBLEMS / "pendulum.py", steps=20, max_iterations=2)
    assert (found.status[1], found.message[1]) == (alone.status, alone.message)
    assert alone.status == "newton failed"


@pytest.mark.parametrize("workers", [1, 3])
def test_a_sweep_stores_the_motions_in_any_chunks(tmp_path, workers):
    """Seven does not divide 40 steps: the last state is stored as well."""
    starts = np.linspace(0.2, 1.8, 23)
    found = codegen.solve_many(PROBLEMS / "pendulum.py", {"start.p": starts}, steps=40, every=7)
    data = codegen.sweep(
        PROBLEMS / "pendulum.py", {"start.p": starts}, steps=40, every=7, chunk=5, workers=workers,
        out=tmp_path / "s.zarr",
    )  # fmt: skip
    for name in ("t", "q", "p", "energy", "residual", "iterations", "status", "message"):
        np.testing.assert_array_equal(data[name].values, getattr(found, name))
    assert data.t[0, -1] == 60.0


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: codegen.solve_many(oscillator(), {"m": [1.0]}, guess=np.zeros(3)), ArgumentError, "a guess for"),
        (lambda: codegen.solve_many(oscillator(), {"m": [1.0]}, every=0), NumericsError, "every"),
        (lambda: codegen.solve_many(oscillator(), {"n": [1.0]}), ArgumentError, "no parameter n"),
        (lambda: codegen.solve_many(PROBLEMS / "lennard_jones.py", {"duration": [1.0]}), ArgumentError, "of particles"),
    ],
)  # fmt: skip
def test_what_cannot_be_followed_is_refused(call, error, text):
    with pytest.raises(error, match=text):
        call()
