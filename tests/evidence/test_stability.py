"""Limits of stability, angles and swings of energy of every scheme on the oscillator, against closed forms."""

import math

import pytest
from interpreted import without_compilation
from stress_cases import every_case

from codegen.discretise.schemes import METHODS
from codegen.emit.naming import Choices
from codegen.evidence.stress.cases import PROBLEMS as OWN_PROBLEMS
from codegen.evidence.stress.motions import MECHANICAL, SYMPLECTIC_EULER, VERLET, expectation, registered
from codegen.evidence.stress.systems import GROWTH, area, growth, limit, spectral_radius, stable_limit, swing, turn
from codegen.solving.compiler import generate

LIMITS = {
    "explicit-euler": 0.0,
    "implicit-euler": math.inf,
    "symplectic-euler": 2.0,
    "symplectic-euler-adjoint": 2.0,
    "midpoint": math.inf,
    "stormer-verlet": 2.0,
    "position-verlet": 2.0,
    "rectangle": 2.0,
    "trapezoidal": 2.0,
    "rk4": math.sqrt(8.0),
    "gauss-4": math.inf,
    "gauss-6": math.inf,
    "hermite-simpson": math.inf,
    "lobatto-4": math.sqrt(8.0),
}
"""Largest stable h omega in closed form: from traces of a step's matrix, and for rk4 from its polynomial."""


@pytest.mark.parametrize(("method", "name"), [s for s in MECHANICAL if s[1] in LIMITS])
def test_limits_of_stability_are_those_of_closed_forms(method, name):
    found = limit(METHODS[method][name])
    assert found == pytest.approx(LIMITS[name], rel=1e-4) if math.isfinite(LIMITS[name]) else found == math.inf


@pytest.mark.parametrize(("method", "name"), MECHANICAL)
def test_nothing_grows_up_to_the_limit_and_something_beyond(method, name):
    scheme = METHODS[method][name]
    found = limit(scheme)
    below = [0.5, 1.5, 50.0] if math.isinf(found) else [0.1 * found, 0.5 * found, 0.8 * found, 0.999 * found]
    assert all(growth(scheme, x) <= 1.0 + GROWTH for x in below)
    if math.isfinite(found):
        assert growth(scheme, 1.001 * found + 0.05 * (found == 0.0)) > 1.0 + GROWTH


def angle(method, name, x):
    return turn(METHODS[method][name], x)[0]


@pytest.mark.parametrize("method", METHODS)
def test_schemes_turn_by_angles_in_closed_form(method):
    """Gauss' methods turn by twice the argument of the numerator of exp's diagonal Padé approximant."""
    x = 0.7
    assert angle(method, "midpoint", x) == pytest.approx(2.0 * math.atan(x / 2), rel=1e-15)
    assert angle(method, "gauss-4", x) == pytest.approx(2.0 * math.atan2(x / 2, 1 - x**2 / 12), rel=1e-15)
    assert angle(method, "gauss-6", x) == pytest.approx(2.0 * math.atan2(x / 2 - x**3 / 120, 1 - x**2 / 10), rel=1e-15)
    assert swing(METHODS[method]["gauss-6"], x) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(("method", "name"), [SYMPLECTIC_EULER, VERLET, ("variational", "trapezoidal")])
def test_explicit_schemes_turn_by_an_arcsine(method, name):
    """From rest at 1, q_k = cos((k + s) theta)/cos(s theta), with s = 1/2 for symplectic Euler and 0 for the others."""
    theta, lean = turn(METHODS[method][name], 0.7)
    assert theta == pytest.approx(2.0 * math.asin(0.35), rel=1e-15)
    assert lean == pytest.approx(-math.tan(theta / 2.0) if name == "symplectic-euler" else 0.0, abs=1e-15)


@pytest.mark.parametrize("x", [0.5, 3.0, 100.0])
def test_lobatto_keeps_the_oscillator_and_radau_damps_it_as_their_stability_functions_say(x):
    """Hairer and Wanner (1996), table IV.3.1 of Padé approximants: (2, 2) of Lobatto IIIA, (2, 3) of Radau IIA."""
    z = 1j * x
    radau = abs((1 + 2 * z / 5 + z**2 / 20) / (1 - 3 * z / 5 + 3 * z**2 / 20 - z**3 / 60)) ** 2
    assert area(METHODS["hamiltonian"]["radau-5"], x) == pytest.approx(radau, rel=1e-12)
    lobatto = METHODS["hamiltonian"]["hermite-simpson"]
    assert area(lobatto, x) == pytest.approx(1.0, abs=1e-14)
    assert swing(lobatto, x) == pytest.approx(0.0, abs=1e-13)
    assert expectation(("hamiltonian", "hermite-simpson"), x, math.nan)[0] == "bounded"


def test_there_is_no_angle_beyond_the_limit():
    assert math.isnan(angle("hamiltonian", "yoshida-4", 1.6))


@pytest.mark.parametrize("x", [0.1, 1.0, 1.9])
def test_energies_of_explicit_schemes_swing_as_what_they_keep_says(x):
    """p^2 + w^2 q^2 - h w^2 q p of symplectic Euler, p^2 + w^2 q^2 (1 - (h w)^2/4) of Störmer-Verlet."""
    half = x / 2.0
    assert swing(registered(SYMPLECTIC_EULER), x) == pytest.approx(half / (1.0 - half), rel=1e-12)
    assert swing(registered(VERLET), x) == pytest.approx(half**2, rel=1e-12)


@pytest.mark.parametrize("name", ["yoshida-4", "blanes-moan-6"])
def test_generated_steps_are_as_stable_as_the_tables_say(name):
    module = without_compilation(generate(OWN_PROBLEMS, {"system": "oscillator"}, Choices(name, "hamiltonian")))
    case = next(c for c in every_case() if c.setup.scheme == name and c.reference == "stable_step")
    assert stable_limit(module, case) == pytest.approx(limit(registered(("hamiltonian", name))), rel=1e-3)
    for x in (0.4, 1.4):
        assert spectral_radius(module, "oscillator", x) == pytest.approx(
            growth(registered(("hamiltonian", name)), x), rel=1e-6
        )


def test_every_scheme_has_its_limit_on_the_oscillator_case():
    wanted = {case.setup.label for case in every_case() if case.reference == "stable_step"}
    assert len(wanted) == len(MECHANICAL)
    assert callable(stable_limit)
