"""Closed loops: plants that are functions and modules, noise, delays, disturbances, plants that run away, figures."""

from __future__ import annotations

import re

import numpy as np
from horizon_problems import HORIZON, STEPS, carried, exactly, regulator
from interpreted import of_problem
from scipy.integrate import solve_ivp
from sympy import cos

import codegen
from codegen import Control, Simulate, coordinates, parameters, states
from codegen.mpc.closed_loop import plant_of

H = HORIZON / STEPS


def test_a_loop_without_errors_follows_the_plan():
    """The model is the plant: what is measured is what was planned, and the cost falls by what the interval costs."""
    controller = codegen.Controller(regulator(True), tolerance=1e-10)
    loop = codegen.close_loop(controller, exactly, samples=12)
    assert loop.counts == {"solved": 12}
    assert loop.missed == 0
    assert loop.message == ""
    np.testing.assert_allclose(loop.times, H * np.arange(13))
    np.testing.assert_array_equal(loop.states[0], [1.0, 0.0])
    np.testing.assert_array_equal(loop.measured, loop.states[:-1])
    assert np.abs(loop.states[-1]).max() < 0.15
    assert (np.diff(loop.costs) < 0.0).all()
    assert (np.abs(loop.inputs) <= 1.0 + 1e-9).all()


def test_noise_is_that_of_the_seed_and_of_the_size_that_was_given():
    loops = [
        codegen.close_loop(codegen.Controller(carried()), exactly, samples=20, noise={"dx": 0.1}, seed=seed)
        for seed in (1, 1, 2)
    ]
    errors = [loop.measured - loop.states[:-1] for loop in loops]
    np.testing.assert_array_equal(errors[0], errors[1])
    assert (errors[0] != errors[2]).any()
    assert (errors[0][:, 0] == 0.0).all()
    assert 0.05 < errors[0][:, 1].std() < 0.2


def test_with_a_delay_inputs_act_one_sampling_time_later():
    given = []

    class Noting(codegen.Controller):
        def step(self, state, t=0.0, parameters=None):
            given.append(super().step(state, t, parameters))
            return given[-1]

    loop = codegen.close_loop(Noting(carried()), exactly, samples=5, delay=1, inputs=[0.25])
    np.testing.assert_array_equal(loop.inputs[0], [0.25])
    np.testing.assert_array_equal(loop.inputs[1:], given[:-1])


def cart(gravity=9.81):
    """A cart with a pole as a simulation, and as an optimisation of which nothing is free."""
    (x, theta), (dx, dtheta) = coordinates("x theta")
    u, mass = parameters(u=0, mass=0.3)
    kinetic = (1 + mass) / 2 * dx**2 + mass / 2 * cos(theta) * dx * dtheta + mass / 8 * dtheta**2
    return of_problem(
        Simulate(
            lagrangian=kinetic - mass * gravity / 2 * cos(theta), force={x: u}, duration=0.05,
            start={x: 0, theta: 0, dx: 0, dtheta: 0}, steps=20,
        )
    )  # fmt: skip


def cart_motion(_, state, u, mass):
    """Its equations of motion, written by hand."""
    _, theta, dx, dtheta = state
    matrix = np.array([[1 + mass, mass / 2 * np.cos(theta)], [mass / 2 * np.cos(theta), mass / 4]])
    right = np.array([u + mass / 2 * np.sin(theta) * dtheta**2, mass * 9.81 / 2 * np.sin(theta)])
    return [dx, dtheta, *np.linalg.solve(matrix, right)]


def test_a_simulation_is_a_plant_whose_velocities_come_from_its_momenta():
    names = ("x", "theta", "dx", "dtheta"), ("u",)
    state = np.array([0.3, 0.8, -1.0, 2.0])
    after = plant_of(cart(), {}, names, {"mass": lambda t: 0.3 + 0.1 * t})(state, np.array([5.0]), 1.0, 0.05)
    exact = solve_ivp(cart_motion, (0.0, 0.05), state, args=(5.0, 0.4), rtol=1e-11, atol=1e-12).y[:, -1]
    np.testing.assert_allclose(after, exact, atol=1e-4)  # twenty steps of the midpoint rule
    assert np.abs(after - state).max() > 0.05


def test_dynamics_of_first_order_are_a_plant_without_controls_and_cost():
    x, v = states("x v")
    u, drag = parameters(u=0, drag=0)
    module = of_problem(Control(dynamics={x: v, v: u - drag * v}, duration=0.1, start={x: 0, v: 0}, steps=40))
    plant = plant_of(module, {}, (("v", "x"), ("u",)), {"drag": 0.5})  # states in another order
    after = plant(np.array([1.0, 2.0]), np.array([3.0]), 0.0, 0.5)
    v_end = 6.0 - 5.0 * np.exp(-0.25)
    np.testing.assert_allclose(after, [v_end, 2.0 + 6.0 * 0.5 - 10.0 * (1.0 - np.exp(-0.25))], atol=1e-5)


def test_a_plant_that_runs_away_ends_the_loop():
    def breaking(state, inputs, t, seconds):
        return exactly(state, inputs, t, seconds) if t < 3 * H else np.full(2, np.inf)

    loop = codegen.close_loop(codegen.Controller(carried()), breaking, samples=9)
    assert loop.message == "the plant failed after t = 0.75: its state is not finite"
    assert loop.states.shape == (4, 2)
    assert loop.latencies.shape == (3,)
    ended = codegen.close_loop(codegen.Controller(carried()), lambda *_: [np.nan, 0.0], samples=9)
    assert ended.states.shape == (1, 2)
    assert ended.counts == {}
    assert np.isnan(ended.latency(50.0))


def test_a_figure_has_a_panel_for_every_state_and_input_and_names_what_went_wrong(tmp_path):
    loop = codegen.close_loop(codegen.Controller(carried(), deadline=1e-9), exactly, samples=6)
    assert (loop.missed, loop.fell_back.all()) == (6, True)
    path = tmp_path / "loop.svg"
    loop.plot(path, references={"x": lambda t: 0.0})
    text = path.read_text()
    assert text.startswith("<?xml")
    from codegen.show.figures.simulation import closed_loop_figure

    figure = closed_loop_figure(loop, {})
    assert len(figure.axes) == 4  # x, dx, u, latencies
    assert "6 time limit" in figure.get_suptitle()
    assert "6 of 6 deadlines missed" in figure.get_suptitle()
    assert figure.axes[-1].get_legend().get_texts()[0].get_text() == "missed"
    assert "6 of 6 deadlines missed" in loop.plot().figure.get_suptitle()
    shown = loop._repr_html_()
    assert "6 time limit" in shown
    assert "deadlines missed</th><td" in re.sub(r' style="[^"]*"', "", shown)
    assert "data:image/png" in shown


def test_a_figure_of_nothing_but_a_start(tmp_path):
    loop = codegen.close_loop(codegen.Controller(carried()), lambda *_: [np.nan, 0.0])
    loop.plot(tmp_path / "nothing.png")
    assert "<img" not in loop._repr_html_()
    assert (tmp_path / "nothing.png").stat().st_size > 1000
