"""Sensitivities of solutions: closed forms, laws of scale, what bounds hold, and what is said where there are none."""

from __future__ import annotations

import json

import numpy as np
import pytest
from measured_decay import interpreted as interpreted_file
from measured_decay import write_decay

import codegen
from codegen.errors import ArgumentError, NumericsError
from codegen.solving.results import output

PROBLEM = '''"""{title}"""
from sympy import Eq, cos
from codegen import Control, control, free_parameter, parameters, states
def problem() -> Control:
    x, v = states("x v")
    u, (a, b) = control("u"), parameters(a=1.5, b=0.5)
    return Control(dynamics={{x: v, v: u}}, {rest})
'''
STEPS = 10


@pytest.fixture
def solved(interpreted):
    """Solves a problem of the gallery, or one of two states and a control that is given by the rest of it."""

    def solve(name: str, rest: str | None = None, steps: int = STEPS, **options):
        text = PROBLEM.format(title=name, rest=rest) if rest else None
        return codegen.solve(interpreted(name, text, sensitivities=True), steps=steps, sensitivities=True, **options)

    return solve


def test_least_effort_in_closed_form(solved):
    """The discrete optimum is 12 N^2/(N^2 - 1) x^2/T^3, and controls are in proportion to x."""
    result = solved("double_integrator_effort")
    found = result.sensitivities()
    distance, duration = float(result.q[-1, 0]), float(result.t[-1])
    assert found["end.x"].cost == pytest.approx(2.0 * result.cost / distance, rel=1e-9)
    assert found["duration"].cost == pytest.approx(-3.0 * result.cost / duration, rel=1e-9)
    assert found["end.x"].u == pytest.approx(result.u / distance, rel=1e-9)
    assert found["end.x"].q[:, 0] == pytest.approx(result.q[:, 0] / distance, rel=1e-9)
    assert found["end.x"].multipliers == pytest.approx(result.multipliers / distance, rel=1e-9)
    assert found["duration"].u == pytest.approx(-2.0 * result.u / duration, rel=1e-9)
    assert found["duration"].t == pytest.approx(result.t / duration, rel=1e-12)
    assert found["end.x"].t == pytest.approx(0.0 * result.t)


def test_time_of_descent_in_closed_form(solved):
    """The time of the brachistochrone is in proportion to g^(-1/2): in units of time that follow g nothing changes."""
    result = solved("brachistochrone")
    found, g = result.sensitivities()["g"], 9.80665
    assert found.cost == pytest.approx(-0.5 * result.cost / g, rel=1e-7)
    assert found.durations == pytest.approx([-0.5 * result.cost / g], rel=1e-7)
    assert found.t == pytest.approx(-0.5 * result.t / g, rel=1e-7)
    assert found.u == pytest.approx(0.0 * result.u, abs=1e-7)
    assert found.free == pytest.approx({"T": -0.5 * result.cost / g}, rel=1e-7)


HELD = "cost=(u - 2*a)**2, duration=2, bounds={u: (-a, a)}, start={x: b, v: 0}"


def test_bound_that_moves(solved):
    """The control is at its bound a, so that x = b + a t^2/2, and the cost is 2 a^2."""
    result = solved("held", HELD)
    assert result.u == pytest.approx(np.full((STEPS, 1), 1.5), rel=1e-8)
    found = result.sensitivities()
    assert found["a"].u == pytest.approx(np.ones((STEPS, 1)), abs=1e-9)
    assert found["a"].cost == pytest.approx(4.0 * 1.5, rel=1e-8)
    assert found["a"].q[-1, 0] == pytest.approx(2.0, rel=1e-7)
    assert found["b"].q[:, 0] == pytest.approx(np.ones(STEPS + 1), rel=1e-9)
    assert found["start.x"].q == pytest.approx(found["b"].q, rel=1e-9)
    assert not found.notes


def test_bound_that_does_not_hold(solved):
    """Between its bounds the control is 2 a everywhere."""
    found = solved("free", HELD.replace("(-a, a)", "(-10, 10)")).sensitivities()
    assert found["a"].u == pytest.approx(np.full((STEPS, 1), 2.0), rel=1e-8)
    assert found["a"].cost == pytest.approx(0.0, abs=1e-8)


def test_strict_complementarity_that_fails_is_named(solved):
    """The least cost is exactly on the bound, which holds against nothing."""
    found = solved("doubtful", HELD.replace("2*a", "a")).sensitivities()
    assert len(found.doubtful) == STEPS
    (note,) = found.notes
    assert "strict complementarity fails for u on interval 0, u on interval 1" in note
    assert note.endswith(f"and {STEPS - 3} more")


def test_vertex_has_no_derivatives(solved):
    """With an even number of intervals all controls of the fastest transfer are at bounds: nothing is left free."""
    result = solved("double_integrator")
    assert result.status == "solved"
    found = result.sensitivities()
    assert found.reason == "equations, or active bounds, depend on each other at the solution"
    assert np.isnan(found.costs).all()
    with pytest.raises(NumericsError, match="there are no derivatives by limit: equations, or active bounds"):
        found["limit"]
    record = output.as_record(result, 0.0, 0.0)["sensitivities"]
    assert set(record["by"].values()) == {None}
    assert record["reason"] == found.reason


@pytest.mark.slow
def test_orbits_in_other_units(solved):
    """Lengths, times and masses may be measured in any units: Euler's theorem on homogeneous functions, thrice."""
    result = solved("orbital_transfer")
    found = result.sensitivities()
    m, GM, r0, r1 = 100.0, 0.40038, 5.0, 6.0
    # The cost is a force squared times time: mass^2 length^2 time^-3.
    by_mass = m * found["m"].cost
    by_length = r0 * found["r0"].cost + r1 * found["r1"].cost + 3.0 * GM * found["GM"].cost
    by_time = -2.0 * GM * found["GM"].cost
    assert (by_mass, by_length, by_time) == pytest.approx(
        (2.0 * result.cost, 2.0 * result.cost, -3.0 * result.cost), rel=1e-8
    )
    lengths = r0 * found["r0"].q[:, 0] + r1 * found["r1"].q[:, 0] + 3.0 * GM * found["GM"].q[:, 0]
    assert lengths == pytest.approx(result.q[:, 0], rel=1e-8)
    momenta = m * found["m"].p
    assert momenta == pytest.approx(result.p, rel=1e-8, abs=1e-9 * np.abs(result.p).max())


def test_records_and_arrays(solved, tmp_path):
    result = solved("orbital_transfer")
    record = output.as_record(result, 0.0, 0.0)
    found = json.loads(output.as_json(record))["sensitivities"]
    assert list(found["by"]) == list(result.sensitivities())
    assert found["by"]["start.r"]["cost"] == pytest.approx(result.sensitivities()["start.r"].cost)
    assert set(found["by"]["m"]["end"]) == {"r", "phi"}
    output.save(result, record, tmp_path / "saved.npz")
    with np.load(tmp_path / "saved.npz") as archive:
        i = list(archive["d_names"]).index("r1")
        assert archive["d_q"][i] == pytest.approx(result.sensitivities()["r1"].q)
        assert archive["d_cost"].shape == (len(found["by"]),)
    assert output.sensitivities_table(record["sensitivities"]).row_count == len(found["by"])


MEASURED = '''"""A substance decays, and what is measured of it is off."""
from codegen import Control, Measurements, free_parameter, parameters, states
def problem() -> Control:
    (x,) = states("x")
    k, (a, T) = free_parameter("k", 1, lower=0.01), parameters(a=2, T=3)
    observations = Measurements("decay.csv", time="t", values={{x + a/10: "z"}}, sigma=0.05)
    return Control(dynamics={{x: -k*x}}, observations=observations, duration={duration}, start={{x: a}}, steps=20)
'''


def test_what_is_fitted_follows_parameters(tmp_path):
    write_decay(tmp_path)
    path = tmp_path / "measured.py"
    path.write_text(MEASURED.format(duration=3))
    module = interpreted_file(path, sensitivities=True)
    result = codegen.solve(module, sensitivities=True, tolerance=1e-12)
    assert tuple(result.sensitivities()) == ("a", "start.x")
    for name, given in (("a", lambda e: {"a": 2 + e}), ("start.x", lambda e: {"start": {"x": 2 + e}})):
        above, below = (
            module.solve(**given(e), guess=result.unknowns, warm=True, tolerance=1e-12) for e in (1e-4, -1e-4)
        )
        found = result.sensitivities()[name]
        assert found.cost == pytest.approx((above.cost - below.cost) / 2e-4, rel=1e-6)
        assert found.unknowns == pytest.approx((above.unknowns - below.unknowns) / 2e-4, rel=1e-5, abs=1e-5)


def test_samples_in_times_that_follow_parameters_are_refused(tmp_path):
    write_decay(tmp_path)
    path = tmp_path / "measured.py"
    path.write_text(MEASURED.format(duration="T"))
    with pytest.raises(ArgumentError, match="measurements need times that follow no parameters; give the duration"):
        codegen.build(path, sensitivities=True)


@pytest.mark.slow
def test_delays_are_put_together(solved):
    result = solved("delayed_oscillator", steps=20)
    found = result.sensitivities()
    name = next(iter(found))
    assert found[name].q.shape == result.q.shape
    assert found[name].u.shape == result.u.shape
    assert found[name].multipliers.shape == result.multipliers.shape


def test_requests_that_make_no_sense_are_refused(interpreted, tmp_path):
    with pytest.raises(
        ArgumentError, match=r"the module of orbital_transfer has no sensitivities; build it with --sens"
    ):
        codegen.solve(interpreted("orbital_transfer"), sensitivities=True)
    with pytest.raises(ArgumentError, match="sensitivities is 'yes'"):
        codegen.solve(interpreted("orbital_transfer"), sensitivities="yes")
    with pytest.raises(ArgumentError, match="--sensitivities does not apply to a simulate problem"):
        codegen.solve(interpreted("pendulum"), sensitivities=True)
    result = codegen.solve(interpreted("linear_pendulum"), steps=4)
    with pytest.raises(ArgumentError, match="this result has no sensitivities; solve with sensitivities=True"):
        result.sensitivities()


@pytest.mark.parametrize("problem", ["pendulum", "lennard_jones", "image_registration"])
def test_only_optimisations_have_sensitivities(problem, tmp_path):
    from conftest import PROBLEMS

    with pytest.raises(ArgumentError, match="has no sensitivities; leave them out"):
        codegen.build(PROBLEMS / f"{problem}.py", sensitivities=True)
