"""The controllers of the gallery by machine code, with plants integrated by scipy: pushes, a path, delays, memory."""

from __future__ import annotations

import gc
import re
import tracemalloc

import numpy as np
import pytest
from compiled_modules import compiled
from conftest import PROBLEMS
from scipy.integrate import solve_ivp

import codegen


@pytest.fixture(scope="module")
def cart_pole(cache_folder):
    return compiled(codegen.build(PROBLEMS / "cart_pole_balance.py").path)


@pytest.fixture(scope="module")
def quadrotor(cache_folder):
    return compiled(codegen.build(PROBLEMS / "quadrotor_path.py").path)


def cart_pole_motion(t, state, force, push, mass=0.33, rod=0.5, gravity=9.81):
    """The equations of motion by hand, of a pole that is a tenth heavier than the controller believes."""
    _, theta, dx, dtheta = state
    across = mass * rod * np.cos(theta)
    matrix = np.array([[1.0 + mass, across], [across, mass * rod**2]])
    right = np.array([force + mass * rod * np.sin(theta) * dtheta**2, mass * gravity * rod * np.sin(theta)])
    pushed = push if 1.0 <= t < 1.1 else -push if 3.0 <= t < 3.1 else 0.0
    return [dx, dtheta, *np.linalg.solve(matrix, right + pushed * np.array([1.0, rod * np.cos(theta)]))]


def cart_pole_plant(push):
    """A plant whose bob is pushed by so many newtons for a tenth of a second, twice."""

    def plant(state, inputs, t, seconds):
        given = {"args": (inputs[0], push), "rtol": 1e-8, "max_step": 0.02}
        return solve_ivp(cart_pole_motion, (t, t + seconds), state, **given).y[:, -1]

    return plant


def test_a_pole_is_kept_upright_under_pushes(cart_pole):
    controller = codegen.Controller(cart_pole)
    loop = codegen.close_loop(controller, cart_pole_plant(6.0), samples=120, start=[0, 0, 0, 0], noise=2e-3)
    assert loop.counts == {"solved": 120}
    assert 0.05 < np.abs(loop.states[:, 1]).max() < 0.7
    assert np.abs(loop.states[-1]).max() < 0.2
    assert np.abs(loop.inputs).max() <= 20.0 + 1e-6
    left_alone = solve_ivp(cart_pole_motion, (0.0, 6.0), np.zeros(4), args=(0.0, 6.0), max_step=0.02)
    assert np.abs(left_alone.y[1]).max() > 1.0  # without a controller it falls


@pytest.mark.parametrize(("newton_steps", "push"), [(1, 6.0), (2, 6.0), (3, 6.0)])
def test_few_newton_steps_keep_it_upright_as_well(cart_pole, newton_steps, push):
    """Also a single one, which far from the equations begins inside the bounds, or it would end where it meets one."""
    controller = codegen.Controller(cart_pole, newton_steps=newton_steps)
    loop = codegen.close_loop(controller, cart_pole_plant(push), samples=120, start=[0, 0, 0, 0])
    assert loop.iterations[1:].max() == newton_steps
    assert set(loop.counts) == {"solved", "iteration limit"}
    assert np.abs(loop.states[:, 1]).max() < 0.7
    assert np.abs(loop.states[-1]).max() < 0.2


def examples_of_the_site():
    """What stands there word for word, with the problem files of this checkout."""
    text = (PROBLEMS.parent / "docs" / "guide" / "controllers.md").read_text(encoding="utf-8")
    return [part.split("```")[0].replace('"problems/', f'"{PROBLEMS}/') for part in text.split("```python\n")[1:]]


def test_the_example_of_the_site(cart_pole, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    found = {"codegen": codegen}
    exec(examples_of_the_site()[0], found)
    assert "{'solved': 160}" in capsys.readouterr().out
    assert (tmp_path / "loop.png").stat().st_size > 10_000
    assert abs(found["loop"].states[-1, 0] - 1.0) < 0.1  # at the place that it was led to
    assert np.abs(found["loop"].states[:, 1]).max() < 0.8


def test_the_example_of_a_soft_constraint():
    """The state begins 1.5 below the constraint, and rises fastest with the greatest power."""
    found = {"codegen": codegen}
    exec(examples_of_the_site()[1], found)
    step = 6 / 30
    middle = 18.0 + step / 2 * (4.0 - (18.0 - 5.0) / 5.0) / (1.0 + step / 10.0)
    assert found["heating"] == pytest.approx(4.0, abs=1e-6)
    assert found["violation"] == pytest.approx(19.5 - middle, abs=1e-6)


def test_the_example_of_a_delay(cart_pole, capsys):
    found = {"codegen": codegen}
    exec(examples_of_the_site()[2], found)
    assert "{'solved': 160} 0.3" in capsys.readouterr().out
    assert np.abs(found["loop"].states[-1]).max() < 0.1
    assert found["loop"].inputs[0] == 0.0


def test_sampled_every_50_ms_with_a_delay_of_one_the_pole_stands_where_the_controller_knows_of_it(cart_pole):
    """Ignorant of the delay a controller lets it fall, pushes or not."""
    loops = [
        codegen.close_loop(
            codegen.Controller(cart_pole, delay=known), cart_pole_plant(4.0), samples=100, start=[0, 0.1, 0, 0],
            noise=2e-3, delay=1,
        )
        for known in (0, 1)
    ]  # fmt: skip
    ignorant, informed = (np.abs(loop.states[:, 1]) for loop in loops)
    assert ignorant[loops[0].times < 3.0].max() > 1.5
    assert informed.max() < 0.9
    assert informed[-1] < 0.1
    assert loops[1].counts == {"solved": 100}


@pytest.mark.parametrize(
    ("state", "is_hopeless"), [([0, 0.5, 0, 9], True), ([9, 1, 0, 0], True), ([0, 0.4, 0, 0], False)]
)
def test_a_step_without_hope_ends_after_two_hundred_iterations_and_restorations(cart_pole, state, is_hopeless):
    """Where bounds and equations contradict each other nothing is gained by all that a solve may try."""
    controller = codegen.Controller(cart_pole)
    controller.step(np.zeros(4))
    inputs = controller.step(state)
    last = controller.last
    assert (last.status == "iteration limit") == is_hopeless
    assert (last.status == "solved") != is_hopeless
    assert np.abs(inputs).max() <= 20.0 + 1e-6
    if is_hopeless:
        iterations, restorations = map(int, re.findall(r"(\d+) iterations and (\d+) of rest", last.message)[0])
        assert iterations == last.iterations
        assert iterations + restorations == 200
    controller.step(np.zeros(4))
    assert controller.last.status == "solved"


@pytest.mark.parametrize("delay", [0, 1])
def test_a_thousand_steps_leave_no_more_than_a_hundred(cart_pole, delay):
    controller = codegen.Controller(cart_pole, delay=delay)
    states = 0.05 * np.random.default_rng(0).standard_normal((1000, 4))
    stepping = tracemalloc.Filter(True, codegen.Controller.step.__code__.co_filename, all_frames=True)
    tracemalloc.start(12)  # frames: other threads of the process allocate too
    try:
        held = []
        for count in (100, 1000):
            for k, state in enumerate(states[:count]):
                controller.step(state, 0.1 * k)
            gc.collect()
            kept = tracemalloc.take_snapshot().filter_traces([stepping])
            held.append(sum(trace.size for trace in kept.traces))
    finally:
        tracemalloc.stop()
    assert held[1] - held[0] < 2000  # bytes: two a step


def quadrotor_motion(_, state, inputs):
    """The equations of motion by rotation matrices, which the problem does not have."""
    thrust, *rates = inputs
    (sr, sp, sy), (cr, cp, cy) = np.sin(state[6:]), np.cos(state[6:])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    force = about_z @ about_y @ about_x @ [0, 0, thrust]
    # The rates of the body are those of roll, of pitch in the frame before it, and of yaw before that.
    of_angles = np.column_stack([[1, 0, 0], about_x.T @ [0, 1, 0], about_x.T @ about_y.T @ [0, 0, 1]])
    return [*state[3:6], *(force - [0, 0, 9.81]), *np.linalg.solve(of_angles, rates)]


@pytest.mark.parametrize(("delay", "known", "least", "most"), [(0, 0, 0, 3e-3), (1, 0, 5e-3, 1e-2), (1, 1, 0, 3e-3)])
def test_a_quadrotor_follows_its_path(quadrotor, delay, known, least, most):
    """Also with a delay of one sampling time: where the controller knows of it, as closely as without."""
    controller = codegen.Controller(quadrotor, parameters={"now": lambda t: t}, delay=known)

    def plant(state, inputs, t, seconds):
        return solve_ivp(quadrotor_motion, (t, t + seconds), state, args=(inputs,), rtol=1e-8).y[:, -1]

    hovering = {"thrust": 9.81, "p": 0.0, "q": 0.0, "r": 0.0}
    loop = codegen.close_loop(controller, plant, samples=160, delay=delay, inputs=hovering)
    assert loop.counts == {"solved": 160}
    phase = 2 * np.pi * loop.times / 8
    path = np.column_stack([3 * np.sin(phase), 1.5 * np.sin(2 * phase), 1.5 + 0.3 * np.sin(phase)])
    distance = np.linalg.norm(loop.states[:, :3] - path, axis=1)
    assert least < distance[loop.times >= 3.0].max() < most  # from a start at rest, while it moves at 3.3 m/s
    assert distance[loop.times >= 2.0].max() < 0.06
    assert distance.max() < 1.5
