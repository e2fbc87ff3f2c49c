"""Stress of a user's own problem: rates, stable steps, drifts and the sentence, against closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from idle_worker import SOLVED
from interpreted import without_compilation

from codegen.discretise.schemes import METHODS, find
from codegen.discretise.schemes.base import FIRST_ORDER
from codegen.emit.naming import Choices
from codegen.evidence.stress.cases import PROBLEMS, Case, Measurement, Setup, Truth, classify
from codegen.evidence.stress.measure import measure
from codegen.evidence.stress.own import exact_motion, largest_stable, motion_cases, stable_rate, verdict
from codegen.evidence.stress.systems import is_runge_kutta, limit_along, stability_function
from codegen.solving.compiler import generate

DAMPED = '''
"""A fast decay beside a slow swing."""
from codegen import Simulate, states

def problem():
    x, y, z = states("x y z")
    return Simulate(dynamics={x: y, y: -x, z: -100*(z - x)}, start={x: 1, y: 0, z: 1}, duration=0.5, steps=10)
'''
FAST = '''
"""A fast oscillator."""
from codegen import Simulate, canonical_pair

def problem():
    q, p = canonical_pair("q", "p")
    return Simulate(hamiltonian=(p**2 + 1600*q**2)/2, start={q: 1, p: 0}, duration=4, steps=400)
'''
OSCILLATOR = PROBLEMS  # its first problem
CASE = Case("own", "own", Setup(OSCILLATOR), "accurate", "a test", truth=Truth(), limit=True, drift=1.0)


@pytest.fixture(scope="module")
def decay(tmp_path_factory):
    path = tmp_path_factory.mktemp("own") / "damped.py"
    path.write_text(DAMPED)
    return path, without_compilation(generate(path, {}, Choices("explicit-euler", None)))


@pytest.fixture(scope="module")
def swing():
    return without_compilation(generate(OSCILLATOR, {}, Choices("explicit-euler", "hamiltonian")))


def test_the_motion_and_its_rates_are_those_of_closed_forms(decay):
    truth, rates, _ = exact_motion(decay[1], (10,))
    assert truth.rate == pytest.approx(100.0, rel=1e-6)
    assert np.sort_complex(rates[7]) == pytest.approx([-100.0, -1j, 1j], abs=1e-5)
    t = truth.times
    assert truth.states[:, 0] == pytest.approx(np.cos(t), abs=1e-9)
    assert np.abs(t - np.linspace(0.0, 0.5, 11)[:, None]).min(axis=1).max() < 1e-12


def test_energy_is_compared_with_its_parts_and_not_with_its_sum(swing):
    truth, rates, moduli = exact_motion(swing, (100,))
    assert truth.energy == pytest.approx(0.5, rel=1e-3)  # the total energy may be shifted to zero, its parts may not
    assert np.abs(rates).max() == pytest.approx(1.0, rel=1e-6)
    assert truth.rate == moduli.max() == pytest.approx(1.0, rel=1e-3)  # sizes are the largest values at nodes
    assert not truth.conserved.any()
    assert rates.shape == (41, 2)


@pytest.mark.parametrize(("name", "least"), [("stormer-verlet", 2.0), ("rk4", math.sqrt(8.0))])
def test_the_largest_stable_step_is_that_of_the_linear_motion(tmp_path, name, least):
    path = tmp_path / "fast.py"
    path.write_text(FAST)
    euler, module = (
        without_compilation(generate(path, {}, Choices(one, "hamiltonian"))) for one in ("explicit-euler", name)
    )
    truth, _, _ = exact_motion(euler, (100,))
    assert largest_stable(module, truth) == pytest.approx(least, rel=0.03)


def test_decay_limits_explicit_schemes_and_no_stiff_ones(decay):
    """Closed forms on the negative axis: 2 for Euler, 2.785 for rk4; L-stable schemes have no limit."""
    _, rates, _ = exact_motion(decay[1], (100,))
    schemes = [find(name, FIRST_ORDER) for name in ("explicit-euler", "rk4", "radau-5")]
    limits = {scheme.name: stable_rate(scheme, rates, 100.0) for scheme in schemes}
    assert limits["explicit-euler"] == pytest.approx(2.0, rel=1e-3)
    assert limits["rk4"] == pytest.approx(2.785293563405282, rel=1e-3)
    assert limits["radau-5"] == math.inf


def test_expectations_follow_from_the_rates(decay):
    path, module = decay
    schemes = [find(name, FIRST_ORDER) for name in ("rk4", "radau-5")]
    cases = motion_cases(module, [(Setup(path, scheme.name, None), scheme) for scheme in schemes])
    expected = {(case.setup.scheme, case.steps, case.limit): case.expect for case in cases}
    assert expected["rk4", 10, False] == "unsuitable"  # h lambda = 5
    assert expected["radau-5", 10, False] == "bounded"
    assert all(case.reason and (case.limit or case.h_omega > 0.0) for case in cases)
    radau = without_compilation(generate(path, {}, Choices("radau-5", None)))
    case = next(case for case in cases if case.setup.scheme == "radau-5" and case.limit)
    row = classify(case, measure(radau, case))
    assert row.passed, row.text


@pytest.mark.parametrize("name", ["implicit-euler", "midpoint", "radau-3", "radau-5", "sdirk-4", "gauss-4", "rk4"])
def test_stability_functions_are_those_of_the_literature(name):
    """Hairer and Wanner (1996), IV.3 and IV.6; at infinity zero for L-stable schemes and one for Gauss."""
    scheme, z = METHODS["hamiltonian"][name] if name in METHODS["hamiltonian"] else find(name, FIRST_ORDER), -0.7 + 0.4j
    closed = {
        "implicit-euler": 1 / (1 - z),
        "midpoint": (1 + z / 2) / (1 - z / 2),
        "radau-3": (1 + z / 3) / (1 - 2 * z / 3 + z**2 / 6),
        "radau-5": (1 + 2 * z / 5 + z**2 / 20) / (1 - 3 * z / 5 + 3 * z**2 / 20 - z**3 / 60),
        "gauss-4": (1 + z / 2 + z**2 / 12) / (1 - z / 2 + z**2 / 12),
        "rk4": 1 + z + z**2 / 2 + z**3 / 6 + z**4 / 24,
    }
    assert is_runge_kutta(scheme)
    if name in closed:
        assert stability_function(scheme, z) == pytest.approx(closed[name], rel=1e-13)
    at_infinity = abs(stability_function(scheme, -1e10))
    assert at_infinity == pytest.approx(1.0 if name in ("midpoint", "gauss-4") else 0.0, abs=1e-6) or name == "rk4"
    assert (limit_along(scheme, -1.0) == math.inf) == (name != "rk4")


@pytest.mark.fast
def test_the_sentence_names_what_to_take_and_what_not():
    def row(scheme, error, limit):
        expect = "bounded" if limit or error < 1.0 else "unsuitable"
        case = replace(
            CASE, setup=Setup(OSCILLATOR, scheme, "hamiltonian"), limit=limit, bound=0.1 if limit else math.nan
        )
        seen = replace(SOLVED, error=error, drift=error / 10, stable_below=1.0, seconds=1e-3)
        return classify(replace(case, expect=expect), seen)

    errors = {"gauss-4": 1e-5, "midpoint": 0.5, "explicit-euler": 9.0}
    rows = [row(name, error, limit) for name, error in errors.items() for limit in (True, False)]
    text = verdict(rows)
    assert text.startswith("Take gauss-4: error 1.0e-05")
    assert "the phase is lost: midpoint" in text
    assert "Do not take explicit-euler" in text


@pytest.mark.fast
def test_an_optimum_that_a_noisy_guess_improves_is_local():
    case = replace(CASE, limit=False, guesses=20, reference="", bound=0.5)
    seen = replace(SOLVED, error=-0.0127, failures=3, others=12)
    row = classify(case, seen)
    assert row.outcome == "unexpected"
    assert "12 lead to other local optima" in row.text
    assert "only local" in verdict([row, row])


@pytest.mark.fast
@pytest.mark.parametrize(("error", "outcome"), [(2.9e-3, "accurate"), (3.1e-3, "unexpected")])
def test_an_announced_error_is_held_to_account(error, outcome):
    case = replace(CASE, limit=False, reference="refined")
    seen = Measurement("solved", "done", error=error, announced=1e-3, residual=0.0, tolerance=1e-7)
    assert classify(case, seen).outcome == outcome


def test_the_speed_of_a_fall_is_a_rate_although_its_linearisation_has_none(tmp_path):
    path = tmp_path / "fall.py"
    path.write_text(
        '"""A fall."""\nfrom codegen import Simulate, canonical_pair\n\n\n'
        'def problem():\n    z, p = canonical_pair("z", "p")\n'
        "    return Simulate(hamiltonian=p**2/2 + 10*z, start={z: 0, p: 0}, duration=2, steps=10)\n"
    )
    truth, rates, _ = exact_motion(without_compilation(generate(path, {}, Choices("explicit-euler", None))), (10,))
    assert np.abs(rates).max() < 1e-5
    assert truth.rate == pytest.approx(1.0, rel=1e-6)  # 20 m/s on a way of 20 m
