"""Sweeps over what a simulation starts from, beside closed forms of the motions."""

from __future__ import annotations

import numpy as np
import pytest
import xarray
from command_lines import PENDULUM, assert_refused, run
from conftest import PROBLEMS
from scipy.special import ellipk

import codegen
from codegen.errors import ArgumentError

CART_POLE = PROBLEMS / "cart_pole_balance.py"
MASSES, LEVER = 1.3, 0.15
"""Of both bodies, and the bob's mass times the length of the rod."""


@pytest.fixture
def oscillator(uncompiled):
    """A pendulum of small angles, and of the frequency w."""
    q, dq = codegen.coordinate("q")
    (w,) = codegen.parameters(w=1.5)
    problem = codegen.Simulate(lagrangian=dq**2 / 2 - w**2 * q**2 / 2, start={q: 1, dq: 0}, duration=3, steps=60)
    return codegen.compile(problem, name="oscillator")


def oscillation(q, dq, w=1.5, duration=3.0, steps=60):
    """What the midpoint rule makes of an oscillator: it turns by 2 atan(h w/2) in a step, and keeps the amplitude."""
    angles = 2.0 * np.arctan(w * duration / steps / 2.0) * np.arange(steps + 1)
    return np.multiply.outer(q, np.cos(angles)) + np.multiply.outer(np.asarray(dq) / w, np.sin(angles))


def test_positions_and_velocities_on_a_grid(oscillator):
    axes = {"start.q": [-1.0, 0.5], "start.dq": [0.0, 0.3, 2.0]}
    data = oscillator.sweep(axes, keep=("q", "p"), workers=1)
    assert data.q.dims == ("start.q", "start.dq", "node", "coordinate")
    q, dq = np.meshgrid(*axes.values(), indexing="ij")
    np.testing.assert_allclose(data.q[..., 0], oscillation(q, dq), atol=1e-12)
    np.testing.assert_array_equal(data.p[:, :, 0, 0], dq)


def test_what_does_not_vary_is_the_problem_s_own(oscillator):
    data = oscillator.sweep({"start.dq": [0.0, 0.3]}, workers=1)
    np.testing.assert_allclose(data.q[..., 0], oscillation([1.0, 1.0], [0.0, 0.3]), atol=1e-12)


def test_samples_beside_a_parameter(oscillator):
    spread = {"start.q": "normal(0, 0.1)", "start.dq": "uniform(-1, 1)", "w": "uniform(1, 2)"}
    data = oscillator.sweep(samples=spread, cases=20, workers=1)
    assert (data.status == "solved").all()
    for case in range(20):
        own = data.isel(case=case)
        exact = oscillation(*(float(own[name]) for name in spread))
        np.testing.assert_allclose(own.q[:, 0], exact, atol=1e-11)


@pytest.mark.parametrize("driver", ["newton", "fsolve"])
def test_pendulums_of_any_amplitude_come_back_after_their_periods(driver, uncompiled):
    """The period is 4 K(sin^2(amplitude/2)), 6.29 to 10.9 here."""
    angles = np.array([0.1, 1.0, 2.0, 2.6])
    columns = {"start.q": angles, "start.p": np.zeros(4), "duration": 4.0 * ellipk(np.sin(angles / 2.0) ** 2)}
    data = codegen.sweep(
        PENDULUM, cases=columns, scheme="gauss-4", steps=400, driver=driver, keep=("q", "energy"), workers=1
    )
    np.testing.assert_allclose(data.q[:, -1, 0], angles, atol=1e-6)
    np.testing.assert_allclose(data.q[:, 200, 0], -angles, atol=1e-6)
    np.testing.assert_allclose(data.energy[:, 0], -np.cos(angles), rtol=1e-15)


def test_the_centre_of_mass_of_a_cart_and_its_pole_moves_uniformly(tmp_path, uncompiled):
    words = ("--vary", "start.x=0,0.1", "--vary", "start.dx=-0.5,1", "--vary", "start.dtheta=-1:1:3", "--keep", "q,p")
    done = run("sweep", CART_POLE, "--set", "plant=True", *words, "--workers", 1, "--out", tmp_path / "s.nc")
    assert done.exit_code == 0, done.stderr
    with xarray.open_dataset(tmp_path / "s.nc") as data:
        x, dx, dtheta = np.meshgrid([0.0, 0.1], [-0.5, 1.0], [-1.0, 0.0, 1.0], indexing="ij")
        momentum = MASSES * dx + LEVER * np.cos(0.2) * dtheta
        np.testing.assert_allclose(data.p.sel(momentum="p_x"), np.repeat(momentum[..., None], 11, -1), rtol=1e-12)
        place = MASSES * data.q.sel(coordinate="x") + LEVER * np.sin(data.q.sel(coordinate="theta"))
        np.testing.assert_allclose(place[..., 0], MASSES * x + LEVER * np.sin(0.2), rtol=1e-14)
        np.testing.assert_allclose(place[..., -1] - place[..., 0], 0.05 * momentum, atol=1e-7)


def test_names_of_another_form_are_refused():
    line = ("sweep", PENDULUM, "--vary", "start.dq=0,1", "--out", "s.zarr")
    assert_refused(run(*line), "did you mean start.q or start.p? pendulum has steps, duration, start.q, start.p")


def test_particles_start_from_an_array():
    with pytest.raises(ArgumentError, match=r"lennard_jones has no start\.x: its particles start from an array; call"):
        codegen.sweep(PROBLEMS / "lennard_jones.py", {"start.x": [0.0, 1.0]})
