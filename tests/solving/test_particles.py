"""Simulations of pairwise systems against integrators, invariants and published numbers."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from conftest import PROBLEMS
from scipy.integrate import solve_ivp

from codegen import Pairwise, Simulate, particles
from codegen.errors import ArgumentError
from codegen.evidence import checks
from codegen.solving import api

BOLTZMANN = 1.380658e-23 / 1e-27


@pytest.fixture
def sun(interpreted):
    return interpreted("outer_solar_system", scheme="stormer-verlet")


@pytest.fixture
def argon(interpreted):
    return interpreted("lennard_jones", scheme="stormer-verlet")


def test_argon_has_the_published_energy(argon):
    """Hairer, Lubich and Wanner (2006), section I.4.2: H(0)/k_B = -1260.2 K."""
    grid = argon.make_grid(1)
    assert argon.energy(grid.start.ravel(), 0.0, grid.parameters) / BOLTZMANN == pytest.approx(-1260.2, abs=0.05)


def test_a_force_of_finite_range(uncompiled):
    """Two grains collide by Hertz's law: the momenta are exchanged, and the energy gives the smallest distance."""
    i, j = particles("x y", "px py")
    gap = 1 - sympy.sqrt((i.q[0] - j.q[0]) ** 2 + (i.q[1] - j.q[1]) ** 2)
    kinetic, pair = (i.p[0] ** 2 + i.p[1] ** 2) / 2, 100 * sympy.Max(0, gap) ** sympy.Rational(5, 2)
    grains = Simulate(
        hamiltonian=Pairwise((i, j), self_term=kinetic, pair_term=pair),
        start={i.q[0]: [0, 1.5], i.q[1]: [0, 0], i.p[0]: [0.5, -0.5], i.p[1]: [0, 0]},
        duration=2,
    )
    solution = api.solve(grains, scheme="yoshida-4", steps=1000)
    assert solution.p[-1, [0, 2]] == pytest.approx([-0.5, 0.5], abs=1e-7)
    assert (solution.q[:, 2] - solution.q[:, 0]).min() == pytest.approx(1 - (0.25 / 100) ** 0.4, abs=1e-5)


def test_checks_take_a_step_that_can_be_made(monkeypatch, uncompiled):
    """At random positions atoms repel each other so strongly that an implicit step of 0.05 has no solution."""
    found = checks.run(PROBLEMS / "lennard_jones.py")
    assert all(finding.passed for finding in found)
    (step,) = (finding for finding in found if finding.check == "symplecticity")
    assert "for a step of 0.00078125; the scheme is symplectic" in step.detail
    monkeypatch.setattr(checks.particles, "PARTICLE_SCHEMES", {"midpoint": SimpleNamespace(symplectic=False)})
    failed = [finding.check for finding in checks.run(PROBLEMS / "lennard_jones.py") if not finding.passed]
    assert failed == ["symplecticity"]


def test_argon_does_not_drift(argon):
    momenta = argon.START[1].sum(axis=0)
    np.testing.assert_allclose(momenta, 0.0, atol=1e-9)  # the book chose the velocities so
    solution = argon.solve(300, duration=300e-5 * 4)
    np.testing.assert_allclose(solution.p[-1].reshape(7, 2).sum(axis=0), 0.0, atol=1e-8)


@pytest.mark.parametrize("scheme", ["stormer-verlet", "midpoint", "symplectic-euler", "symplectic-euler-adjoint",
                                    "explicit-euler", "implicit-euler", "rk4", "yoshida-4",
                                    "blanes-moan-4"])  # fmt: skip
def test_the_solar_system_against_an_adaptive_integrator(interpreted, sun, scheme):
    module = interpreted("outer_solar_system", scheme=scheme)
    masses, positions, G = sun.OWN[:, 0], sun.START[0], sun.metadata.parameters["G"]

    def field(_, y):
        q, v = y.reshape(2, 6, 3)
        a = np.zeros((6, 3))
        for i in range(6):
            for j in range(6):
                if i != j:
                    a[i] += G * masses[j] * (q[j] - q[i]) / np.linalg.norm(q[j] - q[i]) ** 3
        return np.concatenate([v.ravel(), a.ravel()])

    start = np.concatenate([positions.ravel(), (sun.START[1] / masses[:, None]).ravel()])
    exact = solve_ivp(field, (0, 400), start, "DOP853", rtol=1e-12, atol=1e-14).y[:18, -1]
    order = module.metadata.order
    errors = [np.abs(module.solve(n, duration=400.0).q[-1] - exact).max() for n in (10, 20)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.3)


@pytest.mark.parametrize("scheme", ["stormer-verlet", "symplectic-euler", "explicit-euler", "kahan-li-8"])
def test_steps_share_only_what_has_not_changed(interpreted, sun, scheme):
    """Five steps at once, which keep slopes from one to the next, are five single ones, to the last bit."""
    module = interpreted("outer_solar_system", scheme=scheme)
    at_once = module.solve(5, duration=1000.0)
    state = sun.START
    for k in range(5):
        single = module.solve(1, duration=200.0, start=state)
        state = np.stack([single.q[-1].reshape(6, 3), single.p[-1].reshape(6, 3)])
        np.testing.assert_array_equal(state.reshape(2, -1), [at_once.q[k + 1], at_once.p[k + 1]])


def test_any_number_of_particles(argon):
    start = np.array([[(0.0, 0.0), (0.4, 0.0)], [(0.0, 0.0), (0.0, 0.0)]])
    solution = argon.solve(10, start=start, duration=1e-3)
    assert solution.q.shape == (11, 4)
    assert solution.status == "solved"


def test_verlet_is_reversible(sun):
    there = sun.solve(50, duration=5000.0)
    end = np.stack([there.q[-1].reshape(6, 3), -there.p[-1].reshape(6, 3)])
    back = sun.solve(50, duration=5000.0, start=end)
    np.testing.assert_allclose(back.q[-1], there.q[0], atol=1e-11)


def test_thinned_states_are_those_of_all_steps(sun):
    every, all_of_them = sun.solve(23, duration=2300.0, every=5), sun.solve(23, duration=2300.0)
    np.testing.assert_array_equal(every.q, all_of_them.q[[0, 5, 10, 15, 20, 23]])
    assert all_of_them.residual == every.residual == 0.0


def test_a_driver_reports_energies(sun):
    result = api.solve(sun, steps=20)
    assert result.status == "solved"
    assert result.names["q"][3] == "x_2"


def test_unusable_arguments(sun):
    with pytest.raises(ValueError, match="start has shape"):
        sun.solve(5, start=np.zeros((2, 3)))
    with pytest.raises(ValueError, match="steps is 0"):
        sun.solve(0)
    with pytest.raises(ValueError, match="must be finite"):
        sun.solve(5, m=np.nan)


def test_fsolve_says_that_it_does_not_solve_steps_of_particles(sun):
    with pytest.raises(ArgumentError, match="does not solve the steps of particles"):
        api.solve(sun, "fsolve", steps=20)
